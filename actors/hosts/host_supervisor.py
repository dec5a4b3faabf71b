"""The supervisors of a system of several hosts: each runs what `Placement` gives it.

They tell each other what they run, and of which incarnation (`supervisor/{name}/nodes`). What one
hears is noted in the folder of the run on its own host, where every reader looks whether an
incarnation was issued; nobody but a supervisor writes there what another host has issued. The
first host's publishes the table of all.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from signal import Signals
from typing import Any, ClassVar

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import clip
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.run_folder import issue
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.hosts.placement import Changes, Home, Placement
from rampart.actors.run.run_plan import SUPERVISOR, on_host
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.supervision.kill_node import (
    SIGNALS,
    SignalError,
    UnknownNodeError,
    find_node,
)
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.processes import Processes
from rampart.actors.supervision.supervised_process import Event
from rampart.actors.supervision.supervisor import Supervisor
from rampart.manager.spec.schema import Kind

_LOOK_S = 0.05
"""Real seconds between two looks at the other hosts."""

_SAID_S = 0.1
"""Simulated seconds after which it is signalled itself: the answer has gone by then."""

_ORDERS_KEPT = 64
"""An order to signal that is repeated gets its old answer, as long as it is among the last ones."""


class HostSupervisor(Supervisor):
    """Keeps the processes of one host of several running."""

    class Parameters(Supervisor.Parameters, frozen=True):
        """Whom it hears besides.

        Attributes:
            host: name of its host.
            others: names of the other hosts.
        """

        host: str = ""
        others: tuple[str, ...] = ()

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.HOST_NODES, topics.PROCESS_EVENT)

    def __init__(self, context: Context, processes: Processes | None = None) -> None:
        super().__init__(context, processes)
        hosts, units = self._layout.hosts, self._layout.units
        own, others = self.parameters.host, self.parameters.others
        self._supervisors = {hosts.supervisors[host]: host for host in others}
        self._guard_of = {name: host for host in others for name in hosts.guards_of(host)}
        self._issued = dict(context.run.known_incarnations)
        self._signalled: deque[fm.ProcessEvent] = deque(maxlen=_ORDERS_KEPT)
        self._placement = Placement(
            own, others,
            {name: Home(hosts.home_of[unit.nodes[0].name], tuple(node.name for node in unit.nodes),
                        any(node.command or node.kind is Kind.WORLD for node in unit.nodes))
             for name, unit in units.items()},
            hosts.link, self._loop.time())
        if self._plan.incarnations and self._incarnation == self._plan.incarnations + 1:
            for unit in self._placement.waits():
                del self._processes[unit]

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Supervisor.Parameters) -> Members:
        """Hear the other supervisors, too."""
        if topic is topics.HOST_NODES:
            assert isinstance(parameters, HostSupervisor.Parameters)  # noqa: S101 for the type checker
            return tuple(on_host(SUPERVISOR, host) for host in parameters.others)
        return super().names(topic, name, parameters)

    @classmethod
    def output_names(cls, topic: Topic[Any], name: str, parameters: Supervisor.Parameters
                     ) -> Members:
        """Publish what runs here under its own name."""
        if topic is topics.HOST_NODES:
            return (name,)
        return super().output_names(topic, name, parameters)

    def on_start(self) -> None:
        """Adopt what is run here in another host's place as well."""
        for process in self._machine.living():
            unit = self._layout.unit_of.get(process.names[0], "")
            if unit and unit not in self._processes:
                self._placement.adopted(unit)
                self._processes[unit] = self._held(self._layout.units[unit])
        super().on_start()
        self._look_at_hosts()

    # -- what it hears --------------------------------------------------------------------------

    @on(bus_topics.HEARTBEAT)
    def guard_heard(self, _message: Heartbeat, header: Header) -> None:
        """Note that another host is there."""
        host = self._guard_of.get(header.source)
        if host is not None and self._placement.heard(host, self._loop.time()):
            self._publish_table()  # each soon knows what the other runs

    @on(topics.HOST_NODES)
    def told(self, table: fm.NodeTable, header: Header) -> None:
        """Note what another supervisor runs, and let go of what has a higher incarnation there."""
        host = self._supervisors.get(header.source)
        if host is None:
            return
        now_s = self._loop.time()
        was_missed = self._placement.heard(host, now_s)
        news, drop = self._placement.told(host, table.nodes, self._mine(), now_s)
        for row in news:
            self._issue(row)
        for unit in drop:
            self._drop(unit)
        if news or drop or was_missed:
            self._publish_table()

    @on(topics.SIGNAL)
    def signal(self, order: fm.SignalOrder, _header: Header) -> None:
        """Signal a process of this host; what is none, another supervisor may know."""
        answers = [answer for answer in self._signalled if answer.by == order.order]
        answer = answers[0] if answers else self._carried_out(order)
        if answer is not None:
            self.publish(topics.PROCESS_EVENT, answer)

    def _carried_out(self, order: fm.SignalOrder) -> fm.ProcessEvent | None:
        try:
            victim = find_node(order.node, order.signal, self._plan.base_port)
        except UnknownNodeError:
            return None
        except SignalError as refusal:
            pid, incarnation, event, detail = 0, 0, "refused", clip(str(refusal))
        else:
            pid, incarnation = victim.pid, victim.incarnation
            event, detail = "signalled", order.signal
            self.call_later(_SAID_S, partial(_kill, pid, SIGNALS[order.signal]))
        answer = fm.ProcessEvent(order.node, event, pid, incarnation, order.order, detail)
        self._signalled.append(answer)
        return answer

    def _issue(self, row: fm.NodeInfo) -> None:
        if row.name in self._supervisors:  # of itself it is believed: who else could say it?
            return
        try:
            if self.context.register(row.name) != row.incarnation:
                issue(self._plan.folder, [row.name], row.incarnation)
        except OSError as error:
            self.report_diagnostic("incarnation", f"not noted: {error}", row.name)

    def _look_at_hosts(self) -> None:
        changes = self._placement.look(self._loop.time(), self._mine())
        if changes != Changes():
            for host in changes.lost:
                self._tell_of(host, "unreachable")
            for host in changes.back:
                self._tell_of(host, "back")
            for unit in changes.drop:
                self._drop(unit)
            for unit, above in changes.take:
                self._take(unit, above)
            self._publish_table()
        self.call_later(_LOOK_S * self.clock.rate, self._look_at_hosts)

    def _mine(self) -> dict[str, int]:
        """Return the incarnations that were issued here."""
        return {**self._issued, **{name: process.highest for process in self._processes.values()
                                   for name in process.names}}

    # -- what follows ---------------------------------------------------------------------------

    def _take(self, unit: str, above: int) -> None:
        process = self._processes[unit] = self._held(self._layout.units[unit])
        process.incarnation = process.highest = above
        self._on(process, Event.START)

    def _drop(self, unit: str) -> None:
        process = self._processes.pop(unit, None)
        if process is not None:
            self._machine.forget(process.names)
            process.forget_step()
            process.kill()
            self._tell(process, "handed over", self.name)
            self._issued.update(dict.fromkeys(process.names, process.highest))
            process.let_go()

    def _tell_of(self, host: str, event: str) -> None:
        name = self._layout.hosts.supervisors[host]
        self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
            name, event, 0, 0, self.name, f"host {host or 'the first'}"))

    def _own_rows(self) -> tuple[fm.NodeInfo, ...]:
        return tuple(fm.NodeInfo(
            row.name, row.kind, row.pid, row.state, row.incarnation, row.restarts, row.late_s,
            self.parameters.host) for row in super()._rows())

    def _publish_table(self) -> None:
        given_back = (fm.NodeInfo(node, "", 0, fm.NodeState.UNREACHABLE, highest, 0, host=home)
                      for node, home, highest in self._placement.given_back(self._mine()))
        self.publish(topics.HOST_NODES, fm.NodeTable((*self._own_rows(), *given_back)))


def _kill(pid: int, number: Signals) -> None:
    kill(pid, number)  # it may be gone by now


class FirstSupervisor(HostSupervisor):
    """The first host's, which tells what runs on all of them."""

    outputs: ClassVar[tuple[Topic[Any], ...]] = (*HostSupervisor.outputs, topics.NODES)

    def _rows(self) -> tuple[fm.NodeInfo, ...]:
        others = tuple(
            row if not self._placement.is_lost(row.host) else fm.NodeInfo(
                row.name, row.kind, 0, fm.NodeState.UNREACHABLE, row.incarnation, row.restarts,
                host=row.host) for row in self._placement.rows())
        return (*self._own_rows(), *others)

    def _publish_table(self) -> None:
        super()._publish_table()
        self.publish(topics.NODES, fm.NodeTable(self._rows()))
