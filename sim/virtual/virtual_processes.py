"""The processes of a virtual run: actors as tasks that can be started, killed, stopped and slowed.

This module models the kernel, the root and the pool. It reports a death to the supervisor after the
measured delay, and restarts the supervisor. The actors and the supervisor are the real ones.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from itertools import count
from typing import Any

import msgspec

from rampart.actors.ftm.messages import AdaptedSystem, NodeTable
from rampart.actors.machine.patience import Usage
from rampart.actors.runtime import checkpoint
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.supervision.processes import Answer, ProcessHandle, RunProcess
from rampart.actors.supervision.root import PERIOD_S, SUPERVISOR_PATIENCE_S
from rampart.actors.supervision.supervised_process import RestartPolicy
from rampart.actors.supervision.supervisor import Supervisor
from rampart.actors.system.layout import Layout, adapted_system
from rampart.manager.spec.nodes import Kind
from rampart.sim.virtual.network import drawer, measured
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus

FIRST_PID = 1000


class Condition(Enum):
    """Condition of a process."""

    STARTING = "starting"
    RUNNING = "running"
    STOPPED = "stopped"
    WEDGED = "wedged"
    ENDED = "ended"


_CHANGES = {
    "stop": (Condition.RUNNING, Condition.STOPPED),
    "wedge": (Condition.RUNNING, Condition.WEDGED),
    "resume": (Condition.STOPPED, Condition.RUNNING)}
"""Condition before and after each way to hold or resume a process."""


class VirtualProcess(msgspec.Struct, eq=False):
    """One process: its actors, with their buses and tasks."""

    pid: int
    names: tuple[str, ...]
    incarnation: int
    condition: Condition = Condition.STARTING
    actors: list[tuple[Actor, VirtualBus, asyncio.Task[None]]] = []
    holders: list[Callable[[], None]] = []
    gone: bool = False
    held_s: float = math.inf


@dataclass(eq=False, slots=True)
class _Handle(ProcessHandle):
    """The supervisor's hold on a process."""

    machine: VirtualMachine
    process: VirtualProcess
    ended: Callable[[], None]

    def kill(self) -> None:
        self.machine.kill_process(self.process)

    def gone(self) -> bool:
        return self.process.gone

    def stopped(self) -> bool:
        return self.process.condition is Condition.STOPPED

    def ignore(self) -> None:
        if self.ended in self.process.holders:
            self.process.holders.remove(self.ended)

    close = ignore


class VirtualMachine:
    """A machine on a virtual loop; it implements `Processes` for the supervisor.

    Args:
        layout: Layout of the run.
        run: Common context of all actors.
        hub: Hub of their buses.
        clock: Simulated time; its source is the loop's time.
        seed: Seed of all delays.

    Attributes:
        failures: Actors that ended by an error, with the error.
        on_restart: Called with the name of a restarted supervisor.
        shelves: Checkpoints of the nodes; they outlive the processes.
    """

    has_routers = False

    def __init__(self, layout: Layout, run: RunContext, hub: Hub, clock: Clock, seed: Any) -> None:
        self.failures: list[tuple[str, BaseException]] = []
        self.on_restart: Callable[[str], None] = lambda _name: None
        self.shelves: dict[str, list[checkpoint.Record]] = {}
        self._layout = layout
        self._run = run
        self._hub = hub
        self._clock = clock
        dice, timing = random.Random(f"processes {seed}"), measured()  # noqa: S311 no secret
        self._start_s = drawer(timing.start_ms, dice)
        self._exit_s = drawer(timing.exit_ms, dice)
        self._death_s = drawer(timing.death_ms, dice)
        self._supervisor_back_s = drawer(timing.supervisor_back_ms, dice)
        self._loop = asyncio.get_running_loop()
        self._pids = count(FIRST_PID)
        self._processes: dict[int, VirtualProcess] = {}
        self._slow: dict[str, float] = {}
        self._known: dict[str, int] = {}
        self._supervisor = 0
        self._spared = {node.name for node in layout.spec.nodes if node.kind is Kind.WORLD}
        self._policy = RestartPolicy(layout.spec.supervision)
        self._supervisor_heard_s = 0.0
        self._down = False

    # -- the launcher's part --------------------------------------------------------------------

    def start(self) -> None:
        """Start the supervisor, which starts the rest."""
        self._start_supervisor()
        self._loop.call_later(PERIOD_S, self._guard)

    def supervisor_heard(self, table: NodeTable) -> None:
        """Note that the supervisor works, and the incarnations that it reports."""
        self._supervisor_heard_s = self._loop.time()
        for row in table.nodes:
            self._known[row.name] = max(self._known.get(row.name, 0), row.incarnation)

    def _start_supervisor(self) -> None:
        self._supervisor += 1
        self._run = replace(self._run, known_incarnations=dict(self._known))
        self.fork((SUPERVISOR,), self._supervisor, lambda _pid, _error: None)
        self._supervisor_heard_s = self._loop.time()

    def _bring_supervisor_back(self) -> None:
        if self._down:
            return
        delay_s = self._policy.delay_s(self._loop.time())
        if delay_s is None:  # too often: see again later, as the launcher's guard does
            self._loop.call_later(PERIOD_S, self._bring_supervisor_back)
        elif delay_s > 0:
            self._loop.call_later(delay_s, self._supervisor_back)
        else:
            self._supervisor_back()

    def _supervisor_back(self) -> None:
        if not self._down:
            self._policy.restarted(self._loop.time())
            self._start_supervisor()
            self.on_restart(SUPERVISOR)

    def _guard(self) -> None:
        if self._down:
            return
        self._loop.call_later(PERIOD_S, self._guard)
        if self._is_paused():  # the launcher with it
            self._supervisor_heard_s = self._loop.time()
        if self._loop.time() - self._supervisor_heard_s > SUPERVISOR_PATIENCE_S:
            self.hit("kill", SUPERVISOR)

    def _is_paused(self) -> bool:
        """Whether all processes that can be hit are stopped."""
        return all(process.condition is Condition.STOPPED for process in self._processes.values()
                   if not self._spared.issuperset(process.names))

    def shut_down(self) -> None:
        """End all processes at the end of the run."""
        self._down = True
        for process in list(self._processes.values()):
            self._end(process)

    # -- Processes: what the supervisor asks for ------------------------------------------------

    def living(self) -> list[RunProcess]:
        """Return all processes, including the supervisor's."""
        return [RunProcess(p.pid, 0, 0, p.names, p.incarnation) for p in self._processes.values()]

    def fork(self, names: tuple[str, ...], incarnation: int, answer: Answer) -> None:
        """Start a process; its first message comes after the measured time."""
        if self._down:
            raise ProcessLookupError("the machine is down")
        pid = next(self._pids)
        process = self._processes[pid] = VirtualProcess(pid, names, incarnation)
        for name in names:
            self._known[name] = max(self._known.get(name, 0), incarnation)
        self._loop.call_later(self._start_s(), self._begin, process)
        answer(pid, "")

    def hold(self, pid: int, ended: Callable[[], None]) -> _Handle:
        """Take hold of a process."""
        process = self._processes.get(pid)
        if process is None:
            raise ProcessLookupError(pid)
        process.holders.append(ended)
        return _Handle(self, process, ended)

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Start processes by a changed system from now on."""
        self._layout, self._run = adapted_system(self._layout, self._run, adapted)

    def scheduled(self, pid: int) -> Usage:
        """Return what a process has run: always a little, unless it is stopped or hangs."""
        process = self._processes.get(pid)
        if process is None:
            return Usage("X", 0.0, 0.0)
        stopped = process.condition is Condition.STOPPED
        return Usage("T" if stopped else "S", min(self._loop.time(), process.held_s), 0.0)

    # -- what can happen to a process -----------------------------------------------------------

    def hit(self, what: str, node: str, pace_s: float = 0.0) -> bool:
        """Do something to a node's process, as a `ProcessControl`.

        A wedged process is still there. A slow node is slow after a restart, too.
        """
        if what == "slow":
            self._slow[node] = pace_s
        process = next((p for p in reversed(self._processes.values()) if node in p.names), None)
        if process is None:
            return False
        if what == "kill":
            self.kill_process(process)
        elif what == "slow":
            for actor, _, _ in process.actors:
                if actor.name == node:
                    actor.slow_down(pace_s)
        else:
            before, after = _CHANGES[what]
            if process.condition is not before:
                return False
            process.condition = after
            process.held_s = math.inf if after is Condition.RUNNING else self._loop.time()
            for actor, _, _ in process.actors:
                actor.hold(after is not Condition.RUNNING)
        return True

    def kill_process(self, process: VirtualProcess) -> None:
        """End a process, and let it be noticed as fast as a SIGKILL is."""
        if process.condition is Condition.ENDED:
            return
        self._end(process)
        exit_s, death_s = self._exit_s(), self._death_s()
        self._loop.call_later(exit_s, self._exited, process)
        if SUPERVISOR in process.names:
            self._loop.call_later(self._supervisor_back_s(), self._bring_supervisor_back)
        self._loop.call_later(max(death_s, exit_s), self._token_gone, process)

    # -- inside ---------------------------------------------------------------------------------

    def _begin(self, process: VirtualProcess) -> None:
        if process.condition is not Condition.STARTING:
            return
        process.condition = Condition.RUNNING
        for name in process.names:
            member = self._layout.members[name]
            bus = VirtualBus(self._hub, name, process.incarnation)
            context = Context(
                name, process.incarnation, self._clock, bus, member.parameters, self._run,
                process.pid, self._store(name, process.incarnation),
                self._layout.spec.timing.heartbeat_period_s, register=self._known.get,
                members=frozenset(self._layout.members), topics=self._layout.topics,
                usage=lambda _pid: None, scheduled=self.scheduled)
            try:
                actor = Supervisor(context, self) if name == SUPERVISOR else member.actor(context)
            except Exception as error:
                self._failed(process, name, error)
                return
            if self._slow.get(name):
                actor.slow_down(self._slow[name])
            task = self._loop.create_task(actor.run())
            process.actors.append((actor, bus, task))
            task.add_done_callback(partial(self._task_done, process, name))

    def _store(self, name: str, incarnation: int) -> checkpoint.CheckpointStore | None:
        if not self._layout.spec.layers.checkpoints:
            return None
        shelf = self.shelves.setdefault(name, [])
        return checkpoint.MemoryCheckpoints(shelf, incarnation)

    def _task_done(self, process: VirtualProcess, name: str, task: asyncio.Task[None]) -> None:
        error = None if task.cancelled() else task.exception()
        if process.condition is not Condition.ENDED:  # else it was being killed
            self._failed(process, name, error or RuntimeError("ended by itself"))

    def _failed(self, process: VirtualProcess, name: str, error: BaseException) -> None:
        self.failures.append((name, error))
        self.kill_process(process)

    def _end(self, process: VirtualProcess) -> None:
        process.condition = Condition.ENDED
        self._processes.pop(process.pid, None)
        for actor, bus, task in process.actors:
            bus.cut()
            actor.abandon()
            task.cancel()

    def _exited(self, process: VirtualProcess) -> None:
        process.gone = True
        for ended in list(process.holders):
            ended()
        process.holders.clear()

    def _token_gone(self, process: VirtualProcess) -> None:
        for name in process.names:
            if process.incarnation in self._hub.alive.get(name, ()):
                self._hub.announce(name, process.incarnation, alive=False)
