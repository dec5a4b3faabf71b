"""The supervisor: starts the processes, watches them three ways, kills and respawns them.

* *Crashed*: the process's pidfd becomes readable, at once; this works for processes that are
  not children, so a restarted supervisor adopts the living ones it finds in /proc.
* *Stopped*: no heartbeat, and the kernel says the process is stopped (SIGSTOP).
* *Wedged*: no heartbeat although the process runs: its event loop turns no more. Of the manager,
  whose silence stops the robot, the status counts as much as the heartbeat.

Who waits for a processor is neither (see `patience`): on a machine that stands still for half a
second all are silent, and replacing them all would keep it busy for longer.

What a recovery module owns (RM3, RM4) is respawned on that module's request, so that the FTM
Manager arbitrates; everything else by the supervisor itself. OTP's rules hold: start in order,
stop in reverse, SIGTERM before SIGKILL, a bounded restart intensity. What is given up on is not
hidden: a silent detection module counts as active, a silent manager stops the Safety Pilot, a
silent Safety Pilot trips the dead man. Nor is that the end: the supervisor goes on with single
attempts until one of them lasts. A request is carried out when the new process was heard: until
then the supervisor repeats it by itself, for the module that asked may have missed its deadline.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import clip
from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.messages import Diagnostic, Heartbeat, Injection, InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import (
    AdaptedSystem,
    ManagerStatus,
    NodeInfo,
    NodeState,
    NodeTable,
    ProcessEvent,
    RespawnRequest,
)
from rampart.actors.layout.layout import Layout, Unit, adapted_system
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.timer import Timer
from rampart.actors.supervision.patience import AT_LEISURE, Patience
from rampart.actors.supervision.processes import (
    Living,
    OsProcesses,
    Processes,
    ProcessHandle,
    SpawnerBusyError,
    SpawnerUnavailableError,
)
from rampart.actors.supervision.restart_policy import RestartPolicy
from rampart.manager.spec.adaptation import changed_actors
from rampart.manager.spec.specification import Kind

STOP_GRACE_S = 0.5
"""Wall seconds between SIGTERM and SIGKILL at the end of a run."""

START_TIMEOUT_S = 3.0
"""Wall seconds in which a new process must have sent its first heartbeat."""

PASSED_ON_PER_S = 200
"""Error reports, orders and results of injections that are passed on in a simulated second."""

_CHECK_S = 0.1
"""Simulated seconds between two looks at who is silent."""

_SEARCH_S = 0.05
"""Wall seconds between two looks into /proc on account of one node's messages."""

_STATUS = "fresh status of the manager"
"""Stands among the names of a process' nodes for what the Safety Pilot lives on."""

_RETRY_S = 0.05
_ASK_AGAIN_S = 0.01
_DEAD = (NodeState.CRASHED, NodeState.GIVEN_UP)
_HEALTHY = (NodeState.RUNNING, NodeState.STARTING)


@dataclass(slots=True)
class _Process:
    """One process of the run as the supervisor knows it. Times are the event loop's seconds.

    Attributes:
        unheld: It may be there, but there was no descriptor left to hold it by.
        highest: The highest incarnation that there was.
        requested_by: The module that asked for it, until it was heard.
        next_step: Of its respawn, while that is under way; there is never more than one.
    """

    unit: Unit
    policy: RestartPolicy
    patience: Patience
    pid: int = 0
    handle: ProcessHandle | None = None
    unheld: bool = False
    incarnation: int = 0
    highest: int = 0
    requested_by: str = ""
    state: NodeState = NodeState.CRASHED
    started_s: float = 0.0
    searched_s: float = -math.inf
    heard_s: dict[str, float] = field(default_factory=dict)
    next_step: Timer | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The actors in it."""
        return tuple(n.name for n in self.unit.nodes)


class Supervisor(Actor):
    """Keeps the processes of the run alive. Parameters: `nodes`, the names it watches."""

    class Parameters(Actor.Parameters, frozen=True):
        """Whom it hears: the names of all nodes."""

        nodes: tuple[str, ...] = ()

    parameters: Parameters
    outputs = (topics.NODES, topics.PROCESS_EVENT, topics.ERROR_REPORT, bus_topics.INJECT,
               bus_topics.INJECTION_RESULT)

    def __init__(self, context: Context, processes: Processes | None = None) -> None:
        super().__init__(context)
        run = context.run
        self._plan, self._spec = run.plan, run.system
        self._layout = Layout(self._plan, self._spec)
        self._machine: Processes = processes or OsProcesses(
            self._plan.base_port, self._plan.launcher_pid, self._plan.folder)
        self._processes = {
            u.name: _Process(u, RestartPolicy(), Patience(2 * _CHECK_S / self._plan.rate))
            for u in self._layout.units.values()}
        for node, incarnation in run.known_incarnations.items():
            if node in self._layout.unit_of:
                process = self._processes[self._layout.unit_of[node]]
                process.incarnation = process.highest = incarnation
        self._version = (0, run.adapted.version if run.adapted else 0)
        if run.adapted is not None:
            self._machine.adapt(run.adapted)
        self._timeout_s = self._spec.timing.heartbeat_timeout_s / self._plan.rate
        self._passed_on = RateLimit(PASSED_ON_PER_S)
        self._loop = asyncio.get_running_loop()
        self._checked_s = self._loop.time()

    @classmethod
    def names(
        cls, topic: Topic[Any], name: str, parameters: Parameters  # noqa: ARG003
    ) -> tuple[str, ...] | None:
        """Hear the heartbeats of the nodes that it starts."""
        return parameters.nodes if topic is bus_topics.HEARTBEAT else None

    # -- start and stop -------------------------------------------------------------------------

    def on_start(self) -> None:
        """Adopt what lives, start what does not, in the order of the spec."""
        living = self._machine.living()
        for process in self._processes.values():
            if self._adopt_living(process, living):
                continue
            if self.context.incarnation == 1 or self._owns(process):
                self._spawn(process, by=self.name)
        self._publish_table()

    def on_stop(self) -> None:
        """End all processes in reverse order: SIGTERM, then SIGKILL for those that linger.

        After a failure nobody is ended: the next life adopts them.
        """
        handles = []
        for process in reversed(self._processes.values()):
            if not self._stopping:
                self._unwatch(process)
            elif process.handle is not None and process.state is not NodeState.CRASHED:
                process.handle.ignore()
                handles.append(process.handle)
        self._machine.end(handles, STOP_GRACE_S)
        self._machine.close()

    # -- what it hears --------------------------------------------------------------------------

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, message: Heartbeat, header: Header) -> None:
        """Note that a node's loop turns; adopt a process that was not known, if the kernel does."""
        unit = self._layout.unit_of.get(header.source)
        if unit is None:
            return
        process = self._processes[unit]
        if header.incarnation > process.incarnation or (
                header.incarnation == process.incarnation and process.pid != message.pid
                and process.state in _DEAD):
            self._look_for(process)
        if (header.incarnation, message.pid) != (process.incarnation, process.pid):
            return
        if process.next_step is not None:  # said before it was killed
            return
        process.heard_s[header.source] = self._loop.time()
        process.requested_by = ""
        if process.state in (NodeState.STARTING, NodeState.STOPPED, NodeState.WEDGED):
            resumed = process.state is not NodeState.STARTING
            process.state = NodeState.RUNNING
            self._event(process, "resumed" if resumed else "running", self.name)
            self._publish_table()

    @on(topics.MANAGER_STATUS)
    def manager(self, _status: ManagerStatus, header: Header) -> None:
        """Note that the manager is heard, or was when it said so: old news is no sign of life."""
        process = self._processes.get(self._layout.unit_of.get(header.source, ""))
        if process is None or header.incarnation != process.incarnation or (
                process.next_step is not None):
            return
        age_s = max(0.0, self.clock.now() - header.stamp) / self._plan.rate
        process.heard_s[_STATUS] = max(
            process.heard_s.get(_STATUS, -math.inf), self._loop.time() - age_s)

    @on(bus_topics.DIAGNOSTIC)
    def diagnostic(self, message: Diagnostic, _header: Header) -> None:
        """Pass a node's error report on to whoever shows it, unless there are too many."""
        if self._passed_on.allows(self.clock.now()):
            self.publish(topics.ERROR_REPORT, message)

    @on(bus_topics.INJECTION_REQUEST)
    def inject(self, message: Injection, _header: Header) -> None:
        """Order a fault for the operator's page; whoever publishes the topic hears it."""
        if self._passed_on.allows(self.clock.now()):
            self.publish(bus_topics.INJECT, message)

    @on(bus_topics.INJECTION_REPORT)
    def injected(self, message: InjectionReport, _header: Header) -> None:
        """Pass on what came of a fault."""
        if self._passed_on.allows(self.clock.now()):
            self.publish(bus_topics.INJECTION_RESULT, message)

    @on(topics.ADAPTED_SYSTEM)
    def adapted(self, message: AdaptedSystem, header: Header) -> None:
        """Fork by the changed system from now on, and start the changed modules anew."""
        # A manager that died before it was heard counts from an older version.
        version = (header.incarnation, message.version)
        if version <= self._version:
            return
        self._version = version
        try:
            layout, _ = adapted_system(self._layout, self.context.run, message)
        except ValueError as error:
            self.report_diagnostic("adaptation", " ".join(str(error).split()), message.change)
            return
        self._machine.adapt(message)
        changed = changed_actors(self._spec, layout.spec)
        self._layout, self._spec = layout, layout.spec
        for unit in {self._layout.unit_of[name] for name in changed}:
            process = self._processes[unit]
            process.unit = self._layout.units[unit]
            self._anew(process)
            self._event(process, "adapted", self.name, message.change)
            self._respawn(process, self.name)

    @on(topics.RESPAWN)
    def respawn(self, request: RespawnRequest, _header: Header) -> None:
        """Kill what is left of a node and start it anew, once per failed incarnation."""
        unit = self._layout.unit_of.get(request.node)
        if unit is None:
            self.publish(topics.PROCESS_EVENT, ProcessEvent(
                request.node, "refused", 0, 0, request.by,
                clip(f"no such node: {request.node!r}")))
            return
        process = self._processes[unit]
        if process.state in _HEALTHY and process.incarnation > request.failed_incarnation:
            self._event(process, "respawned", request.by, "already")
            return
        process.requested_by = request.by
        self._respawn(process, request.by)

    # -- watching -------------------------------------------------------------------------------

    @every(_CHECK_S)
    def check(self) -> None:
        """Look for processes whose loops are silent."""
        now = self._loop.time()
        self._discount_own_stall(now)
        for process in self._processes.values():
            if process.state is NodeState.STARTING:
                if self._has_been_silent(process, process.started_s, START_TIMEOUT_S):
                    self._event(process, "wedged", self.name, "no heartbeat after its start")
                    self._lost(process, NodeState.WEDGED)
            elif process.state is NodeState.RUNNING:
                silent = [n for n, at in process.heard_s.items() if now - at > self._timeout_s]
                heard_s = min(process.heard_s.values(), default=now)
                if self._has_been_silent(process, heard_s, self._timeout_s) and silent:
                    self._silent(process, silent)

    def _has_been_silent(self, process: _Process, since_s: float, limit_s: float) -> bool:
        """Whether a process that is silent since then could have been heard for so long."""
        now = self._loop.time()
        if now - since_s <= limit_s / 2:  # not worth a look into /proc
            process.patience.answered()
            return False
        used = process.handle.usage() if process.handle is not None else AT_LEISURE
        return process.patience.look(now, process.pid, used, since_s) > limit_s

    @every(0.5)
    def repeat(self) -> None:
        """Repeat the node table for whoever joined late."""
        self._publish_table()
        left_out = self._passed_on.left_out(self.clock.now())
        if left_out:
            self.report_diagnostic(
                "passing on", f"{left_out} more messages were not passed on", self.name)

    def _discount_own_stall(self, now: float) -> None:
        # Who was stopped, starved or waiting for a hung spawner has heard nobody meanwhile. What
        # was said is still on its way here, and silence counts only while this loop turned.
        period_s = _CHECK_S / self._plan.rate
        stall_s = now - self._checked_s - period_s
        self._checked_s = now
        if stall_s > period_s:
            for process in self._processes.values():
                process.started_s = min(now, process.started_s + stall_s)
                process.heard_s = {n: min(now, at + stall_s) for n, at in process.heard_s.items()}

    def _silent(self, process: _Process, nodes: list[str]) -> None:
        stopped = process.handle is not None and process.handle.stopped()
        state = NodeState.STOPPED if stopped else NodeState.WEDGED
        self._event(process, state.value, self.name, f"no {_STATUS}" if nodes == [_STATUS] else (
            f"no heartbeat from {', '.join(name for name in nodes if name != _STATUS)}"))
        self._lost(process, state)

    def _lost(self, process: _Process, state: NodeState) -> None:
        process.state = state
        self._publish_table()
        if self._owns(process) or process.policy.attempts or process.requested_by:
            self._respawn(process, process.requested_by or self.name)

    def _exited(self, process: _Process, pid: int) -> None:
        if process.pid != pid:  # it was replaced while the news waited in the mailbox
            return
        self._process_ended(process)

    def _process_ended(self, process: _Process, detail: str = "") -> None:
        self._unwatch(process)
        if process.next_step is not None or process.state is NodeState.GIVEN_UP:
            return
        self._event(process, "crashed", self.name, detail)
        if process.state is NodeState.STARTING:
            # Never heard: another life that nobody holds may have its port.
            process.searched_s = -math.inf
            if self._look_for(process):
                return
        self._lost(process, NodeState.CRASHED)

    def _owns(self, process: _Process) -> bool:
        """Whether the supervisor itself brings the process back."""
        return (self._spec.layers.supervisor_respawn
                and process.unit.respawn == self.name
                and process.unit.kind != Kind.WORLD.value)

    # -- acting ---------------------------------------------------------------------------------

    def _respawn(self, process: _Process, by: str) -> None:
        if process.next_step is not None:
            if process.state is NodeState.GIVEN_UP:
                self._event(process, "given up", by, "an attempt will follow by itself")
            return
        delay_s = process.policy.delay_s(self._loop.time())
        if process.handle is not None:
            process.handle.ignore()
            process.handle.kill()
        if delay_s is None:
            self._give_up(process, by)
            return
        if process.state in _HEALTHY:
            process.state = NodeState.CRASHED
        if delay_s > 0 or not _is_gone(process):
            # The port is free only when the old process is: a few more milliseconds.
            self._go_on(process, max(delay_s, 0.002), lambda: self._finish_respawn(process, by))
        else:
            self._finish_respawn(process, by)

    def _give_up(self, process: _Process, by: str) -> None:
        policy, failed = process.policy, process.policy.attempts
        wait_s = policy.attempt_in_s(self._loop.time())
        process.state = NodeState.GIVEN_UP
        self._event(process, "given up", by, (
            f"attempt {failed} failed" if failed else
            f"{policy.intensity} restarts in {policy.period_s:.0f} s"
        ) + f", the next attempt is in {wait_s:.0f} s")
        self._publish_table()
        self._go_on(process, wait_s, lambda: self._finish_respawn(process, self.name))

    def _anew(self, process: _Process) -> None:
        """Forget that it was given up: it will be another one, and may do better."""
        if process.state is NodeState.GIVEN_UP and process.next_step is not None:
            process.next_step.cancel()
            process.next_step, process.policy = None, RestartPolicy()

    def _go_on(self, process: _Process, delay_s: float, step: Callable[[], None]) -> None:
        process.next_step = self.call_later(delay_s * self.clock.rate, step)

    def _finish_respawn(self, process: _Process, by: str) -> None:
        if not _is_gone(process):
            self._go_on(process, 0.002, lambda: self._finish_respawn(process, by))
            return
        process.policy.restarted(self._loop.time())
        self._spawn(process, by)

    def _spawn(self, process: _Process, by: str) -> None:
        incarnation = process.highest + 1
        try:
            pid = self._machine.fork(process.names, incarnation)
        except SpawnerBusyError:
            self._go_on(process, _ASK_AGAIN_S, lambda: self._spawn(process, by))
            return
        except (SpawnerUnavailableError, OSError) as error:
            self.report_diagnostic("fork", str(error), process.unit.name)
            self._go_on(process, _RETRY_S, lambda: self._spawn(process, by))
            return
        first = process.highest == 0
        self._take(process, pid, incarnation)
        process.state = NodeState.STARTING
        process.started_s = self._loop.time()
        attempt = process.policy.attempts
        self._event(process, "started" if first else "respawned", by, (
            f"attempt {attempt} since it was given up" if attempt else ""))
        self._publish_table()
        self._hold(process, pid)

    def _adopt(self, process: _Process, pid: int, incarnation: int) -> None:
        self._take(process, pid, incarnation)
        process.state = NodeState.RUNNING
        now = self._loop.time()
        process.heard_s = dict.fromkeys(process.names, now)
        self._event(process, "adopted", self.name)
        self._hold(process, pid)

    def _look_for(self, process: _Process) -> bool:
        """Adopt what lives and was not known, as the kernel knows it: a message may name any pid.

        Returns:
            Whether there is one.
        """
        now = self._loop.time()
        if now - process.searched_s < _SEARCH_S:
            return False
        process.searched_s = now
        try:
            return self._adopt_living(process, self._machine.living())
        except OSError as error:  # no descriptor left to look with
            self.report_diagnostic("search", str(error), process.unit.name)
            return False

    def _adopt_living(self, process: _Process, living: Sequence[Living]) -> bool:
        """Adopt the highest life that is there and end the others; False if there is none."""
        found = sorted((p for p in living if p.names == process.names),
                       key=lambda p: p.incarnation, reverse=True)
        for other in found[1:]:
            with contextlib.suppress(OSError):  # gone, or for the next search
                handle = self._machine.hold(other.pid, lambda: None)
                handle.kill()
                handle.close()
        if found and (found[0].pid != process.pid or process.state in _DEAD):
            self._adopt(process, found[0].pid, found[0].incarnation)
        return bool(found)

    def _take(self, process: _Process, pid: int, incarnation: int) -> None:
        if process.next_step is not None:
            process.next_step.cancel()
            process.next_step = None
        self._unwatch(process)
        process.pid, process.incarnation, process.heard_s = pid, incarnation, {}
        process.highest = max(process.highest, incarnation)

    def _hold(self, process: _Process, pid: int) -> None:
        if process.pid != pid:  # it was replaced while this waited
            return
        try:
            process.handle = self._machine.hold(pid, lambda: self._mailbox.put_latest(
                f"exit {pid}", lambda: self._exited(process, pid)))
        except ProcessLookupError:
            self._process_ended(process, "it ended before it could be watched")
            return
        except OSError as error:  # no descriptor left: perhaps later
            process.unheld = True
            self.report_diagnostic("hold", str(error), process.unit.name)
            self.call_later(_RETRY_S * self.clock.rate, lambda: self._hold(process, pid))
            return
        process.unheld = False
        if process.next_step is not None or process.state is NodeState.GIVEN_UP:
            process.handle.ignore()
            process.handle.kill()

    def _unwatch(self, process: _Process) -> None:
        process.unheld = False
        if process.handle is not None:
            process.handle.close()
            process.handle = None

    # -- what it says ---------------------------------------------------------------------------

    def _event(self, process: _Process, event: str, by: str, detail: str = "") -> None:
        for node in process.unit.nodes:
            self.publish(topics.PROCESS_EVENT, ProcessEvent(
                node.name, event, process.pid, process.incarnation, by, clip(detail)))

    def _publish_table(self) -> None:
        rows = [NodeInfo(self.name, Kind.SUPERVISION.value, self.context.pid, NodeState.RUNNING,
                         self.context.incarnation, self.context.incarnation - 1)]
        rows += [
            NodeInfo(node.name, node.kind.value, p.pid, p.state, p.incarnation,
                     max(0, p.incarnation - 1))
            for p in self._processes.values() for node in p.unit.nodes
        ]
        self.publish(topics.NODES, NodeTable(tuple(rows)))


def _is_gone(process: _Process) -> bool:
    return not process.unheld and (process.handle is None or process.handle.gone())
