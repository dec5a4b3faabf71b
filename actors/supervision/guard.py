"""The launcher's guard: brings back supervisor and spawners, those that hang too.

The supervisor brings the nodes back, and needs a spawner for it; which of the three is missing
the guard replaces. Death is seen in /proc. Hanging is judged with `patience`: a process
that waits for a processor is left alone. Of two spawners that hang one is replaced first, and the
other one when that is back, so that no error of judgement leaves none.
"""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import time
from collections.abc import Callable, Mapping

from rampart.actors.bus.run_folder import issued
from rampart.actors.machine.patience import Patience, usage
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import RunProcess, find_process, find_processes, kill
from rampart.actors.supervision.processes import OsHandle
from rampart.actors.supervision.spawner import NAMES
from rampart.actors.supervision.spawner_client import SpawnerClient, SpawnerUnavailableError
from rampart.actors.supervision.supervised_process import RestartPolicy
from rampart.files.streams import complain

PERIOD_S = 0.25
SUPERVISOR_PATIENCE_S = 1.5
"""A supervisor that could have published its table (every 0.5 s at rate 1) for so long is hung."""

SPAWNER_PATIENCE_S = 1.0
"""A spawner that could have answered for so long is hung."""

LOAD_PATIENCE_S = 20.0
"""A spawner that could have loaded for so long is hung; it takes a second or two."""

_ASK_AGAIN_S = 0.01
_SPAWNERS = {f"spawner_{name}": name for name in NAMES}


class Guard:
    """Looks after the supervisor and the spawners of one run.

    Args:
        plan: of the run.
        spawners: to fork by.
        load: starts a process that loads everything and becomes the spawner of a name.

    Attributes:
        supervisor_pid: of the present supervisor, 0 before the first.
        supervisor_incarnation: likewise.
        policy: how often the supervisor is brought back.
        on_restart: called with the name of what was brought back.
        report: called with one line when something cannot be done.
    """

    def __init__(self, plan: RunPlan, spawners: SpawnerClient,
                 load: Callable[[str], subprocess.Popen[bytes]]) -> None:
        self.supervisor_pid = 0
        self.supervisor_incarnation = plan.incarnations
        self.policy = RestartPolicy()
        self.on_restart: Callable[[str], None] = lambda _name: None
        self.report: Callable[[str], None] = complain
        self._plan = plan
        self._supervisor = plan.supervisor
        self._guarded = {self._supervisor, *plan.routers, *_SPAWNERS}
        self._spawners = spawners
        self._load = load
        self._loaded: subprocess.Popen[bytes] | None = None
        self._patience = {name: Patience(2 * PERIOD_S) for name in (self._supervisor, *_SPAWNERS)}
        self._load_patience = Patience(2 * PERIOD_S)
        self._hung: set[str] = set()
        self._supervisor_due_s: float | None = None
        self._no_routers = False
        self._found: dict[str, RunProcess] = {}
        self._trouble = ""

    async def start_supervisor(self, within_s: float = PERIOD_S) -> None:
        """Start the next supervisor.

        Raises:
            SpawnerUnavailableError: no spawner answers within so many seconds.
        """
        incarnation = self.supervisor_incarnation + 1
        self.supervisor_pid = await self.fork(self._supervisor, incarnation, within_s)
        self.supervisor_incarnation = incarnation
        self._patience[self._supervisor].answered()

    async def fork(self, name: str, incarnation: int, within_s: float = PERIOD_S) -> int:
        """Fork a supervisor or spawner and return its pid, as `SpawnerClient.fork`."""
        until_s = time.monotonic() + within_s
        while True:
            try:
                return self._spawners.fork((name,), incarnation)
            except SpawnerUnavailableError:
                if time.monotonic() > until_s:
                    raise
            await asyncio.sleep(_ASK_AGAIN_S)

    def supervisor_heard(self) -> None:
        """Note that the supervisor is heard."""
        self._patience[self._supervisor].answered()

    async def keep(self) -> None:
        """Look after them until this is cancelled; whatever goes wrong, there is a next time."""
        # The pidfd wakes the guard the moment the supervisor dies; the period serves the rest.
        while True:
            try:
                await self.supervisor_gone(PERIOD_S)
                all_there = await self.look_after()
                if all_there:
                    self._trouble = ""
            except Exception as error:  # no descriptors left, or what was not thought of
                all_there = False
                why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
                self._tell(f"cannot look after supervisor and spawners: {why}")
            if not all_there:  # with no supervisor to wait for, the next round would come at once
                await asyncio.sleep(PERIOD_S)

    async def look_after(self) -> bool:
        """Bring back whichever guard is missing; False if that was not possible."""
        living = self._living()
        all_there = True
        turning = {name: self._spawners.turns(short) for name, short in _SPAWNERS.items()}
        for name, turns in turning.items():
            if turns:
                self._patience[name].answered()
                self._hung.discard(name)
            elif name not in living:
                self._hung.discard(name)
                all_there &= await self._bring_spawner_back(name, living)
            else:
                all_there &= self._judge(name, living[name].pid, turning)
        await self._bring_routers_back(living)
        supervisor = living.get(self._supervisor)
        if supervisor is not None:  # it may be a child of a spawner that died before it answered
            self.supervisor_pid = supervisor.pid
            self.supervisor_incarnation = max(self.supervisor_incarnation, supervisor.incarnation)
            if self._is_hung(self._supervisor, supervisor.pid):
                self._patience[self._supervisor].answered()
                kill(supervisor.pid)
                await self.supervisor_gone(PERIOD_S)  # its port is free only then
                supervisor = None
        if supervisor is None:
            return await self._bring_supervisor_back() and all_there
        self._supervisor_due_s = None
        return all_there

    async def supervisor_gone(self, timeout_s: float) -> None:
        """Wait until the supervisor has ended, or so many seconds."""
        gone = asyncio.Event()
        try:
            handle = OsHandle(self.supervisor_pid, gone.set)
        except (ProcessLookupError, ValueError):  # it has ended, or there was none yet
            return
        except OSError:  # no descriptor left
            await asyncio.sleep(timeout_s)
            return
        with contextlib.suppress(TimeoutError), contextlib.closing(handle):
            await asyncio.wait_for(gone.wait(), timeout_s)

    def end(self) -> None:
        """End a process that still loads."""
        if self._loaded is not None:
            with self._loaded:  # which closes its output and waits for it
                self._loaded.kill()

    # -- inside ---------------------------------------------------------------------------------

    def _living(self) -> dict[str, RunProcess]:
        """Return the processes that matter here, by name: where they were last, if all are."""
        # Four times a second: to read all of /proc took half of the launcher's processor time.
        living = {}
        for name, before in self._found.items():
            process = find_process(before.pid)
            if process == before:
                living[name] = process
        if len(living) < len(self._guarded):
            living = {}
            for process in find_processes(self._plan.base_port, self._plan.launcher_pid):
                for name in process.names:  # a child bears its spawner's name for a moment
                    if name in self._guarded:
                        living.setdefault(name, process)
            self._found = living
        return living

    def _is_hung(self, name: str, pid: int) -> bool:
        limit_s = (SUPERVISOR_PATIENCE_S / min(1.0, self._plan.rate) if name == self._supervisor
                   else SPAWNER_PATIENCE_S)
        return self._patience[name].look(time.monotonic(), pid, usage(pid)) >= limit_s

    def _judge(self, name: str, pid: int, turning: Mapping[str, bool]) -> bool:
        """Replace a spawner that hangs, if that leaves one; whether all is well so far."""
        if not self._is_hung(name, pid):
            return True
        self._hung.add(name)
        if any(turning.values()) or self._hung.issuperset(turning):
            self._hung.discard(name)
            self._patience[name].answered()
            kill(pid)
        return False

    async def _bring_routers_back(self, living: Mapping[str, RunProcess]) -> None:
        """Without any the supervisor, which looks after them, might not even start."""
        missing = living.keys().isdisjoint(self._plan.routers)
        if missing and self._no_routers:
            for name in self._plan.routers:
                await self.fork(name, issued(self._spawners.folder).get(name, 0) + 1)
        self._no_routers = missing

    async def _bring_spawner_back(self, name: str, living: Mapping[str, RunProcess]) -> bool:
        if any(n in living and n not in self._hung for n in _SPAWNERS if n != name):
            try:
                await self.fork(name, 1)
            except SpawnerUnavailableError as error:
                self._tell(f"{name} cannot be brought back yet: {error}")
                return False
        elif not self._start_loading(name):
            return False
        self.on_restart(name)
        return True

    def _start_loading(self, name: str) -> bool:
        """No spawner can fork another one: load everything once more, which takes a second or two.

        False while that is under way.
        """
        loaded = self._loaded
        if loaded is not None and loaded.poll() is None:
            spent_s = self._load_patience.look(time.monotonic(), loaded.pid, usage(loaded.pid))
            if spent_s >= LOAD_PATIENCE_S:
                loaded.kill()
            return False
        if loaded is not None and loaded.stdout is not None:
            with loaded.stdout as output:
                said = output.read().decode(errors="replace").strip()
            self._loaded = None
            if said.startswith("error: "):
                self._tell(f"a spawner does not load: {said.removeprefix('error: ')}")
                return False  # the other one may, if it is missing too
        self._loaded = self._load(_SPAWNERS[name])
        return True

    async def _bring_supervisor_back(self) -> bool:
        # At once as a rule. One that ends whenever it starts would leave nothing to anybody else.
        policy = self.policy
        delay_s = policy.delay_s(time.monotonic())
        if delay_s is None:
            self._tell(f"the supervisor ended {policy.limits.intensity} times within "
                       f"{policy.limits.period_s:.0f} s: it is started less often from now on")
            return False
        if self._supervisor_due_s is None:
            self._supervisor_due_s = time.monotonic() + delay_s
        wait_s = self._supervisor_due_s - time.monotonic()
        if wait_s > 0:
            await asyncio.sleep(min(wait_s, PERIOD_S))
        if wait_s > PERIOD_S:  # the spawners are looked after meanwhile
            return False
        try:
            await self.start_supervisor()
        except SpawnerUnavailableError as error:
            self._tell(f"the supervisor cannot be brought back yet: {error}")
            return False
        self._supervisor_due_s = None
        policy.restarted(time.monotonic())
        self.on_restart(self._supervisor)
        return True

    def _tell(self, trouble: str) -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            with contextlib.suppress(Exception):  # no reader is left: that ends no guard
                self.report(trouble)
