"""The root of a run: starts spawners and supervisor, brings them back, and cleans up after all.

The launcher owns the lifeline (see `lifeline`), is the subreaper of the run (orphans of a dead
spawner become its children, so no zombie stays), and answers tools that look for the run. It is
the last guard: the supervisor brings everybody back, the launcher brings back the supervisor.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from actors.messages import NodeTable
from actors.runtime import run_folder
from actors.runtime.tap import Tap
from actors.runtime.unix_peer import is_same_user
from actors.runtime.zenoh_bus import ZenohBus, endpoint
from actors.supervision import run_info
from actors.supervision.lifeline import kill_leftovers
from actors.supervision.process_title import find_processes
from actors.supervision.restart_policy import RestartPolicy
from actors.supervision.run_plan import OBSERVER, SUPERVISOR, RunPlan
from actors.supervision.spawner import NAMES
from actors.supervision.spawner_client import SpawnerClient, SpawnerUnavailableError

LOAD_TIMEOUT_S = 60.0
GUARD_PERIOD_S = 0.25
STARTUP_S = (1.0, 5.0)
"""Simulated time 0 lies between so many wall seconds after the start of the first actor: until
then all processes open their sessions at once, and silence is no fault. How many depends on how
long the machine took to load the first process."""

STOP_TIMEOUT_S = 1.2
SUPERVISOR_PATIENCE_S = 1.5
"""A supervisor that has not published its table (every 0.5 s at rate 1) for so long is hung."""
_PR_SET_CHILD_SUBREAPER = 36
_ROOT = Path(__file__).resolve().parents[2]


class LaunchError(Exception):
    """The run cannot be started; the text is one line for the user."""


class Launcher:
    """One run's processes. Use: `load`, then `start` on a running event loop, then `end`."""

    def __init__(self, plan: RunPlan, title: str) -> None:
        self.plan = msgspec.structs.replace(plan, launcher_pid=os.getpid())
        self.names: tuple[str, ...] = ()
        self.supervisor_incarnation = 0
        self.on_restart: Callable[[str], None] = lambda _name: None
        self.on_trouble: Callable[[str], None] = lambda _text: None
        self._title = title
        self._spawners = SpawnerClient("")
        self._lifeline: tuple[int, int] = (-1, -1)
        self._first: subprocess.Popen[bytes] | None = None
        self._begun_s = self._load_s = 0.0
        self._supervisor_pid = 0
        self._supervisor_heard_s = 0.0
        self._supervisor_due_s: float | None = None
        self._trouble = ""
        self._policy = RestartPolicy()
        self._info: socket.socket | None = None
        self._guard: asyncio.Task[None] | None = None

    # -- start ----------------------------------------------------------------------------------

    def begin(self) -> None:
        """Claim the base port and start the first spawner, which then loads in the background.

        Raises:
            LaunchError: another run has the base port, or there is no place for the run's sockets.
        """
        self._info = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._info.bind(run_info.address(self.plan.base_port))
        except OSError:
            self._info.close()
            self._info = None
            raise LaunchError(f"--port {self.plan.base_port}: in use by another run; "
                              "choose another --port") from None
        try:
            folder = run_folder.make(self.plan.base_port, os.getpid())
            run_folder.issue(folder, (OBSERVER,), 1)
        except OSError as error:
            self._info.close()
            self._info = None
            raise LaunchError(f"no folder for the run's sockets: {error}") from None
        self.plan = msgspec.structs.replace(self.plan, folder=folder)
        self._spawners = SpawnerClient(folder)
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._lifeline = os.pipe()
        self._begun_s = time.monotonic()
        self._start_first_spawner()

    def _start_first_spawner(self) -> None:
        environment = dict(os.environ, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
        environment["PYTHONPATH"] = os.pathsep.join(
            [str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        self._first = subprocess.Popen(  # noqa: S603 our own interpreter and module
            [sys.executable, "-P", "-m", "actors.supervision.spawner", str(self._lifeline[0])],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[self._lifeline[0]],
            env=environment)
        assert self._first.stdin is not None  # noqa: S101 for the type checker
        with contextlib.suppress(BrokenPipeError):  # it has died: whoever waits for it will notice
            self._first.stdin.write(msgspec.json.encode(self.plan))
            self._first.stdin.close()

    async def load(self) -> None:
        """Wait until the first spawner has loaded the plan.

        Raises:
            LaunchError: spec, airport or mission are unsound.
        """
        assert self._first is not None  # noqa: S101
        assert self._first.stdout is not None  # noqa: S101
        try:
            line = await asyncio.wait_for(
                asyncio.to_thread(self._first.stdout.readline), LOAD_TIMEOUT_S)
        except TimeoutError:
            raise LaunchError(f"the spawner did not load within {LOAD_TIMEOUT_S:.0f} s") from None
        self._load_s = time.monotonic() - self._begun_s
        text = line.decode().strip()
        if text.startswith("error: "):
            raise LaunchError(text.removeprefix("error: "))
        if not text.startswith("["):
            raise LaunchError("the spawner ended while it loaded")
        self.names = msgspec.json.decode(text, type=tuple[str, ...])

    async def start(self) -> None:
        """Set simulated time 0 and start the second spawner and the supervisor.

        Raises:
            LaunchError: the spawner does not answer.
        """
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGCHLD, self._reap)
        startup_s = min(max(STARTUP_S[0], 2 * self._load_s), STARTUP_S[1])
        self.plan = msgspec.structs.replace(self.plan, origin_s=time.monotonic() + startup_s)
        try:
            self._spawners.set_origin(self.plan.origin_s)
            self._spawners.fork((f"spawner_{NAMES[1]}",), 1)
            self._start_supervisor()
        except SpawnerUnavailableError as error:
            raise LaunchError(str(error)) from None
        self._answer_tools(loop)
        self._guard = asyncio.create_task(self._keep_guards())

    def _start_supervisor(self) -> None:
        incarnation = self.supervisor_incarnation + 1
        self._supervisor_pid = self._spawners.fork((SUPERVISOR,), incarnation)
        self.supervisor_incarnation = incarnation
        self._supervisor_heard_s = time.monotonic()

    # -- guard ----------------------------------------------------------------------------------

    def supervisor_heard(self, _table: NodeTable) -> None:
        """Note that the supervisor lives."""
        self._supervisor_heard_s = time.monotonic()

    async def _keep_guards(self) -> None:
        # The pidfd wakes the guard the moment the supervisor dies; the period serves the rest.
        while True:
            begun_s = time.monotonic()
            await self._supervisor_gone(GUARD_PERIOD_S)
            stall_s = time.monotonic() - begun_s - GUARD_PERIOD_S
            if stall_s > GUARD_PERIOD_S:  # silence counts only while this loop turned
                self._supervisor_heard_s += stall_s
            try:
                all_there = await self._look_after_guards()
                if all_there:
                    self._trouble = ""
            except OSError as error:  # no descriptors or no memory left: perhaps later
                all_there = False
                self._report(f"cannot look after supervisor and spawners: {error.strerror}")
            if not all_there:  # with no supervisor to wait for, the next round would come at once
                await asyncio.sleep(GUARD_PERIOD_S)

    async def _look_after_guards(self) -> bool:
        """Bring back whichever guard is missing; False if that was not possible."""
        living = {n: p for p in find_processes(self.plan.base_port)
                  if p.launcher == self.plan.launcher_pid for n in p.names}
        all_there = True
        for name in NAMES:
            full = f"spawner_{name}"
            if full not in living or not self._spawners.ping(name):
                all_there &= self._bring_back(full)
        supervisor = living.get(SUPERVISOR)
        if supervisor is not None:  # it may be a child of a spawner that died before it answered
            self._supervisor_pid = supervisor.pid
            self.supervisor_incarnation = max(self.supervisor_incarnation, supervisor.incarnation)
        patience_s = SUPERVISOR_PATIENCE_S / min(1.0, self.plan.rate)
        silent = time.monotonic() - self._supervisor_heard_s > patience_s
        if supervisor is not None and silent:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._supervisor_pid, signal.SIGKILL)
        if supervisor is None or silent:
            await self._supervisor_gone(GUARD_PERIOD_S)  # its port is free only then
            all_there &= await self._bring_supervisor_back()
        else:
            self._supervisor_due_s = None
        return all_there

    async def _bring_supervisor_back(self) -> bool:
        # At once as a rule. One that ends whenever it starts would leave nothing to anybody else.
        policy = self._policy
        delay_s = policy.delay_s(time.monotonic())
        if delay_s is None:
            self._report(f"the supervisor ended {policy.intensity} times within "
                         f"{policy.period_s:.0f} s: it is started less often from now on")
            return False
        if self._supervisor_due_s is None:
            self._supervisor_due_s = time.monotonic() + delay_s
        wait_s = self._supervisor_due_s - time.monotonic()
        if wait_s > 0:
            await asyncio.sleep(min(wait_s, GUARD_PERIOD_S))
        if wait_s > GUARD_PERIOD_S:  # the spawners are looked after meanwhile
            return False
        if not self._bring_back(SUPERVISOR):
            return False
        self._supervisor_due_s = None
        policy.restarted(time.monotonic())
        return True

    def _report(self, trouble: str) -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            self.on_trouble(trouble)

    async def _supervisor_gone(self, timeout_s: float) -> None:
        loop = asyncio.get_running_loop()
        try:
            pidfd = os.pidfd_open(self._supervisor_pid)
        except ProcessLookupError:
            return
        except OSError:  # no descriptor left
            await asyncio.sleep(timeout_s)
            return
        gone = loop.create_future()

        def readable() -> None:
            if not gone.done():
                gone.set_result(None)

        loop.add_reader(pidfd, readable)
        try:
            await asyncio.wait_for(gone, timeout_s)
        except TimeoutError:
            pass
        finally:
            loop.remove_reader(pidfd)
            os.close(pidfd)

    def _bring_back(self, name: str) -> bool:
        try:
            if name == SUPERVISOR:
                self._start_supervisor()
            else:
                self._spawners.fork((name,), 1)
        except SpawnerUnavailableError:
            self._restart_first_spawner()
            return False
        self.on_restart(name)
        return True

    def _restart_first_spawner(self) -> None:
        """Both spawners are gone: load everything once more, which takes a second or two."""
        if self._first is not None:
            if self._first.poll() is None:
                return
            if self._first.stdout is not None:
                self._first.stdout.close()
        self._start_first_spawner()
        self.on_restart(f"spawner_{NAMES[0]}")

    def _reap(self) -> None:
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass

    def observers_bus(self) -> ZenohBus:
        """Return the bus of an observer in this process, which hears everybody; not yet open."""
        folder = self.plan.folder
        others = [endpoint(folder, name) for name in self.names if name != OBSERVER]
        return ZenohBus(OBSERVER, 1, endpoint(folder, OBSERVER), others,
                        Tap(self.plan.base_port))

    # -- tools ----------------------------------------------------------------------------------

    def _answer_tools(self, loop: asyncio.AbstractEventLoop) -> None:
        if self._info is None:
            return
        self._info.listen(8)
        self._info.setblocking(False)
        loop.add_reader(self._info, self._answer_one)

    def _answer_one(self) -> None:
        if self._info is None:
            return
        with contextlib.suppress(OSError):
            connection, _ = self._info.accept()
            with connection:
                if is_same_user(connection):
                    connection.send(msgspec.json.encode(self.info()))

    def info(self) -> run_info.RunInfo:
        """Return what tools need to know of this run."""
        return run_info.RunInfo(
            os.getpid(), self.plan.base_port, self.plan.rate, self.plan.origin_s,
            self.plan.system_file, self.plan.folder, self.names, self.plan.run_id,
            self.plan.hmi_port, self._title, self.plan.hmi_page, self.plan.description)

    # -- end ------------------------------------------------------------------------------------

    async def end(self) -> None:
        """End all processes of the run: in order if the supervisor can, by force what is left."""
        if self._guard is not None:
            self._guard.cancel()
            await asyncio.gather(self._guard, return_exceptions=True)
        if self._supervisor_pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._supervisor_pid, signal.SIGTERM)
            await self._supervisor_gone(STOP_TIMEOUT_S)
        self.abort()
        if self._info is not None:
            asyncio.get_running_loop().remove_reader(self._info)
            self._info.close()
        asyncio.get_running_loop().remove_signal_handler(signal.SIGCHLD)

    def abort(self) -> None:
        """End all processes of the run at once. Harmless when there are none."""
        self._spawners.close()
        for end in self._lifeline:
            if end >= 0:
                os.close(end)
        self._lifeline = (-1, -1)
        if self._first is not None:
            self._first.kill()
            self._first.wait()
            if self._first.stdout is not None:
                self._first.stdout.close()
        deadline = time.monotonic() + 1.0
        while kill_leftovers(self.plan.launcher_pid) and time.monotonic() < deadline:
            time.sleep(0.01)
        run_folder.remove(self.plan.folder)
        self._reap()
