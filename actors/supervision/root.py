"""The root of a run: one process that forks and reaps, and does nothing else.

It has loaded the system, so it forks a process of the run in about a millisecond. It has no thread
and no session, since neither survives a fork. One selector loop waits for:

* its child `run`, which has the console, the observer, the test oracle and the report. `run`
  orders start and end, and writes the verdict to a pipe. If it ends without a verdict, the root
  ends the run;
* the supervisor, by an inherited socket. It requests processes, and its messages show that its
  event loop works. The root replaces it at once when it is dead or hung;
* the ends of its children, and signals;
* tools that look for the run.

**No node has two processes.** The root answers each request once. If a node still has a process,
the root kills that process and refuses the request. It drops the requests of a dead supervisor.

**Nothing is orphaned.** Every process of the run is a child of the root, and the kernel kills it
with the root, also if it is stopped (prctl(2), PR_SET_PDEATHSIG). There are two exceptions. The
kernel continues `run`, which then ends commands and removes the folder of the run. It sends SIGTERM
to the process of a command, which first ends whatever its program has forked. The supervisor
continues a stopped root, and the root continues a stopped `run`.

**An end has an order.** The root kills the supervisor, sends SIGTERM to the nodes in reverse order
of their start, and soon kills whatever is left. The routers are last.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import math
import os
import resource
import selectors
import signal
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import msgspec

from rampart.actors.bus import run_folder, run_info
from rampart.actors.bus.bus import BusError
from rampart.actors.bus.envelope import decoder
from rampart.actors.foreign.descendants import kill_orphans
from rampart.actors.foreign.program import check_programs
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.machine.patience import Patience, usage
from rampart.actors.machine.unix_peer import stat_fields
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, load_system
from rampart.actors.supervision import requests
from rampart.actors.supervision.node_process import Role, live
from rampart.actors.supervision.pool import Pool, wait
from rampart.actors.supervision.process_title import POOL, kill, set_title
from rampart.actors.supervision.requests import ForkRequest, LaunchError, Reply
from rampart.actors.supervision.supervised_process import RestartPolicy
from rampart.actors.supervision.watchdog import Watchdogs
from rampart.actors.system.layout import Layout, adapted_system, load_run, published_keys
from rampart.files import working_folder
from rampart.files.plain_text import one_line
from rampart.files.streams import complain

PERIOD_S = 0.25
"""Wall seconds between two checks of the supervisor. No gap between checks counts as more than two
periods, so a root that was stopped does not blame the supervisor."""

SUPERVISOR_PATIENCE_S = 1.5
"""A supervisor that could have sent a message for this long hangs; it sends four a second."""

LAST_PORT = 32_000
"""The kernel gives higher ports to outgoing connections."""

EXIT_INTERRUPTED = 1

_STOP_S, _KILLED_S, _RETRY_S = 0.5, 1.0, 0.05
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36

# With too few of these, nothing fails at the start and anything may fail later. A router has a
# socket, and the supervisor a descriptor, for each process; a process has several threads.
_NEEDED = {resource.RLIMIT_NOFILE: (40, 4), resource.RLIMIT_NPROC: (30, 4)}
"""For a limit of setrlimit(2): the least that a run needs, besides and for each node's process."""

_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_ONE_SIGNAL_S = 0.2
"""A signal that comes again so soon is the same one: timeout(1) sends it to the process and to its
group. A later one ends the run at once."""


@dataclass
class SupervisorState:
    """State of the supervisor, as the root sees it.

    Attributes:
        pid: 0 if no supervisor runs.
        incarnation: Of the last supervisor.
        works: Whether the present one has sent a message.
        checked_s: Time of the last check.
        due_s: When to start the next one; None if that is not decided.
        trouble: Last problem that was reported.
    """

    pid: int = 0
    incarnation: int = 0
    works: bool = False
    checked_s: float = 0.0
    due_s: float | None = None
    trouble: str = ""
    policy: RestartPolicy = field(default_factory=RestartPolicy)
    patience: Patience = field(default_factory=lambda: Patience(2 * PERIOD_S))


class Root:
    """The root of one run. Use: `run`, or `serve`, once.

    Args:
        loaded: The loaded system; None to load it by the plan in `Begin`.

    Attributes:
        plan: Of the run, as far as it is known.
        death: Name of the signal that killed `run`; "" if none did.
    """

    def __init__(self, loaded: RunContext | None = None) -> None:
        self.plan = loaded.plan if loaded else RunPlan()
        self.death = ""
        self._run = loaded
        self._layout: Layout | None = None
        self._system_read: tuple[int, ...] = ()
        self._title = ""
        self._recording = requests.Recording("", "")
        self._pid = os.getpid()
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._selector = selectors.DefaultSelector()
        self._signals: list[int] = []
        self._woken = -1
        self._interrupts = 0
        self._interrupted_s = -math.inf
        self._link: socket.socket | None = None
        self._received = b""
        self._watch_pid = 0
        self._has_ended = False
        self._children: dict[int, tuple[str, ...]] = {}
        self._supervisor_link: socket.socket | None = None
        self._pool: Pool | None = None
        self._held: list[socket.socket] = []
        self._watchdogs: Watchdogs | None = None
        self._supervisor = SupervisorState()

    # -- the whole ------------------------------------------------------------------------------

    def run(self, watch: Callable[[socket.socket], int]) -> int | None:
        """Fork the process `run`, serve it, and return its verdict; None if it has none.

        Args:
            watch: Called in `run` with its end of the connection; returns the verdict.

        Raises:
            LaunchError: No process can be forked.
        """
        ours, theirs = socket.socketpair()
        verdict, verdict_in = os.pipe()
        self._take_signals()
        try:
            self._watch_pid = self._fork_flushed()
        except OSError as error:
            raise LaunchError(f"no process can be started: {error.strerror}") from None
        if self._watch_pid == 0:
            ours.close()
            self._watch(watch, theirs, verdict_in)
        theirs.close()
        os.close(verdict_in)
        try:
            self.serve(ours)
            code = os.read(verdict, 1)
        finally:
            os.close(verdict)
        return EXIT_INTERRUPTED if self._interrupts > 1 else code[0] if code else None

    def serve(self, link: socket.socket) -> None:
        """Serve the requests of `run` on a connection, until `run` ends."""
        if self._woken < 0:
            self._take_signals()
        self._libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._link = link
        self._selector.register(link, selectors.EVENT_READ, self._receive_from_run)
        try:
            if self._run is not None:  # meanwhile `run` prepares
                with contextlib.suppress(ValueError, OSError):  # `Begin` reports it
                    self._load(self._run)
            while self._watch_pid or self._link is not None:
                for key, _ in self._selector.select(self._check()):
                    key.data()
                self._handle_signals()
                if self._interrupts > 1:
                    break
        finally:
            self._end()
            if self._watch_pid:
                kill(self._watch_pid)

    def _watch(self, watch: Callable[[socket.socket], int], link: socket.socket, verdict: int
               ) -> NoReturn:
        """Live as the process `run`, in a fork."""
        try:
            self._become_child(signal.SIGCONT)
            os.write(verdict, bytes([watch(link)]))
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(EXIT_INTERRUPTED)

    # -- signals --------------------------------------------------------------------------------

    def _take_signals(self) -> None:
        """Have signals wake the loop; a signal that is ignored, as under nohup, stays ignored."""
        self._woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        for number in (*_ENDS, signal.SIGTSTP, signal.SIGCHLD):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda number, _frame: self._signals.append(number))
        signal.set_wakeup_fd(wakes, warn_on_full_buffer=False)
        self._selector.register(self._woken, selectors.EVENT_READ, self._wake)

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._woken, 4096)

    def _handle_signals(self) -> None:
        while self._signals:
            number = self._signals.pop(0)
            if number in _ENDS:
                now_s = time.monotonic()
                if now_s - self._interrupted_s < _ONE_SIGNAL_S:
                    continue
                self._interrupted_s = now_s
                self._interrupts += 1
                self._send(requests.Interrupt(signal.Signals(number).name))
            elif number == signal.SIGTSTP:
                complain("ctrl-Z has no effect; `rampart mission pause` holds the mission, "
                         "ctrl-C ends the run")
        self._reap()

    def _reap(self) -> None:
        """Handle the children that have ended or were stopped."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG | os.WUNTRACED)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if os.WIFSTOPPED(status):
                if pid == self._watch_pid:
                    kill(pid, signal.SIGCONT)
                elif self._pool is not None and self._pool.forget(pid):
                    kill(pid)
                continue
            names = self._children.pop(pid, ())
            if self._pool is not None:
                self._pool.forget(pid)
            if pid == self._watch_pid:
                self._watch_pid = 0
                if os.WIFSIGNALED(status):
                    self.death = signal.Signals(os.WTERMSIG(status)).name
            elif pid == self._supervisor.pid:
                self._supervisor.pid = 0
                self._unlink_supervisor()
            elif not (self._has_ended or self._supervisor.works) and (
                    self.plan.routers.keys() & set(names)):
                with contextlib.suppress(OSError):  # tried again with the next supervisor
                    self._start_routers()  # a supervisor that starts needs a bus

    # -- requests of `run` ----------------------------------------------------------------------

    def _receive_from_run(self) -> None:
        assert self._link is not None  # noqa: S101 for the type checker
        try:
            data = self._link.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            self._selector.unregister(self._link)
            self._link.close()
            self._link = None
            self._end()
            return
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines:
            self._obey(msgspec.json.decode(line, type=requests.FromRun))

    def _obey(self, request: requests.FromRun) -> None:
        answer: requests.FromRoot = requests.Done()
        try:
            match request:
                case requests.Begin():
                    answer = self._begin(request)
                case requests.Start():
                    self._start(request.origin_s)
                case requests.Recording():
                    self._recording = request
                    return
                case requests.End():
                    self._end()
        except (LaunchError, ValueError, OSError) as error:
            answer = requests.Refused(one_line(str(error)))
        self._send(answer)

    def _send(self, message: requests.FromRoot) -> None:
        """Send a message to `run`, unless it hangs or is gone."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.send(msgspec.json.encode(message) + b"\n", socket.MSG_DONTWAIT)

    # -- start and end --------------------------------------------------------------------------

    def _load(self, run: RunContext) -> None:
        """Load everything that the processes of the run need.

        Raises:
            ValueError: The system is unsound.
            OSError: A file cannot be read.
        """
        self._layout = layout = Layout(run.plan, run.system, run.application)
        published_keys(run.system, layout)
        used = chain(layout.topics.values(), *(m.actor.inputs() for m in layout.members.values()))
        for topic in used:
            decoder(topic.type)  # here once, instead of 2 ms in each process
        gc.collect()
        gc.freeze()  # the collector of a child would touch, and so copy, the shared pages

    def _begin(self, request: requests.Begin) -> requests.Begun:
        self.plan = plan = msgspec.structs.replace(request.plan, launcher_pid=self._pid)
        self._title = request.title
        port = plan.base_port
        info = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._held = [info]
        try:
            info.bind(run_info.address(port))
        except OSError:
            raise LaunchError(
                f"--port {port}: in use by another run; choose another --port") from None
        if self._run is None:
            working_folder.admit(Path(plan.system_file).parent)
            self._run = load_run(plan, load_system(plan))
        else:
            check_programs(plan, self._run.system)
        if self._layout is None:
            self._load(replace(self._run, plan=plan))
        names = tuple(self._loaded.members)
        _raise_limits(len(names))
        os.environ.update(working_folder.environment())
        try:
            folder = run_folder.make(port, self._pid)
            self.plan = msgspec.structs.replace(plan, folder=folder)
            run_folder.issue(folder, (OBSERVER,), 1)
        except OSError as error:
            raise LaunchError(f"no folder for the run's sockets: {error}") from None
        try:
            self._watchdogs = Watchdogs(plan.watchdog)
        except OSError as error:
            raise LaunchError(f"--watchdog {plan.watchdog}: {error.strerror}") from None
        ports = reserve_ports(port) if plan.keys else []
        self._held += ports
        self._take_plan(ports=tuple(reserved.getsockname()[1] for reserved in ports))
        return requests.Begun(self.plan, names, _age_s())

    @property
    def _loaded(self) -> Layout:
        assert self._layout is not None  # noqa: S101 for the type checker
        return self._layout

    def _take_plan(self, **changes: Any) -> None:
        self.plan = msgspec.structs.replace(self.plan, **changes)
        if self._layout is not None and self._run is not None:
            self._layout.plan = self.plan
            self._run = replace(self._run, plan=self.plan)

    def _start(self, origin_s: float) -> None:
        layout = self._layout
        if layout is None or not self.plan.folder:
            raise LaunchError("nothing is loaded")
        self._take_plan(origin_s=origin_s)
        self._supervisor.policy = RestartPolicy(layout.spec.supervision)
        self._supervisor.incarnation = self.plan.incarnations
        try:
            self._start_supervisor()
        except OSError as error:
            raise LaunchError(f"no process can be started: {error.strerror}") from None
        self._pool = Pool(layout.spec.supervision.spares, self._fork_pooled)
        info = self._held[0]
        info.listen(8)
        info.setblocking(False)
        self._selector.register(info, selectors.EVENT_READ, self._inform)

    def _inform(self) -> None:
        plan, layout = self.plan, self._loaded
        run_info.answer(self._held[0], run_info.RunInfo(
            self._pid, plan.base_port, plan.rate, plan.origin_s, plan.system_file, plan.folder,
            tuple(layout.members), plan.run_id, plan.page.port, self._title, plan.page.url,
            plan.description, host=plan.host, keys=plan.keys, ports=plan.ports,
            hosts=layout.hosts.called if layout.hosts.several else {},
            recording=self._recording.file, recording_problem=self._recording.problem))

    def _end(self) -> None:
        """End all processes of the run: nodes by SIGTERM, then the rest by SIGKILL."""
        if self._has_ended:
            return
        self._has_ended = True
        if self._supervisor.pid:  # first, else it would have them replaced
            kill(self._supervisor.pid)
            self._await_end(lambda: not self._supervisor.pid, _KILLED_S)
        nodes = [pid for pid, names in reversed(self._children.items())
                 if self.plan.routers.keys().isdisjoint(names)]
        for pid in nodes:
            kill(pid, signal.SIGTERM)
        self._await_end(lambda: self._children.keys().isdisjoint(nodes), _STOP_S)
        for pid in self._children:
            kill(pid)
        self._await_end(lambda: not self._children, _KILLED_S)
        kill_orphans(self._pid)
        run_folder.remove(self.plan.folder)
        if self._watchdogs is not None:
            self._watchdogs.end()
        for kept in self._held:
            if kept in self._selector.get_map():
                self._selector.unregister(kept)
            kept.close()

    def _await_end(self, is_over: Callable[[], bool], within_s: float) -> None:
        until_s = time.monotonic() + within_s
        self._reap()
        while not is_over() and time.monotonic() < until_s:
            time.sleep(0.002)
            self._reap()

    # -- the supervisor -------------------------------------------------------------------------

    def _check(self) -> float | None:
        """Check supervisor and pool; return the seconds until the next check."""
        if self._has_ended or self._pool is None:
            return None
        now_s, supervisor = time.monotonic(), self._supervisor
        if not supervisor.pid:
            self._replace_supervisor(now_s)
        elif now_s >= supervisor.checked_s + PERIOD_S:
            supervisor.checked_s = now_s
            silent_s = supervisor.patience.look(now_s, supervisor.pid, usage(supervisor.pid))
            if silent_s >= SUPERVISOR_PATIENCE_S:
                kill(supervisor.pid)
        self._pool.fill()
        return PERIOD_S if supervisor.pid else _RETRY_S

    def _replace_supervisor(self, now_s: float) -> None:
        """Start the next supervisor when it is due."""
        supervisor = self._supervisor
        if supervisor.due_s is None:
            delay_s = supervisor.policy.delay_s(now_s)
            if delay_s is None:
                self._complain(f"the supervisor ended {supervisor.policy.limits.intensity} times "
                               f"within {supervisor.policy.limits.period_s:.0f} s: the root now "
                               "restarts it less often")
                return
            supervisor.due_s = now_s + delay_s
        if now_s < supervisor.due_s:
            return
        try:
            self._start_supervisor()
        except OSError as error:
            self._complain(f"the supervisor cannot be started: {error.strerror}")
            return
        supervisor.due_s = None
        supervisor.policy.restarted(now_s)
        supervisor.trouble = ""
        self._send(requests.Restarted(self.plan.supervisor))

    def _complain(self, trouble: str) -> None:
        if trouble != self._supervisor.trouble:
            self._supervisor.trouble = trouble
            self._send(requests.Trouble(trouble))

    def _start_supervisor(self) -> None:
        self._start_routers()
        supervisor = self._supervisor
        names, incarnation = (self.plan.supervisor,), supervisor.incarnation + 1
        if taken := self._from_pool(names, ForkRequest(self.plan.supervisor, incarnation)):
            pid, ours = taken
        else:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            try:
                with theirs:
                    pid = self._fork(names, incarnation, theirs)
            except OSError:
                ours.close()
                raise
        supervisor.pid, supervisor.works = pid, False
        supervisor.incarnation = incarnation
        supervisor.checked_s = time.monotonic()
        supervisor.patience.answered()
        self._supervisor_link = ours
        self._selector.register(ours, selectors.EVENT_READ, self._receive_from_supervisor)

    def _unlink_supervisor(self) -> None:
        """Close the connection to a supervisor that has ended, with any requests left on it."""
        if self._supervisor_link is not None:
            self._selector.unregister(self._supervisor_link)
            self._supervisor_link.close()
            self._supervisor_link = None

    def _start_routers(self) -> None:
        """Start both routers if none runs: without one a supervisor cannot start."""
        if any(self.plan.routers.keys() & set(names) for names in self._children.values()):
            return
        issued = run_folder.issued(self.plan.folder)
        for name in self.plan.routers:
            self._fork((name,), issued.get(name, self.plan.incarnations) + 1)

    def _receive_from_supervisor(self) -> None:
        link = self._supervisor_link
        if link is None:  # it has ended since the selector saw this
            return
        try:
            data = link.recv(requests.REQUEST_BYTES)
        except OSError:
            data = b""
        if not data:
            self._unlink_supervisor()
            return
        self._supervisor.works = True
        self._supervisor.patience.answered()
        if data == requests.WELL and self._watchdogs is not None:
            self._watchdogs.feed()
        if data in (requests.ALIVE, requests.WELL):
            return
        request = msgspec.json.decode(data, type=ForkRequest)
        try:
            reply = Reply(request, self._carry_out(request))
        except Exception as error:  # the next request is served in any case
            reply = Reply(request, error=one_line(f"{type(error).__name__}: {error}"))
        with contextlib.suppress(OSError):  # it has ended
            link.send(msgspec.json.encode(reply), socket.MSG_DONTWAIT)

    def _carry_out(self, request: ForkRequest) -> int:
        self._follow_changes()
        names = self._names_of(request.name)
        self._reap()
        if before := [pid for pid, other in self._children.items() if other == names]:
            kill(before[0])
            raise ValueError(f"its process {before[0]} has not ended yet")
        if self._loaded.spare_of(names) == "none" or (
                taken := self._from_pool(names, request)) is None:
            return self._fork(names, request.incarnation)
        pid, connection = taken
        connection.close()
        return pid

    def _from_pool(self, names: tuple[str, ...], request: ForkRequest
                   ) -> tuple[int, socket.socket] | None:
        taken = self._pool.take(msgspec.json.encode(request)) if self._pool is not None else None
        if taken is not None:
            self._note(taken[0], names, request.incarnation)
        return taken

    def _note(self, pid: int, names: tuple[str, ...], incarnation: int) -> None:
        self._children[pid] = names
        with contextlib.suppress(OSError):  # the process issues it too, when it begins
            run_folder.issue(self.plan.folder, names, incarnation, pid)

    def _names_of(self, name: str) -> tuple[str, ...]:
        layout = self._loaded
        if name in layout.routers:
            return (name,)
        if name not in layout.unit_of:
            raise ValueError(f"unknown node {name!r}")
        return tuple(node.name for node in layout.units[layout.unit_of[name]].nodes)

    def _follow_changes(self) -> None:
        """Load the system as it was changed last, for the next forks.

        Raises:
            ValueError: The change is unsound; the system before it stays.
        """
        changed = run_folder.changed_system(self.plan.folder, self._system_read)
        if changed is None or self._layout is None or self._run is None:
            return
        self._system_read, data = changed
        self._layout, self._run = adapted_system(
            self._layout, self._run, msgspec.json.decode(data, type=AdaptedSystem))
        if self._pool is not None:
            self._pool.end()  # its processes have the system before the change

    # -- children -------------------------------------------------------------------------------

    def _fork_flushed(self) -> int:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # else the child would print buffered text again
        return os.fork()

    def _fork(self, names: tuple[str, ...], incarnation: int, link: socket.socket | None = None
              ) -> int:
        """Fork a process of the run and return its pid.

        Args:
            names: Its actors.
            incarnation: Of the process.
            link: The supervisor's connection to the root.

        Raises:
            OSError: There is no process or memory left.
        """
        pid = self._fork_flushed()
        if pid == 0:
            self._in_child(lambda: asyncio.run(live(
                self._loaded, Role(names, incarnation), self._context_of(link))), link)
        self._note(pid, names, incarnation)
        return pid

    def _fork_pooled(self, control: socket.socket) -> int:
        async def wait_and_live() -> int:
            try:
                data, bus = await wait(control, self.plan)
            except (BusError, OSError):  # no router runs, or the root has ended
                return 0
            if not data:
                return 0
            request = msgspec.json.decode(data, type=ForkRequest)
            is_supervisor = request.name == self.plan.supervisor
            if not is_supervisor:
                control.close()
            names = (request.name,) if is_supervisor else self._names_of(request.name)
            return await live(self._loaded, Role(names, request.incarnation),
                              self._context_of(control if is_supervisor else None), bus)

        def be_pooled() -> int:
            set_title(self.plan.base_port, self._pid, (POOL,), 1)
            return asyncio.run(wait_and_live())

        pid = self._fork_flushed()
        if pid == 0:
            self._in_child(be_pooled, control)
        self._children[pid] = ()
        return pid

    def _context_of(self, link: socket.socket | None) -> RunContext:
        assert self._run is not None  # noqa: S101 for the type checker
        if link is None:
            return self._run
        return replace(self._run, root=link.fileno(),
                       known_incarnations=run_folder.issued(self.plan.folder))

    def _in_child(self, be: Callable[[], int], *kept: socket.socket | None) -> NoReturn:
        """Live as a process of the run, in a fork."""
        code = 1
        try:
            self._become_child(signal.SIGKILL, *kept)
            nothing = os.open(os.devnull, os.O_RDONLY)
            os.dup2(nothing, 0)
            os.close(nothing)
            os.dup2(2, 1)
            code = be()
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(code)

    def _become_child(self, death: signal.Signals, *kept: socket.socket | None) -> None:
        """Release the root's resources in a fork, and have the root's death signalled."""
        self._libc.prctl(_PR_SET_PDEATHSIG, death, 0, 0, 0)
        if os.getppid() != self._pid:  # it ended before the prctl
            os._exit(EXIT_INTERRUPTED)
        os.setpgid(0, 0)  # out of the terminal's foreground
        wakes = signal.set_wakeup_fd(-1)
        for number in (signal.SIGTERM, signal.SIGTSTP, signal.SIGCHLD):
            signal.signal(number, signal.SIG_DFL)
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTTIN, signal.SIGTTOU):
            signal.signal(number, signal.SIG_IGN)
        registered = [key.fileobj for key in self._selector.get_map().values()]
        pooled = self._pool.waiting.values() if self._pool else ()
        for opened in {*registered, *self._held, *pooled} - set(kept):
            os.close(opened) if isinstance(opened, int) else opened.close()
        os.close(wakes)
        self._selector.close()
        if self._watchdogs is not None:
            self._watchdogs.release()


def _raise_limits(processes: int) -> None:
    """Raise each of the limits that a run needs to its hard limit.

    Raises:
        LaunchError: A hard limit is too low for this number of processes.
    """
    for kind, what, option in ((resource.RLIMIT_NOFILE, "open files", "n"),
                               (resource.RLIMIT_NPROC, "processes and threads of a user", "u")):
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (hard, hard))
        needed = needed_of(kind, processes)
        is_exempt = kind == resource.RLIMIT_NPROC and os.getuid() == 0
        if hard < needed and hard != resource.RLIM_INFINITY and not is_exempt:
            raise LaunchError(f"{what}: the hard limit is {hard}, and {processes} processes need "
                              f"{needed}; raise it, as with `ulimit -H{option} {needed}` in the "
                              "shell of a privileged user")


def needed_of(kind: int, processes: int) -> int:
    """Return the least limit of a kind for a run with this number of processes of nodes.

    Args:
        kind: `resource.RLIMIT_NOFILE` or `resource.RLIMIT_NPROC`.
        processes: Of nodes.
    """
    base, each = _NEEDED[kind]
    return base + each * processes


def _age_s() -> float:
    """Return the age of this process, real seconds (proc(5), field 22 of stat)."""
    begun_s = int(stat_fields(os.getpid())[19]) / os.sysconf("SC_CLK_TCK")
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - begun_s)


def reserve_ports(first: int) -> list[socket.socket]:
    """Return sockets that reserve loopback ports for the routers of a run with credentials.

    A router can listen on its reserved port, since both sockets have SO_REUSEADDR. While a router
    restarts, no other run takes the port, and the kernel gives it to no outgoing connection.

    Args:
        first: First port to try.

    Raises:
        LaunchError: There are too few free ports.
    """
    found: list[socket.socket] = []
    for port in range(first, LAST_PORT + 1):
        reserved = socket.socket()
        try:
            reserved.bind(("127.0.0.1", port))
        except OSError:
            reserved.close()
            continue
        # Only now: with SO_REUSEADDR the bind would take a port that is in use.
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.append(reserved)
        if len(found) == len(run_folder.ROUTERS):
            return found
    raise LaunchError(f"--port {first}: too few free ports from {first} to {LAST_PORT} "
                      "for the routers")
