"""The supervisor: starts the processes, watches them three ways, kills and respawns them.

* *Crashed*: the process's pidfd becomes readable, at once; this works for processes that are
  not children, so a restarted supervisor adopts those that it finds in /proc.
* *Stopped*: no heartbeat, and the kernel says the process is stopped (SIGSTOP).
* *Wedged*: no heartbeat although the process runs: its event loop turns no more. Of the manager,
  whose silence stops the robot, the status counts as much as the heartbeat.

Who waits for a processor is neither (see `patience`). What follows is in `supervised_process`.

What a recovery module owns (RM3, RM4) is respawned on that module's request, so that the FTM
Manager arbitrates; everything else by the supervisor itself. So is a command whose program has
ended: its process stays, reports that, and starts the program again when it reads "respawned",
which makes it the next incarnation. OTP's rules hold: start in order, stop
in reverse, SIGTERM before SIGKILL, a bounded restart intensity. A request is carried out when the
new process was heard: until then it is repeated, for who asked may have missed its deadline.
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
    RestartPolicy,
    State,
    SupervisedProcess,
)
from rampart.actors.system.layout import Layout, Unit, adapted_system
from rampart.manager.spec.adaptation import changed_actors
from rampart.manager.spec.schema import Kind
from rampart.manager.spec.tables import FAILOVER_S

STOP_GRACE_S = 0.5
"""Wall seconds between SIGTERM and SIGKILL at the end of a run."""

_CHECK_S = 0.1
"""Simulated seconds between two looks at who is silent."""

_LATE_S = 0.02
"""Wall seconds by which it is late when its own process lacks processor time."""
_ROUTERS_S = 0.03
"""Wall seconds between two looks whether a router is stopped."""

_GONE_S, _RETRY_S = 0.002, 0.05
"""Wall seconds between two looks whether a killed process is gone, and between two attempts."""


class Supervisor(Actor):
    """Keeps the processes of the run running."""

    class Parameters(Actor.Parameters, frozen=True):
        """Whom it hears: the names of all nodes."""

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
            self.call_soon)
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
        """Hear the heartbeats of the nodes that it starts."""
        return parameters.nodes if topic is bus_topics.HEARTBEAT else None

    def listens(self, topic: Topic[Any]) -> bool:
        """Receive what becomes of programs if there is any."""
        return topic is not topics.PROGRAM_END or any(node.command for node in self._spec.nodes)

    def _held(self, unit: Unit) -> SupervisedProcess:
        known = self.context.run.known_incarnations
        highest = max((known.get(node.name, 0) for node in unit.nodes), default=0)
        return SupervisedProcess(unit, RestartPolicy(self._spec.supervision),
                           Patience(2 * _CHECK_S / self._plan.rate),
                           incarnation=highest, highest=highest)

    def _process_of(self, node: str) -> SupervisedProcess | None:
        return self._processes.get(
            node if node in self._routers else self._layout.unit_of.get(node, ""))

    # -- what it keeps; a supervisor of one host of several decides that -------------------------

    def units_at_start(self, running: Collection[str]) -> Iterable[str]:  # noqa: ARG002
        """Return the units that it keeps from its start on.

        Args:
            running: Units that run on its machine already.
        """
        return self._layout.here

    def take_on(self, unit: str, above: int) -> None:
        """Start a unit and keep it running from now on.

        Args:
            unit: Its name.
            above: Number that the incarnations of its processes have to exceed.
        """
        process = self._processes[unit] = self._held(self._layout.units[unit])
        process.incarnation = process.highest = above
        self._on(process, Event.START)

    def hand_over(self, unit: str) -> SupervisedProcess | None:
        """End a unit and keep it no more; return its process, which may not have ended yet."""
        process = self._processes.pop(unit, None)
        if process is not None:
            process.forget_step()
            process.kill()
            self._tell(process, "handed over", self.name)
        return process

    @property
    def layout(self) -> Layout:
        """The layout of the system, as it was changed last."""
        return self._layout

    def highest_of(self, node: str) -> int:
        """Return the highest incarnation of a node that it keeps; 0 if it does not."""
        process = self._process_of(node)
        return process.highest if process else 0

    def _is_kept(self, process: SupervisedProcess) -> bool:
        return self._processes.get(process.unit.name) is process

    # -- start and stop -------------------------------------------------------------------------

    def on_start(self) -> None:
        """Adopt what runs, start what does not, in the order of the spec."""
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
        """End all processes in reverse order: SIGTERM, then SIGKILL for those that linger.

        Routers when all others have ended. After a failure none: the next supervisor adopts them.
        """
        handles: dict[bool, list[ProcessHandle]] = {False: [], True: []}  # of routers: True
        for name, process in reversed(self._processes.items()):
            if not self._dispatcher.stopping:
                process.let_go()
            elif process.stays or process.shown is not fm.NodeState.CRASHED:
                process.handle.ignore()
                handles[name in self._routers].append(process.handle)
        for some in handles.values():
            self._machine.end(some, STOP_GRACE_S)
        self._machine.close()

    # -- what it hears --------------------------------------------------------------------------

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, message: Heartbeat, header: Header) -> None:
        """Note that a node's loop turns."""
        process = self._process_of(header.source)
        if process is None:
            return
        if process.waits or (
                header.incarnation, message.pid) != (process.incarnation, process.pid):
            return  # said before it was killed, or by another one
        age_s = (self.clock.now() - self.came_s(header)) / self._plan.rate
        process.heard_s[header.source] = heard_s = self._loop.time() - age_s
        process.lives.heard(heard_s)
        self._lateness.note(header.source, message.late_s)
        self._beats[header.source] = header.stamp, message
        process.requested_by = ""
        self._on(process, Event.HEARD)

    @on(topics.MANAGER_STATUS)
    def manager(self, _status: fm.ManagerStatus, header: Header) -> None:
        """Note when the manager said this: an old status does not show that it works now."""
        process = self._process_of(header.source)
        if process is None or header.incarnation != process.incarnation or process.waits:
            return
        age_s = max(0.0, self.clock.now() - header.stamp) / self._plan.rate
        process.heard_s[STATUS] = max(
            process.heard_s.get(STATUS, -math.inf), self._loop.time() - age_s)

    @on(topics.ADAPTED_SYSTEM)
    def adapted(self, message: fm.AdaptedSystem, header: Header) -> None:
        """Fork by the changed system from now on, and start the changed modules anew."""
        # A manager that died before it was heard counts from an older version.
        version = (header.incarnation, message.version)
        if version <= self._version:
            return
        try:
            layout, _ = adapted_system(self._layout, self.context.run, message)
            self._machine.adapt(message)
        except (ValueError, OSError) as error:  # it is repeated, and tried again
            self.report_diagnostic("adaptation", " ".join(str(error).split()), message.change)
            return
        self._version = version
        changed = changed_actors(self._spec, layout.spec)
        self._layout, self._spec = layout, layout.spec
        for unit in {self._layout.unit_of[name] for name in changed} & self._processes.keys():
            process = self._processes[unit]
            process.unit = self._layout.units[unit]
            if process.step(Event.ADAPTED):  # it was given up: it may do better now
                process.forget_step()
                process.policy = RestartPolicy(self._spec.supervision)
            self._tell(process, "adapted", self.name, message.change)
            self._restart(process, self.name)

    @on(topics.RESPAWN)
    def respawn(self, request: fm.RespawnRequest, _header: Header) -> None:
        """Kill what is left of a node and start it anew, once per failed incarnation."""
        process = self._process_of(request.node)
        if process is None:
            if request.node not in self._layout.unit_of:  # else another host's supervisor answers
                self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
                    request.node, "refused", 0, 0, request.by, clip(f"no node {request.node!r}")))
        elif (process.state in (State.STARTING, State.RUNNING)
              and process.incarnation > request.failed_incarnation):
            self._tell(process, "respawned", request.by, "already")
        else:
            process.requested_by = request.by
            self._restart(process, request.by)

    @on(topics.PROGRAM_END)
    def program_ended(self, message: fm.ProgramEnd, header: Header) -> None:
        """Take the end of a command's program as that of its incarnation; it is repeated."""
        process = self._process_of(header.source)
        if process is None or message.pid != process.pid:
            return
        if header.incarnation < process.incarnation:
            self._tell(process, "respawned", self.name, "already")
        elif process.state is not State.CRASHED and not process.waits:
            if len(process.names) > 1:  # they share an incarnation
                process.handle.kill()
                return
            process.stays = True
            self._on(process, Event.ENDED, detail=message.detail)

    # -- watching -------------------------------------------------------------------------------

    @every(_CHECK_S)
    def check(self) -> None:
        """Look for processes whose loops are silent."""
        # Silence counts only while this loop turned (one that was stopped, starved or waiting for a
        # hung spawner has mail to read first), and not if the router died over which it hears all.
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
        # Late loops that still beat are the machine's overload as much as missing heartbeats.
        behind = self._lateness.count(self._spec.timing.heartbeat_timeout_s / 4)
        many = max(late, behind) >= max(MANY, MANY_SHARE * len(self._processes))
        for process in self._processes.values():
            silence = process.silence(now, self._timeout_s, process.handle.usage, many=many)
            if silence:
                stopped = process.state is State.RUNNING and process.handle.stopped()
                event = Event.SILENT_STOPPED if stopped else Event.SILENT
                self._on(process, event, detail=silence)

    def excuse(self, now_s: float, missed_s: float) -> None:
        """Do not count as silence what could not be received for so long; wall seconds."""
        for process in self._processes.values():
            process.excuse(now_s, missed_s)

    def _look_at_routers(self) -> None:
        """Find routers that are stopped at once: who is linked to one hears and says nothing."""
        self._absence.note(self._loop.time())
        for name in self._routers if not self._absence.excuses(self._loop.time()) else ():
            process = self._processes[name]
            if process.state is State.RUNNING and process.handle.stopped():
                self._on(process, Event.SILENT_STOPPED, detail="stopped")
        self.call_later(_ROUTERS_S * self.clock.rate, self._look_at_routers)

    @every(0.5)
    def repeat(self) -> None:
        """Repeat the node table for those who joined late."""
        self.publish_table()
        self._lateness.turn()

    def _ended(self, process: SupervisedProcess, pid: int, detail: str = "") -> None:
        self._end_programs(process)
        # Else it was replaced, or is kept no more, since the news came to the mailbox.
        if process.pid == pid and self._is_kept(process):
            process.let_go()
            process.stays = False
            self._on(process, Event.ENDED, detail=detail)

    def _end_programs(self, process: SupervisedProcess) -> None:
        """End what the program of a command has left, whose process has ended."""
        if any(node.command for node in process.unit.nodes):
            kill_orphans(self._plan.launcher_pid)

    def _owns(self, process: SupervisedProcess) -> bool:
        """Whether the supervisor itself brings the process back."""
        return process.unit.name in self._routers or (
            self._spec.layers.supervisor_respawn
            and process.unit.respawn == SUPERVISOR
            and process.unit.kind != Kind.WORLD.value)

    # -- acting ---------------------------------------------------------------------------------

    def _on(self, process: SupervisedProcess, event: Event, by: str = "", detail: str = "") -> None:
        """Take a process's transition, and do what follows from it."""
        step, by = process.step(event), by or self.name
        if step is None:
            return
        if process.waits or process.state is State.CRASHED:
            process.lives.ended(self._loop.time())
        for action in step.actions:
            if process.state is not step.state:  # the action before has led elsewhere
                return
            match action:
                case Action.TELL:
                    self._tell(process, step.word, by, detail)
                case Action.PUBLISH:
                    self.publish_table()
                case Action.RECOVER:
                    self._recover(process)
                case Action.KILL:
                    process.kill()
                case Action.FORK:
                    self._fork(process, by)
                case Action.FORK_WHEN_GONE:  # the attempts of one given up are the supervisor's
                    by = self.name if process.state is State.GIVEN_UP else by
                    self._fork_when_gone(process, by, process.delay_s)
                case Action.HOLD:
                    self._hold(process, process.pid)

    def _recover(self, process: SupervisedProcess) -> None:
        if self._owns(process) or process.policy.attempts or process.requested_by:
            self._restart(process, process.requested_by or self.name)

    def _restart(self, process: SupervisedProcess, by: str) -> None:
        event, why_not = process.ask(self._loop.time())
        self._on(process, event, by, why_not)

    def _fork_in(self, process: SupervisedProcess, delay_s: float, step: Callable[[], None]
                 ) -> None:
        process.next_step = self.call_later(delay_s * self.clock.rate, step)

    def _fork_when_gone(self, process: SupervisedProcess, by: str, delay_s: float = 0.0) -> None:
        # The socket is free only when the old process is gone: a few more milliseconds.
        if delay_s > 0 or not (process.stays or process.handle.gone()):
            self._fork_in(process, max(delay_s, _GONE_S),
                          lambda: self._fork_when_gone(process, by))
            return
        if not process.stays:
            self._end_programs(process)
        process.policy.restarted(self._loop.time())
        self._fork(process, by)

    def _fork(self, process: SupervisedProcess, by: str) -> None:
        if process.asks:  # the answer is under way
            return
        incarnation = process.highest + 1
        answer = partial(self._forked, process, by, incarnation)
        if process.stays:
            answer(process.pid, "")
            return
        process.asks = True
        try:
            self._machine.fork(process.names, incarnation, answer)
        except OSError as error:
            answer(0, str(error))

    def _forked(self, process: SupervisedProcess, by: str, incarnation: int, pid: int, error: str
                ) -> None:
        process.asks = False
        if pid and not (process.waits and self._is_kept(process)):
            kill(pid)
        elif pid:
            event = Event.FORKED if process.highest else Event.STARTED
            process.take(pid, incarnation)
            process.started_s = self._loop.time()
            attempt = process.policy.attempts
            self._on(process, event, by,
                     f"attempt {attempt} since it was given up" if attempt else "")
        elif process.waits and self._is_kept(process):
            self.report_diagnostic("fork", error, process.unit.name)
            self._fork_in(process, _RETRY_S, lambda: self._fork(process, by))

    def _adopt_living(self, process: SupervisedProcess, living: Sequence[RunProcess]) -> bool:
        """Adopt the highest incarnation that is there and end the others; False without any."""
        found = sorted((p for p in living if p.names == process.names),
                       key=lambda p: -p.incarnation)
        for other in found[1:]:
            with contextlib.suppress(OSError):  # gone, or for the next search
                handle = self._machine.hold(other.pid, lambda: None)
                handle.kill()
                handle.close()
        if found and (found[0].pid != process.pid or process.is_dead):
            process.take(found[0].pid, found[0].incarnation)
            process.heard_s = dict.fromkeys(process.names, self._loop.time())
            self._on(process, Event.ADOPTED)
        return bool(found)

    def _hold(self, process: SupervisedProcess, pid: int) -> None:
        if process.pid != pid:  # it was replaced while this waited
            return
        process.let_go()
        try:
            process.handle = self._machine.hold(pid, lambda: self._dispatcher.put(
                f"exit {pid}", lambda: self._ended(process, pid)))
        except ProcessLookupError:
            self._ended(process, pid, "it ended before it could be watched")
        except OSError as error:  # no descriptor left: perhaps later
            process.handle = ProcessHandle(is_gone=False)
            self.report_diagnostic("hold", str(error), process.unit.name)
            self.call_later(_RETRY_S * self.clock.rate, lambda: self._hold(process, pid))
        else:
            if process.waits or not self._is_kept(process):
                process.kill()

    # -- what it says ---------------------------------------------------------------------------

    def _tell(self, process: SupervisedProcess, event: str, by: str, detail: str = "") -> None:
        for node in process.unit.nodes:
            self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
                node.name, event, process.pid, process.incarnation, by, clip(detail)))

    def rows(self) -> tuple[fm.NodeInfo, ...]:
        """Return itself, and the nodes that it keeps."""
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
        """Publish what it keeps."""
        self.publish(topics.NODES, fm.NodeTable(self.rows()))
