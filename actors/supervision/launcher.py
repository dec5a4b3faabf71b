"""The root of a run: starts spawners and supervisor, brings them back, and cleans up after all.

The launcher owns the lifeline (see `node_process`), is the subreaper of the run (orphans of a dead
spawner become its children, so no zombie stays), and answers tools that look for the run. It is
the last guard: the supervisor brings the nodes back, the launcher brings back the supervisor
(see `guard`).
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import msgspec

from rampart.actors.bus import run_folder, run_info
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.ftm.messages import NodeTable
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, on_host
from rampart.actors.supervision.guard import Guard
from rampart.actors.supervision.process_title import (
    TITLE_BYTES,
    end_commands,
    kill,
    kill_leftovers,
    set_title,
    title_room,
)
from rampart.actors.supervision.spawner import NAMES, Loaded, load_and_serve
from rampart.actors.supervision.spawner_client import (
    START_PATIENCE_S,
    SpawnerClient,
    SpawnerUnavailableError,
)
from rampart.actors.supervision.supervised_process import RestartPolicy
from rampart.actors.supervision.unseen import tell_of_callbacks, watch
from rampart.files import working_folder

LOAD_TIMEOUT_S = 60.0
LAST_PORT = 32_000
"""Above are those that the kernel gives to outgoing connections."""

STARTUP_S = (0.8, 5.0)
"""Simulated time 0 lies between so many wall seconds after the start of the first actor: until
then all processes start at once, and silence is no fault."""

_LOADS = 1.4
"""How many, in times that the machine took to load the first process; all run after 0.9 to 1.25."""

STOP_TIMEOUT_S = 1.2
_PR_SET_CHILD_SUBREAPER = 36

# A router holds a socket for each process of a run, and the supervisor a descriptor. With too few
# of them nothing fails at once, and everything fails later.
_DESCRIPTORS_EACH = 4
_DESCRIPTORS_BESIDES = 40


class LaunchError(Exception):
    """The run cannot be started; the text is one line for the user."""


class Launcher:
    """One run's processes. Use: `load`, then `start` on a running event loop, then `end`.

    Attributes:
        plan: of the run.
        names: of the actors.
        guard: brings back supervisor and spawners; tells whom it has brought back, and troubles.
        failure: why the run has to end, "" as long as it can go on.
    """

    def __init__(self, plan: RunPlan, title: str) -> None:
        self.plan = msgspec.structs.replace(plan, launcher_pid=os.getpid())
        self.names: tuple[str, ...] = ()
        self.failure = ""
        self._title = title
        self._spawners = SpawnerClient("", plan.base_port, os.getpid())
        self._lifeline: tuple[int, int] = (-1, -1)
        self._first: subprocess.Popen[bytes] | None = None
        self._loaded: BinaryIO | None = None
        self._begun_s = self._load_s = 0.0
        self.recording: Callable[[], tuple[str, str]] = lambda: ("", "")
        self._info: socket.socket | None = None
        self._kept_ports: list[socket.socket] = []
        self._descriptors = 0
        self.guard = Guard(self.plan, self._spawners, self._load)
        self._keeping: asyncio.Task[None] | None = None

    # -- start ----------------------------------------------------------------------------------

    def begin(self, *, forks: bool = False) -> None:
        """Claim the base port and start the first spawner, which then loads in the background.

        Args:
            forks: as a fork of this process, which has loaded the system already. Not if there is
                another thread here: what that one holds would be held for ever in the fork.

        Raises:
            LaunchError: another run has the base port, or there is no place for the run's sockets.
        """
        port = self.plan.base_port
        with contextlib.ExitStack() as on_failure:
            info = on_failure.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            try:
                info.bind(run_info.address(port))
            except OSError:
                raise LaunchError(f"--port {port}: in use by another run; "
                                  "choose another --port") from None
            try:
                folder = run_folder.make(port, os.getpid())
                run_folder.issue(folder, (OBSERVER,), 1)
            except OSError as error:
                raise LaunchError(f"no folder for the run's sockets: {error}") from None
            if self.plan.keys:
                self._kept_ports = kept_ports(port)
            on_failure.pop_all()
        self._info = info
        self.plan = msgspec.structs.replace(self.plan, folder=folder, ports=tuple(
            one.getsockname()[1] for one in self._kept_ports))
        self._spawners.folder = folder
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._lifeline = os.pipe()
        _, self._descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (self._descriptors, self._descriptors))
        self._begun_s = time.monotonic()
        if forks and _has_one_thread() and title_room() >= TITLE_BYTES:
            self._begun_s -= _age_s()
            self._loaded = self._fork(NAMES[0])
        else:
            self._first = self._load(NAMES[0])
            assert self._first.stdout is not None  # noqa: S101 for the type checker
            self._loaded = self._first.stdout  # type: ignore[assignment]

    def _load(self, name: str) -> subprocess.Popen[bytes]:
        spawner = subprocess.Popen(  # noqa: S603 our own interpreter and module
            [sys.executable, "-P", "-m", "rampart.actors.supervision.spawner", name,
             str(self._lifeline[0])],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[self._lifeline[0]],
            env={**working_folder.environment(), "RAMPART_ROOM_FOR_TITLES": "." * TITLE_BYTES},
            process_group=0)  # see `node_process`
        assert spawner.stdin is not None  # noqa: S101 for the type checker
        with contextlib.suppress(BrokenPipeError):  # it has died: what waits for it will notice
            spawner.stdin.write(msgspec.json.encode(self.plan))
            spawner.stdin.close()
        return spawner

    def _fork(self, name: str) -> BinaryIO:
        """Fork a spawner, and return what it says when it can fork nodes."""
        output, said = os.pipe()
        gc.collect()
        gc.freeze()  # keeps both collectors from touching, and so copying, the shared pages
        if os.fork():
            os.close(said)
            return os.fdopen(output, "rb")
        code = 1
        try:
            os.setpgid(0, 0)  # see `node_process`
            set_title(self.plan.base_port, self.plan.launcher_pid, (f"spawner_{name}",), 1)
            os.close(output)
            os.close(self._lifeline[1])
            for listener in (self._info, *self._kept_ports):
                if listener is not None:
                    listener.close()
            nothing = os.open(os.devnull, os.O_RDONLY)
            os.dup2(nothing, 0)
            os.close(nothing)
            os.environ.update(working_folder.environment())
            code = load_and_serve(name, self.plan, self._lifeline[0], said)
        finally:
            os._exit(code)

    async def load(self) -> None:
        """Wait until the first spawner has loaded the plan.

        Raises:
            LaunchError: spec, airport or mission are unsound, or fewer files may be open than the
                run needs.
        """
        output = self._loaded
        assert output is not None  # noqa: S101 for the type checker
        try:
            line = await asyncio.wait_for(asyncio.to_thread(output.readline), LOAD_TIMEOUT_S)
        except TimeoutError:
            raise LaunchError(f"the spawner did not load within {LOAD_TIMEOUT_S:.0f} s") from None
        self._load_s = time.monotonic() - self._begun_s
        text = line.decode().strip()
        if text.startswith("error: "):
            raise LaunchError(text.removeprefix("error: "))
        if not text.startswith("{"):
            raise LaunchError("the spawner ended while it loaded")
        loaded = msgspec.json.decode(text, type=Loaded)
        self.names = loaded.names
        self.guard.policy = RestartPolicy(loaded.supervision)
        needed = needed_descriptors(len(self.names))
        if self._descriptors < needed:
            raise LaunchError(f"open files: the hard limit is {self._descriptors}, and "
                              f"{len(self.names)} processes need {needed}; raise it, as with "
                              f"`ulimit -Hn {needed}` in the shell of a privileged user")

    async def start(self) -> None:
        """Set simulated time 0 and start the second spawner and the supervisor.

        Raises:
            LaunchError: the spawner does not answer.
        """
        loop = asyncio.get_running_loop()
        tell_of_callbacks(loop, self._tell)
        loop.add_signal_handler(signal.SIGCHLD, self._reap)
        self.plan = msgspec.structs.replace(self.plan, origin_s=self.origin_s())
        try:
            self._spawners.set_origin(self.plan.origin_s)
            for name in self.plan.routers:
                await self.guard.fork(name, self.plan.incarnations + 1, START_PATIENCE_S)
            await self.guard.fork(f"spawner_{NAMES[1]}", 1, START_PATIENCE_S)
            await self.guard.start_supervisor(START_PATIENCE_S)
        except SpawnerUnavailableError as error:
            raise LaunchError(str(error)) from None
        if self._info is not None:
            self._info.listen(8)
            self._info.setblocking(False)
            loop.add_reader(self._info, lambda info: run_info.answer(info, self.info()), self._info)
        self._keeping = asyncio.create_task(self.guard.keep())
        watch(self._keeping, "the guard of supervisor and spawners", self.failed)

    def origin_s(self) -> float:
        """Return the reading of the monotonic clock at simulated time 0, all being loaded now."""
        return time.monotonic() + min(max(STARTUP_S[0], _LOADS * self._load_s), STARTUP_S[1])

    def failed(self, why: str) -> None:
        """Note that the run has to end, for a part of the launcher's process has failed."""
        self.failure = self.failure or why

    def _tell(self, line: str) -> None:
        self.guard.report(line)

    def supervisor_heard(self, _table: NodeTable) -> None:
        """Note that the supervisor is heard."""
        self.guard.supervisor_heard()

    def _reap(self) -> None:
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass

    def observers_bus(self) -> ZenohBus:
        """Return the bus of an observer in this process, which hears all nodes; not yet open."""
        name = on_host(OBSERVER, self.plan.host)
        return ZenohBus(name, 1, endpoints(self.plan.folder),
                        recorder=RecorderConnection(self.plan.base_port),
                        credentials=self.plan.credentials(name))

    # -- tools ----------------------------------------------------------------------------------

    def info(self) -> run_info.RunInfo:
        """Return what tools need to know of this run."""
        recording, problem = self.recording()
        return run_info.RunInfo(
            os.getpid(), self.plan.base_port, self.plan.rate, self.plan.origin_s,
            self.plan.system_file, self.plan.folder, self.names, self.plan.run_id,
            self.plan.page.port, self._title, self.plan.page.url, self.plan.description,
            host=self.plan.host, keys=self.plan.keys, ports=self.plan.ports,
            recording=recording, recording_problem=problem)

    # -- end ------------------------------------------------------------------------------------

    async def end(self) -> None:
        """End all processes of the run: in order if the supervisor can, by force what is left."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
        if self.guard.supervisor_pid:
            kill(self.guard.supervisor_pid, signal.SIGTERM)
            await self.guard.supervisor_gone(STOP_TIMEOUT_S)
        self.abort()
        if self._info is not None:
            asyncio.get_running_loop().remove_reader(self._info)
            self._info.close()
        asyncio.get_running_loop().remove_signal_handler(signal.SIGCHLD)

    def abort(self) -> None:
        """End all processes of the run at once. Harmless when there are none."""
        self._spawners.close()
        for port in self._kept_ports:
            port.close()
        for end in self._lifeline:
            if end >= 0:
                os.close(end)
        self._lifeline = (-1, -1)
        self.guard.end()
        if self._first is not None:
            self._first.kill()
        deadline = time.monotonic() + 1.0
        while kill_leftovers(self.plan.launcher_pid) and time.monotonic() < deadline:
            time.sleep(0.01)
        if self._loaded is not None:
            self._loaded.close()  # not while who writes it lives: a thread may still read it
        if self._first is not None:
            with self._first:  # which closes what leads to it and waits for it
                pass
        end_commands(self.plan.folder)
        run_folder.remove(self.plan.folder)
        self._reap()


def kept_ports(first: int, number: int = len(run_folder.ROUTERS)) -> list[socket.socket]:
    """Return sockets that keep ports of loopback for the routers of a run with keys.

    A router listens on a port that is kept all the same, for both have SO_REUSEADDR; no other run
    takes it while the router is restarted, and the kernel gives it to no outgoing connection.

    Args:
        first: of the ports that are tried.
        number: of ports.

    Raises:
        LaunchError: there are too few.
    """
    found: list[socket.socket] = []
    for port in range(first, LAST_PORT + 1):
        if len(found) == number:
            break
        kept = socket.socket()
        try:
            kept.bind(("127.0.0.1", port))
        except OSError:
            kept.close()
            continue
        kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # not before: it would fit any
        found.append(kept)
    if len(found) < number:
        raise LaunchError(f"--port {first}: no ports for the routers from there to {LAST_PORT}")
    return found


def _has_one_thread() -> bool:
    return len(list(Path("/proc/self/task").iterdir())) == 1


def _age_s() -> float:
    """Return for how long this process has existed, real seconds (proc(5), field 22 of stat)."""
    stat = Path("/proc/self/stat").read_text(encoding="utf-8", errors="replace")
    begun_s = int(stat.rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - begun_s)


def needed_descriptors(processes: int) -> int:
    """Return how many files a process of a run with so many processes may have to hold open."""
    return _DESCRIPTORS_BESIDES + _DESCRIPTORS_EACH * processes
