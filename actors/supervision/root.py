"""The root of a run: one process that forks and reaps, and does nothing else.

It has loaded the system, so a process of the run is a fork of it, in about a millisecond. It holds
no thread and no session (neither survives a fork), and waits in one selector loop for:

* the process that watches the run, its child: console, observer, test oracle and report. That one
  says when to start and when to end, and its exit code is the verdict, which comes by a pipe. If it
  ends without a verdict, the run is ended and there is none;
* the supervisor, by a socket that it was born with. It asks for processes, and by its words the
  root knows that its loop turns. Dead or hung, it is replaced at once;
* its children's ends, and signals;
* tools that look for the run.

**No node has two processes.** The root answers each request once, and starts no process for nodes
that have one: it kills that one and refuses. The requests of a supervisor that has ended are not
carried out.

**Nothing is orphaned.** Every process of the run is a child of the root, and asks the kernel to be
killed with it (prctl(2), PR_SET_PDEATHSIG), stopped ones included. Only the watching process is
continued instead: it ends commands and removes the folder of the run. And the process of a command
is asked to end, to end first what its program has forked. A stopped
root is continued by the supervisor, and the root continues the watching process.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import os
import resource
import select
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
from rampart.actors.system.layout import Layout, adapted_system, load_run, published_keys
from rampart.files import streams, working_folder
from rampart.files.plain_text import one_line
from rampart.files.streams import complain

PERIOD_S = 0.25
"""Wall seconds between two looks at the supervisor. If the root was stopped, twice that counts."""

SUPERVISOR_PATIENCE_S = 1.5
"""A supervisor that could have said a word for so long is hung; it says four a second."""

LAST_PORT = 32_000
"""Above are those that the kernel gives to outgoing connections."""

EXIT_INTERRUPTED = 1

_STOP_S, _KILLED_S, _RETRY_S = 1.2, 1.0, 0.05
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36

# A router holds a socket for each process of a run, and the supervisor a descriptor. With too few
# of them nothing fails at once, and everything fails later.
_DESCRIPTORS_EACH = 4
_DESCRIPTORS_BESIDES = 40

_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass
class Guarded:
    """What the root knows of the supervisor.

    Attributes:
        pid: Of the present one, 0 if there is none.
        incarnation: Of the last one.
        turns: Whether the present one has said a word.
        looked_s: When it was last looked at.
        due_s: When the next one is due; None if that is not decided.
        trouble: What was reported last.
    """

    pid: int = 0
    incarnation: int = 0
    turns: bool = False
    looked_s: float = 0.0
    due_s: float | None = None
    trouble: str = ""
    policy: RestartPolicy = field(default_factory=RestartPolicy)
    patience: Patience = field(default_factory=lambda: Patience(2 * PERIOD_S))


class Root:
    """One run's root. Use: `run`, or `serve`, once.

    Args:
        loaded: What is loaded of the run already; None to load it by its plan.

    Attributes:
        plan: Of the run, as it is known so far.
        death: What the watching process died of; "" if it did not.
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
        self._link: socket.socket | None = None
        self._received = b""
        self._watch_pid = 0
        self._has_ended = False
        self._children: dict[int, tuple[str, ...]] = {}
        self._issued: dict[str, int] = {}
        self._supervisor_link: socket.socket | None = None
        self._pool: Pool | None = None
        self._held: list[socket.socket] = []
        self._supervisor = Guarded()

    # -- the whole ------------------------------------------------------------------------------

    def run(self, watch: Callable[[socket.socket], int]) -> int | None:
        """Fork the process that watches the run, and serve; return its verdict, None without one.

        Args:
            watch: What that process does, with its end of the connection; returns the verdict.

        Raises:
            LaunchError: no process can be forked.
        """
        ours, theirs = socket.socketpair()
        verdict, said = os.pipe()
        self._take_signals()
        try:
            self._watch_pid = self._forked()
        except OSError as error:
            raise LaunchError(f"no process can be started: {error.strerror}") from None
        if self._watch_pid == 0:
            ours.close()
            self._watch(watch, theirs, said)
        theirs.close()
        os.close(said)
        try:
            self.serve(ours)
            code = os.read(verdict, 1)
        finally:
            os.close(verdict)
        return EXIT_INTERRUPTED if self._interrupts > 1 else code[0] if code else None

    def serve(self, link: socket.socket) -> None:
        """Do what is asked by a connection, to the end of the process that watches the run."""
        if self._woken < 0:
            self._take_signals()
        self._libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._link = link
        self._selector.register(link, selectors.EVENT_READ, self._hear_run)
        try:
            if self._run is not None:  # meanwhile the other process gets ready as well
                with contextlib.suppress(ValueError, OSError):  # reported when the run begins
                    self._load(self._run)
            while self._watch_pid or self._link is not None:
                for key, _ in self._selector.select(self._look()):
                    key.data()
                self._heed_signals()
                if self._interrupts > 1:
                    break
        finally:
            self._end()
            if self._watch_pid:
                kill(self._watch_pid)

    def _watch(self, watch: Callable[[socket.socket], int], link: socket.socket, said: int
               ) -> NoReturn:
        """Be the process that watches the run."""
        try:
            self._become_child(signal.SIGCONT)
            os.write(said, bytes([watch(link)]))
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(EXIT_INTERRUPTED)

    # -- signals --------------------------------------------------------------------------------

    def _take_signals(self) -> None:
        """Have signals wake the loop; those that are ignored, as under nohup, stay so."""
        self._woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        for number in (*_ENDS, signal.SIGTSTP, signal.SIGCHLD):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda number, _frame: self._signals.append(number))
        signal.set_wakeup_fd(wakes, warn_on_full_buffer=False)
        self._selector.register(self._woken, selectors.EVENT_READ, self._wake)

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._woken, 4096)

    def _heed_signals(self) -> None:
        while self._signals:
            number = self._signals.pop(0)
            if number in _ENDS:
                self._interrupts += 1
                self._tell(requests.Interrupt(signal.Signals(number).name))
            elif number == signal.SIGTSTP:
                complain("ctrl-Z has no effect; `rampart mission pause` holds the mission, "
                         "ctrl-C ends the run")
        self._reap()

    def _reap(self) -> None:
        """Take note of children that have ended or were stopped."""
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
            elif not self._supervisor.turns and self.plan.routers.keys() & set(names):
                with contextlib.suppress(OSError):  # tried again with the next supervisor
                    self._start_routers()  # who looks after them has no bus to start on

    # -- the process that watches the run -------------------------------------------------------

    def _hear_run(self) -> None:
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
        self._tell(answer)

    def _tell(self, message: requests.FromRoot) -> None:
        """Send a message to the process that watches the run, unless it hangs or is gone."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.send(msgspec.json.encode(message) + b"\n", socket.MSG_DONTWAIT)

    # -- start and end --------------------------------------------------------------------------

    def _load(self, run: RunContext) -> None:
        """Load all that the processes of the run need.

        Raises:
            ValueError: the system is unsound.
            OSError: a file cannot be read.
        """
        self._layout = layout = Layout(run.plan, run.system, run.application)
        published_keys(run.system, layout)
        heard = chain(layout.topics.values(), *(m.actor.inputs() for m in layout.members.values()))
        for topic in heard:
            decoder(topic.type)  # now, and not in each process when it starts: 2 ms
        gc.collect()
        gc.freeze()  # keeps the collector from touching, and so copying, the shared pages

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
        _raise_descriptors(len(names))
        os.environ.update(working_folder.environment())
        try:
            folder = run_folder.make(port, self._pid)
            self.plan = msgspec.structs.replace(plan, folder=folder)
            run_folder.issue(folder, (OBSERVER,), 1)
        except OSError as error:
            raise LaunchError(f"no folder for the run's sockets: {error}") from None
        ports = kept_ports(port) if plan.keys else []
        self._held += ports
        self._take_plan(ports=tuple(one.getsockname()[1] for one in ports))
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
        """End all processes of the run: in order if the supervisor can, by force what is left."""
        if self._has_ended:
            return
        self._has_ended = True
        if self._supervisor.pid and kill(self._supervisor.pid, signal.SIGTERM):
            self._await_end(lambda: not self._supervisor.pid, _STOP_S)
        for pid in self._children:
            kill(pid)
        self._await_end(lambda: not self._children, _KILLED_S)
        kill_orphans(self._pid)
        run_folder.remove(self.plan.folder)
        for one in self._held:
            if one in self._selector.get_map():
                self._selector.unregister(one)
            one.close()

    def _await_end(self, is_over: Callable[[], bool], within_s: float) -> None:
        until_s = time.monotonic() + within_s
        self._reap()
        while not is_over() and (left_s := until_s - time.monotonic()) > 0:
            if select.select([self._woken], [], [], left_s)[0]:
                self._wake()
            self._reap()

    # -- the supervisor -------------------------------------------------------------------------

    def _look(self) -> float | None:
        """Look after supervisor and pool; return in how many seconds to look again."""
        if self._has_ended or self._pool is None:
            return None
        now_s, guarded = time.monotonic(), self._supervisor
        if not guarded.pid:
            self._bring_supervisor_back(now_s)
        elif now_s >= guarded.looked_s + PERIOD_S:
            guarded.looked_s = now_s
            silent_s = guarded.patience.look(now_s, guarded.pid, usage(guarded.pid))
            if silent_s >= SUPERVISOR_PATIENCE_S:
                kill(guarded.pid)
        self._pool.fill()
        return PERIOD_S if guarded.pid else _RETRY_S

    def _bring_supervisor_back(self, now_s: float) -> None:
        """Start the next supervisor when it is due."""
        guarded = self._supervisor
        if guarded.due_s is None:
            delay_s = guarded.policy.delay_s(now_s)
            if delay_s is None:
                self._complain(f"the supervisor ended {guarded.policy.limits.intensity} times "
                               f"within {guarded.policy.limits.period_s:.0f} s: it is started "
                               "less often from now on")
                return
            guarded.due_s = now_s + delay_s
        if now_s < guarded.due_s:
            return
        try:
            self._start_supervisor()
        except OSError as error:
            self._complain(f"the supervisor cannot be started: {error.strerror}")
            return
        guarded.due_s = None
        guarded.policy.restarted(now_s)
        guarded.trouble = ""
        self._tell(requests.Restarted(self.plan.supervisor))

    def _complain(self, trouble: str) -> None:
        if trouble != self._supervisor.trouble:
            self._supervisor.trouble = trouble
            self._tell(requests.Trouble(trouble))

    def _start_supervisor(self) -> None:
        self._start_routers()
        guarded = self._supervisor
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            with theirs:
                pid = self._fork((self.plan.supervisor,), guarded.incarnation + 1, theirs)
        except OSError:
            ours.close()
            raise
        guarded.pid, guarded.turns = pid, False
        guarded.incarnation += 1
        guarded.looked_s = time.monotonic()
        guarded.patience.answered()
        self._supervisor_link = ours
        self._selector.register(ours, selectors.EVENT_READ, self._hear_supervisor)

    def _unlink_supervisor(self) -> None:
        """Hear no more of a supervisor that has ended, nor carry out what it has asked for."""
        if self._supervisor_link is not None:
            self._selector.unregister(self._supervisor_link)
            self._supervisor_link.close()
            self._supervisor_link = None

    def _start_routers(self) -> None:
        """Start both routers if there is none: without one a supervisor cannot start."""
        if any(self.plan.routers.keys() & set(names) for names in self._children.values()):
            return
        issued = run_folder.issued(self.plan.folder)
        for name in self.plan.routers:
            self._fork((name,), issued.get(name, self.plan.incarnations) + 1)

    def _hear_supervisor(self) -> None:
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
        self._supervisor.turns = True
        self._supervisor.patience.answered()
        if data == requests.WORD:
            return
        request = msgspec.json.decode(data, type=ForkRequest)
        try:
            reply = Reply(request, self._carry_out(request))
        except Exception as error:  # it serves the next request all the same
            reply = Reply(request, error=one_line(f"{type(error).__name__}: {error}"))
        with contextlib.suppress(OSError):  # it has ended
            link.send(msgspec.json.encode(reply), socket.MSG_DONTWAIT)

    def _carry_out(self, request: ForkRequest) -> int:
        self._follow_changes()
        names = self._names_of(request.name)
        self._reap()
        if before := [pid for pid, other in self._children.items() if other == names]:
            kill(before[0])
            raise ValueError(f"process {before[0]} of it has to end first")
        assert self._pool is not None  # noqa: S101 for the type checker
        pooled = self._loaded.spare_of(names) != "none" and self._pool.take(
            msgspec.json.encode(request))
        if not pooled:
            return self._fork(names, request.incarnation)
        self._note(pooled, names, request.incarnation)
        return pooled

    def _note(self, pid: int, names: tuple[str, ...], incarnation: int) -> None:
        self._children[pid] = names
        self._issued.update(dict.fromkeys(names, incarnation))

    def _names_of(self, name: str) -> tuple[str, ...]:
        layout = self._loaded
        if name in layout.routers:
            return (name,)
        if name not in layout.unit_of:
            raise ValueError(f"unknown node {name!r}")
        return tuple(node.name for node in layout.units[layout.unit_of[name]].nodes)

    def _follow_changes(self) -> None:
        """Fork from now on by the system as it was changed last.

        Raises:
            ValueError: it makes no sense, and the one before stays.
        """
        changed = run_folder.changed_system(self.plan.folder, self._system_read)
        if changed is None or self._layout is None or self._run is None:
            return
        self._system_read, data = changed
        self._layout, self._run = adapted_system(
            self._layout, self._run, msgspec.json.decode(data, type=AdaptedSystem))
        if self._pool is not None:
            self._pool.end()  # its processes know the system as it was

    # -- children -------------------------------------------------------------------------------

    def _forked(self) -> int:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # else the child has what is buffered as well
        return os.fork()

    def _fork(self, names: tuple[str, ...], incarnation: int, link: socket.socket | None = None
              ) -> int:
        """Fork a process of the run and return its number.

        Args:
            names: of its actors.
            incarnation: of it.
            link: to the root, if it is the supervisor.

        Raises:
            OSError: there is no process, or memory, left.
        """
        pid = self._forked()
        if pid == 0:
            self._in_child(lambda: asyncio.run(live(
                self._loaded, Role(names, incarnation), self._known(link))), link)
        self._note(pid, names, incarnation)
        return pid

    def _fork_pooled(self, control: socket.socket) -> int:
        async def wait_and_live() -> int:
            try:
                data, bus = await wait(control, self.plan)
            except (BusError, OSError):  # there is no router, or the root has ended
                return 0
            if not data:
                return 0
            request = msgspec.json.decode(data, type=ForkRequest)
            role = Role(self._names_of(request.name), request.incarnation)
            return await live(self._loaded, role, self._known(None), bus)

        def be_pooled() -> int:
            set_title(self.plan.base_port, self._pid, (POOL,), 1)
            return asyncio.run(wait_and_live())

        pid = self._forked()
        if pid == 0:
            self._in_child(be_pooled, control)
        self._children[pid] = ()
        return pid

    def _known(self, link: socket.socket | None) -> RunContext:
        assert self._run is not None  # noqa: S101 for the type checker
        if link is None:
            return self._run
        known = run_folder.issued(self.plan.folder)
        for name, incarnation in self._issued.items():  # one may not have begun yet
            known[name] = max(known.get(name, 0), incarnation)
        return replace(self._run, root=link.fileno(), known_incarnations=known)

    def _in_child(self, be: Callable[[], int], *kept: socket.socket | None) -> NoReturn:
        """Be a process of the run, in a fork."""
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
        """Let go in a fork of the root's things, and be signalled when the root ends."""
        self._libc.prctl(_PR_SET_PDEATHSIG, death, 0, 0, 0)
        if os.getppid() != self._pid:  # it has ended before
            os._exit(EXIT_INTERRUPTED)
        os.setpgid(0, 0)  # no terminal's foreground is here
        wakes = signal.set_wakeup_fd(-1)
        for number in (signal.SIGTERM, signal.SIGTSTP, signal.SIGCHLD):
            signal.signal(number, signal.SIG_DFL)
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTTIN, signal.SIGTTOU):
            signal.signal(number, signal.SIG_IGN)
        registered = [key.fileobj for key in self._selector.get_map().values()]
        pooled = self._pool.waiting.values() if self._pool else ()
        for one in {*registered, *self._held, *pooled} - set(kept):
            os.close(one) if isinstance(one, int) else one.close()
        os.close(wakes)
        self._selector.close()


def _raise_descriptors(processes: int) -> None:
    """Have as many files open as are allowed.

    Raises:
        LaunchError: a run of so many processes needs more.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    needed = needed_descriptors(processes)
    if most < needed:
        raise LaunchError(f"open files: the hard limit is {most}, and {processes} processes need "
                          f"{needed}; raise it, as with `ulimit -Hn {needed}` in the shell of a "
                          "privileged user")


def needed_descriptors(processes: int) -> int:
    """Return how many files a process of a run with so many processes may have to hold open."""
    return _DESCRIPTORS_BESIDES + _DESCRIPTORS_EACH * processes


def _age_s() -> float:
    """Return for how long this process has existed, real seconds (proc(5), field 22 of stat)."""
    begun_s = int(stat_fields(os.getpid())[19]) / os.sysconf("SC_CLK_TCK")
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - begun_s)


def kept_ports(first: int) -> list[socket.socket]:
    """Return sockets that keep ports of loopback for the routers of a run with keys.

    A router listens on a port that is kept all the same, for both have SO_REUSEADDR; no other run
    takes it while the router is restarted, and the kernel gives it to no outgoing connection.

    Args:
        first: of the ports that are tried.

    Raises:
        LaunchError: there are too few.
    """
    found: list[socket.socket] = []
    for port in range(first, LAST_PORT + 1):
        kept = socket.socket()
        try:
            kept.bind(("127.0.0.1", port))
        except OSError:
            kept.close()
            continue
        kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # not before: it would fit any
        found.append(kept)
        if len(found) == len(run_folder.ROUTERS):
            return found
    raise LaunchError(f"--port {first}: no ports for the routers from there to {LAST_PORT}")


def main() -> int:
    """Entry of a root that another process has started: `… root FD`, by a connection to that."""
    working_folder.admit()
    streams.secure()
    Root().serve(socket.socket(fileno=int(sys.argv[1])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
