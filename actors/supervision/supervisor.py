"""The supervisor: starts the processes of a host, observes their deaths, and restarts them.

* *Crashed*: the pidfd of the process becomes readable, at once. A pidfd needs no parent, so a
  restarted supervisor adopts the processes that it finds in /proc.
* *Stopped*: no heartbeat arrives, and the kernel reports that the process is stopped (SIGSTOP).
* *Wedged*: no heartbeat arrives although the process runs, so its event loop hangs. The silence of
  the manager stops the robot, so its status counts like its heartbeat.

A process that waits for a processor is neither (`patience`). `supervised_process` has the states.

A recovery module that owns nodes (RM3, RM4) requests their restart, so the FTM Manager arbitrates.
The supervisor restarts all others by itself. When the program of a command ends, the process of its
node stays and reports that. It starts the program again when it reads "respawned", as the next
incarnation. Processes start in the order of the specification, and restart intensity is bounded
(OTP). A request stays open until a heartbeat of the new process arrives.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, ClassVar

from msgspec.structs import replace

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import clip
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.run_folder import restarts_of
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.foreign.descendants import kill_orphans
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.ftm.lateness import Lateness
from rampart.actors.machine.absence import Absence
from rampart.actors.machine.patience import Patience
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.processes import (
    OsProcesses,
    Processes,
    ProcessHandle,
    RunProcess,
)
from rampart.actors.supervision.supervised_process import (
    MANY,
    MANY_SHARE,
    STATUS,
    Action,
    Event,
    Lives,
    RestartPolicy,
    State,
    SupervisedProcess,
)
from rampart.actors.system.layout import Layout, Unit, adapted_system
from rampart.manager.spec.adaptation import changed_actors
from rampart.manager.spec.schema import Kind
from rampart.manager.spec.tables import FAILOVER_S

_CHECK_S = 0.1
"""Simulated seconds between two checks for silent processes."""

_LATE_S = 0.02
"""Wall seconds of lateness that show that the supervisor itself lacks processor time."""
_ROUTERS_S = 0.03
"""Wall seconds between two checks for stopped routers."""

_GONE_S, _RETRY_S = 0.002, 0.05
"""Wall seconds between two checks whether a killed process is gone, and between two attempts."""


class Supervisor(Actor):
    """Keeps the processes of the run running."""

    class Parameters(Actor.Parameters, frozen=True):
        """The names of all nodes, whose heartbeats it subscribes to."""

        nodes: tuple[str, ...] = ()

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.NODES, topics.PROCESS_EVENT)

    def __init__(self, context: Context, processes: Processes | None = None) -> None:
        super().__init__(context)
        run = context.run
        self._plan, self._spec = run.plan, run.system
        self._layout = Layout(self._plan, self._spec)
        self._machine: Processes = processes or OsProcesses(
            self._plan.folder, self._plan.base_port, self._plan.launcher_pid, run.root,
            self.call_soon, manager_works=self._manager_works)
        self._routers = self._layout.routers if self._machine.has_routers else {}
        self._processes = {
            name: self._held(unit) for name, unit in {**self._routers, **self._layout.here}.items()}
        self._version = (0, run.adapted.version if run.adapted else 0)
        self._timeout_s = self._spec.timing.heartbeat_timeout_s / self._plan.rate
        self._loop = asyncio.get_running_loop()
        self._checked_s = self._loop.time()
        self._absence = Absence(self._checked_s)
        self._lateness = Lateness()
        self._beats: dict[str, tuple[float, Heartbeat]] = {}

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:  # noqa: ARG003
        """Subscribe to the heartbeats of the nodes that it starts."""
        return parameters.nodes if topic is bus_topics.HEARTBEAT else None

    def listens(self, topic: Topic[Any]) -> bool:
        """Subscribe to the ends of programs only if a node has one."""
        return topic is not topics.PROGRAM_END or any(node.command for node in self._spec.nodes)

    def _held(self, unit: Unit) -> SupervisedProcess:
        known = self.context.run.known_incarnations
        highest = max((known.get(node.name, 0) for node in unit.nodes), default=0)
        limits = unit.nodes[0].restart.within(self._spec.supervision)
        return SupervisedProcess(
            unit, RestartPolicy(limits), Patience(2 * _CHECK_S / self._plan.rate),
            incarnation=highest, highest=highest, lives=Lives(limits))

    def _process_of(self, node: str) -> SupervisedProcess | None:
        return self._processes.get(
            node if node in self._routers else self._layout.unit_of.get(node, ""))

    # -- its units, which a supervisor of one host of several changes -----------------------------

    def units_at_start(self, running: Collection[str]) -> Iterable[str]:  # noqa: ARG002
        """Return the units that it supervises from its start on.

        Args:
            running: Units that already run on this machine.
        """
        return self._layout.here

    def take_on(self, unit: str, above: int) -> None:
        """Start a unit and supervise it.

        Args:
            unit: Its name.
            above: Incarnations of its processes have to exceed this number.
        """
        process = self._processes[unit] = self._held(self._layout.units[unit])
        process.incarnation = process.highest = above
        self._on(process, Event.START)

    def hand_over(self, unit: str) -> SupervisedProcess | None:
        """Kill a unit and release it; return its process, which may not have ended yet."""
        process = self._processes.pop(unit, None)
        if process is not None:
            process.forget_step()
            process.kill()
            self._report(process, "handed over", self.name)
        return process

    @property
    def layout(self) -> Layout:
        """The layout of the system, with its changes."""
        return self._layout

    def highest_of(self, node: str) -> int:
        """Return the highest incarnation of a node; 0 if the node is not supervised here."""
        process = self._process_of(node)
        return process.highest if process else 0

    def _supervises(self, process: SupervisedProcess) -> bool:
        return self._processes.get(process.unit.name) is process

    # -- start and stop -------------------------------------------------------------------------

    def on_start(self) -> None:
        """Adopt the processes that run and start the others, in the order of the spec."""
        living = self._machine.living()
        running = {self._layout.unit_of.get(process.names[0], "") for process in living}
        units = self.units_at_start(running - {""})
        self._processes = {
            name: self._processes.get(name) or self._held(self._layout.units[name])
            for name in (*self._routers, *units)}
        for process in self._processes.values():
            self._end_programs(process)
            if not self._adopt_living(process, living) and (
                    self._incarnation == self._plan.incarnations + 1 or self._owns(process)):
                self._on(process, Event.START)
        self.publish_table()
        if self._routers:
            self._look_at_routers()

    def on_stop(self) -> None:
        """Release all processes: the next supervisor adopts them, or the root ends them."""
        for process in self._processes.values():
            process.release()

    def _manager_works(self) -> bool:
        """Whether the status of the manager is fresh; always on a host without a manager."""
        limit_s = self._spec.timing.manager_timeout_s / self._plan.rate
        return all(self._loop.time() - process.heard_s.get(STATUS, -math.inf) <= limit_s
                   for process in self._processes.values()
                   if process.unit.kind == Kind.MANAGER.value)

    # -- messages -------------------------------------------------------------------------------

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, message: Heartbeat, header: Header) -> None:
        """Note that the event loop of a node works."""
        process = self._process_of(header.source)
        if process is None:
            return
        if process.waits or (
                header.incarnation, message.pid) != (process.incarnation, process.pid):
            return  # sent before the kill, or by another process
        age_s = (self.clock.now() - self.came_s(header)) / self._plan.rate
        process.heard_s[header.source] = heard_s = self._loop.time() - age_s
        process.lives.worked(heard_s)
        self._lateness.note(header.source, message.late_s)
        self._beats[header.source] = header.stamp, message
        process.requested_by = ""
        self._on(process, Event.HEARTBEAT)

    @on(topics.MANAGER_STATUS)
    def manager(self, _status: fm.ManagerStatus, header: Header) -> None:
        """Note the stamp of a status: an old one does not show that the manager works now."""
        process = self._process_of(header.source)
        if process is None or header.incarnation != process.incarnation or process.waits:
            return
        age_s = max(0.0, self.clock.now() - header.stamp) / self._plan.rate
        process.heard_s[STATUS] = max(
            process.heard_s.get(STATUS, -math.inf), self._loop.time() - age_s)

    @on(topics.ADAPTED_SYSTEM)
    def adapted(self, message: fm.AdaptedSystem, header: Header) -> None:
        """Use the changed system for later forks, and restart the changed modules."""
        # The successor of a manager that died after the change counts from an older version.
        version = (header.incarnation, message.version)
        if version <= self._version:
            return
        try:
            layout, _ = adapted_system(self._layout, self.context.run, message)
            self._machine.adapt(message)
        except (ValueError, OSError) as error:  # the manager repeats the message
            self.report_diagnostic("adaptation", " ".join(str(error).split()), message.change)
            return
        self._version = version
        changed = changed_actors(self._spec, layout.spec)
        self._layout, self._spec = layout, layout.spec
        for unit in {self._layout.unit_of[name] for name in changed} & self._processes.keys():
            process = self._processes[unit]
            process.unit = self._layout.units[unit]
            if process.step(Event.ADAPTED):  # it was given up, and may work now
                process.forget_step()
                process.policy = RestartPolicy(process.policy.limits)
            self._report(process, "adapted", self.name, message.change)
            self._restart(process, self.name)

    @on(topics.RESPAWN)
    def respawn(self, request: fm.RespawnRequest, _header: Header) -> None:
        """Kill and restart a node, once per failed incarnation."""
        process = self._process_of(request.node)
        if process is None:
            if request.node not in self._layout.unit_of:  # else the other host's supervisor answers
                self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
                    request.node, "refused", 0, 0, request.by, clip(f"no node {request.node!r}")))
        elif (process.state in (State.STARTING, State.RUNNING)
              and process.incarnation > request.failed_incarnation):
            self._report(process, "respawned", request.by, "already")
        else:
            process.requested_by = request.by
            self._restart(process, request.by)

    @on(topics.PROGRAM_END)
    def program_ended(self, message: fm.ProgramEnd, header: Header) -> None:
        """Treat the end of a command's program as the end of its incarnation."""
        process = self._process_of(header.source)
        if process is None or message.pid != process.pid:
            return
        if header.incarnation < process.incarnation:
            self._report(process, "respawned", self.name, "already")
        elif process.state is not State.CRASHED and not process.waits:
            if len(process.names) > 1:  # the nodes of a process share an incarnation
                process.handle.kill()
                return
            process.stays = True
            self._on(process, Event.ENDED, detail=message.detail)

    # -- watching -------------------------------------------------------------------------------

    @every(_CHECK_S)
    def check(self) -> None:
        """Look for processes whose event loops are silent."""
        # Silence counts only while this event loop worked: after a stop or without a processor it
        # has messages to read first. Nor does it count if the router died that delivers them.
        self.read_postings()
        now, period_s = self._loop.time(), _CHECK_S / self._plan.rate
        stall_s, self._checked_s = now - self._checked_s - period_s, now
        self._absence.note(now)
        if self._absence.excuses(now):
            stall_s = math.inf
        missed_s = max(FAILOVER_S if self._bus.moved() else 0.0,
                       stall_s if stall_s > _LATE_S else 0.0)
        if missed_s:
            self.excuse(now, missed_s)
        late = sum(process.is_late(now, self._timeout_s) for process in self._processes.values())
        # Event loops that are late show an overload as well as missing heartbeats do.
        behind = self._lateness.count(self._spec.timing.heartbeat_timeout_s / 4)
        many = max(late, behind) >= max(MANY, MANY_SHARE * len(self._processes))
        for process in self._processes.values():
            silence = process.silence(now, self._timeout_s, process.handle.usage, many=many)
            if silence:
                stopped = process.state is State.RUNNING and process.handle.stopped()
                event = Event.SILENT_STOPPED if stopped else Event.SILENT
                self._on(process, event, detail=silence)

    def excuse(self, now_s: float, missed_s: float) -> None:
        """Do not count this time as silence: nothing could be received; wall seconds."""
        for process in self._processes.values():
            process.excuse(now_s, missed_s)

    def _look_at_routers(self) -> None:
        """Find a stopped router at once: its clients neither receive nor send."""
        self._absence.note(self._loop.time())
        for name in self._routers if not self._absence.excuses(self._loop.time()) else ():
            process = self._processes[name]
            if process.state is State.RUNNING and process.handle.stopped():
                self._on(process, Event.SILENT_STOPPED, detail="stopped")
        self.call_later(_ROUTERS_S * self.clock.rate, self._look_at_routers)

    @every(0.5)
    def repeat(self) -> None:
        """Repeat the node table for late subscribers, and report what is stable again."""
        for process in self._processes.values():
            if process.unstable and not process.lives.failing(self._loop.time()):
                process.unstable = False
                self._report(process, "stable", self.name)
        self.publish_table()
        self._lateness.turn()

    def _ended(self, process: SupervisedProcess, pid: int, detail: str = "") -> None:
        self._end_programs(process)
        # Since this came to the mailbox, the process may have been replaced or released.
        if process.pid == pid and self._supervises(process):
            process.release()
            process.stays = False
            self._on(process, Event.ENDED, detail=detail)

    def _end_programs(self, process: SupervisedProcess) -> None:
        """Kill what a program has left behind, if the process of its node has ended."""
        if any(node.command for node in process.unit.nodes):
            kill_orphans(self._plan.launcher_pid)

    def _owns(self, process: SupervisedProcess) -> bool:
        """Whether the supervisor restarts the process by itself."""
        return process.unit.name in self._routers or (
            self._spec.layers.supervisor_respawn
            and process.unit.respawn == SUPERVISOR
            and process.unit.kind != Kind.WORLD.value)

    # -- acting ---------------------------------------------------------------------------------

    def _on(self, process: SupervisedProcess, event: Event, by: str = "", detail: str = "") -> None:
        """Change the state of a process by an event, and carry out the actions."""
        step, by = process.step(event), by or self.name
        if step is None:
            return
        now_s = self._loop.time()
        died = (process.waits or process.state is State.CRASHED) and process.lives.ended(now_s)
        if died and process.lives.failing(now_s):
            process.unstable = True
            self._report(process, "unstable", self.name, "its processes end again and again")
        for action in step.actions:
            if process.state is not step.state:  # the last action has changed it again
                return
            match action:
                case Action.REPORT:
                    self._report(process, step.word, by, detail)
                case Action.PUBLISH:
                    self.publish_table()
                case Action.RECOVER:
                    self._recover(process)
                case Action.KILL:
                    process.kill()
                case Action.FORK:
                    self._fork(process, by)
                case Action.FORK_WHEN_GONE:  # attempts after giving up are the supervisor's
                    by = self.name if process.state is State.GIVEN_UP else by
                    process.due_s = process.delay_s and (
                        self.clock.now() + process.delay_s * self.clock.rate)
                    self._fork_when_gone(process, by, process.delay_s)
                case Action.HOLD:
                    self._hold(process, process.pid)

    def _recover(self, process: SupervisedProcess) -> None:
        # The recovery module of an unstable process has failed, and is not commanded any more.
        if (self._owns(process) or process.policy.attempts or process.requested_by
                or process.unstable):
            self._restart(process, process.requested_by or self.name)

    def _restart(self, process: SupervisedProcess, by: str) -> None:
        event, why_not = process.ask(self._loop.time())
        self._on(process, event, by, why_not)

    def _fork_in(self, process: SupervisedProcess, delay_s: float, step: Callable[[], None]
                 ) -> None:
        process.next_step = self.call_later(delay_s * self.clock.rate, step)

    def _fork_when_gone(self, process: SupervisedProcess, by: str, delay_s: float = 0.0) -> None:
        # The old process holds its socket for some milliseconds after the SIGKILL.
        if delay_s > 0 or not (process.stays or process.handle.gone()):
            self._fork_in(process, max(delay_s, _GONE_S),
                          lambda: self._fork_when_gone(process, by))
            return
        if not process.stays:
            self._end_programs(process)
        process.policy.restarted(self._loop.time())
        self._fork(process, by)

    def _fork(self, process: SupervisedProcess, by: str) -> None:
        if process.is_requested:  # the answer is on its way
            return
        incarnation = process.highest + 1
        answer = partial(self._forked, process, by, incarnation)
        if process.stays:
            answer(process.pid, "")
            return
        process.is_requested = True
        try:
            self._machine.fork(process.names, incarnation, answer)
        except OSError as error:
            answer(0, str(error))

    def _forked(self, process: SupervisedProcess, by: str, incarnation: int, pid: int, error: str
                ) -> None:
        process.is_requested = False
        is_wanted = process.waits and self._supervises(process)
        if pid and not is_wanted:
            kill(pid)
        elif pid:
            event = Event.FORKED if process.highest else Event.STARTED
            process.take(pid, incarnation)
            process.started_s = self._loop.time()
            attempt = process.policy.attempts
            self._on(process, event, by,
                     f"attempt {attempt} since it was given up" if attempt else "")
        elif is_wanted:
            self.report_diagnostic("fork", error, process.unit.name)
            self._fork_in(process, _RETRY_S, lambda: self._fork(process, by))

    def _adopt_living(self, process: SupervisedProcess, living: Sequence[RunProcess]) -> bool:
        """Adopt the highest living incarnation and kill the others; False if none lives."""
        found = sorted((p for p in living if p.names == process.names),
                       key=lambda p: -p.incarnation)
        for other in found[1:]:
            with contextlib.suppress(OSError):  # it has ended, or no descriptor is left
                handle = self._machine.hold(other.pid, lambda: None)
                handle.kill()
                handle.close()
        if found and (found[0].pid != process.pid or process.is_dead):
            process.take(found[0].pid, found[0].incarnation)
            process.heard_s = dict.fromkeys(process.names, self._loop.time())
            self._on(process, Event.ADOPTED)
        return bool(found)

    def _hold(self, process: SupervisedProcess, pid: int) -> None:
        if process.pid != pid:  # it was replaced meanwhile
            return
        process.release()
        try:
            process.handle = self._machine.hold(pid, lambda: self._dispatcher.put(
                f"exit {pid}", lambda: self._ended(process, pid)))
        except ProcessLookupError:
            self._ended(process, pid, "it ended before it could be watched")
        except OSError as error:  # no descriptor is left; tried again later
            process.handle = ProcessHandle(is_gone=False)
            self.report_diagnostic("hold", str(error), process.unit.name)
            self.call_later(_RETRY_S * self.clock.rate, lambda: self._hold(process, pid))
        else:
            if process.waits or not self._supervises(process):
                process.kill()

    # -- reports --------------------------------------------------------------------------------

    def _report(self, process: SupervisedProcess, event: str, by: str, detail: str = "") -> None:
        for node in process.unit.nodes:
            self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
                node.name, event, process.pid, process.incarnation, by, clip(detail)))

    def rows(self) -> tuple[fm.NodeInfo, ...]:
        """Return the rows of the node table: its own, and those of its nodes."""
        own = fm.NodeInfo(
            self.name, Kind.SUPERVISION.value, self.context.pid, fm.NodeState.RUNNING,
            self._incarnation, restarts_of(self._incarnation), self._lateness.of(self.name))
        rows = (row for p in self._processes.values()
                for row in p.rows(self._lateness.of, self._loop.time()))
        return own, *map(self._with_beat, rows)

    def _with_beat(self, row: fm.NodeInfo) -> fm.NodeInfo:
        beat = self._beats.get(row.name)
        return row if beat is None else replace(
            row, heard_s=beat[0], rejected_payloads=beat[1].rejected_payloads,
            overflowed=beat[1].overflowed)

    def publish_table(self) -> None:
        """Publish the node table."""
        self.publish(topics.NODES, fm.NodeTable(self.rows()))
