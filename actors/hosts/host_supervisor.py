"""Supervisors of a system of several hosts: each runs the units that `Placement` gives it.

They publish what they run, with incarnations (`supervisor/{name}/nodes`). A supervisor writes the
incarnations that other hosts have issued to the run folder of its own host, where every reader
looks them up. No other process writes them there. The first host's supervisor publishes the table
of all hosts.

With checkpoints they also publish the newest state of each node that two hosts may run (`Copies`).
A node that is given back starts when the state kept there has arrived.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Collection, Iterable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from msgspec.structs import replace

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import clip
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.run_folder import is_elsewhere, issue
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.hosts.copies import Copies
from rampart.actors.hosts.placement import FIRST, Changes, Home, Placement
from rampart.actors.hosts.state_files import StateFiles
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.run_plan import SUPERVISOR, on_host
from rampart.actors.supervision.kill_node import (
    SignalError,
    UnknownNodeError,
    find_node,
    send,
)
from rampart.actors.supervision.process_title import RunProcess
from rampart.actors.supervision.processes import Processes
from rampart.actors.supervision.supervised_process import SupervisedProcess
from rampart.actors.supervision.supervisor import Supervisor
from rampart.manager.spec.schema import Kind

_ANSWER_S = 0.1
"""Simulated seconds between the answer to an order and the signal, which may end this process."""

_ENDING_S = 0.005
"""Real seconds between two checks whether a process that was given back has ended."""

_WAIT_S = 2.0
"""Longest wait for the last state of a node that is given back, real seconds."""

_ORDERS_KEPT = 64
"""Most orders to signal whose answers are remembered, for orders that arrive again."""


class HostSupervisor(Supervisor):
    """Keeps the processes of one host of several running."""

    class Parameters(Supervisor.Parameters, frozen=True):
        """Names of this host and of the others."""

        host: str = ""
        others: tuple[str, ...] = ()

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        topics.HOST_NODES, topics.PROCESS_EVENT, topics.CHECKPOINTS)

    def __init__(self, context: Context, processes: Processes | None = None,
                 files: Callable[..., StateFiles] = StateFiles) -> None:
        super().__init__(context, processes)
        plan, spec, own = context.run.plan, context.run.system, self.parameters.host
        hosts, loop = self.layout.hosts, asyncio.get_running_loop()
        self._now_s = loop.time
        self._folder, self._base_port = plan.folder, plan.base_port
        self._supervisors = {hosts.supervisors[host]: host for host in self.parameters.others}
        self._guards = {name: host for host in hosts.supervisors for name in hosts.guards_of(host)}
        self._signalled: deque[fm.ProcessEvent] = deque(maxlen=_ORDERS_KEPT)
        homes = {
            name: Home(hosts.home_of[unit.nodes[0].name], tuple(node.name for node in unit.nodes),
                       any(node.command or node.kind is Kind.WORLD for node in unit.nodes))
            for name, unit in self.layout.units.items()}
        self._placement = Placement(own, homes, self._guards, hosts.link, self._known,
                                    now_s=loop.time(), rate=plan.rate)
        self._ending: set[str] = set()
        self._waits: dict[tuple[str, int], float] = {}
        keeps_states = bool(plan.checkpoints) and spec.layers.checkpoints
        self._copies = Copies(
            plan.run_id, own,
            {node: home.host for home in homes.values() for node in home.nodes
             if keeps_states and home.host != FIRST and not home.is_fixed},
            self.highest_of, lambda node: context.register(node) or 0)

        def from_thread(call: Callable[..., None], node: str, *what: Any) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(
                    self.call_soon, f"{call.__name__} {node} {what[1:]}",
                    partial(call, node, *what))

        self._files = files(
            Path(plan.checkpoints), plan.run_id, self._copies.nodes,
            partial(from_thread, self._state_kept), partial(from_thread, self._state_problem))

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Supervisor.Parameters) -> Members:
        """Receive the tables of all other supervisors, and states from hosts that share some."""
        if topic in (topics.HOST_NODES, topics.CHECKPOINTS):
            assert isinstance(parameters, HostSupervisor.Parameters)  # noqa: S101 for the type checker
            shares_all = topic is topics.HOST_NODES or parameters.host == FIRST
            return tuple(on_host(SUPERVISOR, host) for host in parameters.others
                         if shares_all or host == FIRST)
        return super().names(topic, name, parameters)

    @classmethod
    def output_names(cls, topic: Topic[Any], name: str, parameters: Supervisor.Parameters
                     ) -> Members:
        """Publish tables and states under its own name."""
        if topic in (topics.HOST_NODES, topics.CHECKPOINTS):
            return (name,)
        return super().output_names(topic, name, parameters)

    def units_at_start(self, running: Collection[str]) -> Iterable[str]:
        """Return the units of this home, and the units of other homes that run here.

        A unit that ran on another host last starts here only when the first host gives it back.
        """
        return self._placement.begin(running, lambda node: is_elsewhere(self._folder, node))

    def on_start(self) -> None:
        """Start the units of this host, and watch its states."""
        super().on_start()
        if self._copies.nodes:
            self._files.start()
            self.publish_states()
            for node in self._copies.nodes:
                self._files.settle(node)

    def on_stop(self) -> None:
        """End all processes, and watch states no more."""
        super().on_stop()
        self._files.close()

    # -- other hosts ----------------------------------------------------------------------------

    @on(bus_topics.HEARTBEAT)
    def note_guard(self, _message: Heartbeat, header: Header) -> None:
        """Note that another host is alive."""
        own = self.parameters.host
        host = self._guards.get(header.source, own)
        if host != own and self._placement.note_alive(host, self._now_s()):
            self.publish_table()  # the sooner the other one knows it, the better
            self.publish_states()

    @on(topics.HOST_NODES)
    def take_table(self, table: fm.NodeTable, header: Header) -> None:
        """Note what another supervisor runs, and end what has a higher incarnation there."""
        host = self._supervisors.get(header.source)
        if host is None:
            return
        now_s = self._now_s()
        was_silent = self._placement.note_alive(host, now_s)
        news, drop = self._placement.take_table(host, table.nodes, now_s)
        for unit in drop:  # first: no reader may know the higher incarnation while it runs here
            self._drop(unit)
        news = [row for row in news if row.name != header.source]  # its header proves its own
        for row in news:
            self._issue(row.name, row.incarnation)
        if news or drop or was_silent:
            self.publish_table()

    @on(topics.CHECKPOINTS)
    def take_states(self, message: fm.Checkpoints, header: Header) -> None:
        """Keep the newer states of another host."""
        host = self._supervisors.get(header.source)
        if host is None or not self._copies.nodes:
            return
        received = self._copies.receive(host, message)
        for node, problem in received.problems:
            self._state_problem(node, problem)
        for node, record in received.records:
            self._files.take(node, record)

    @on(topics.SIGNAL)
    def signal(self, order: fm.SignalOrder, _header: Header) -> None:
        """Signal a process of this host, once per order; other hosts answer for theirs."""
        answers = [answer for answer in self._signalled if answer.by == order.order]
        answer = answers[0] if answers else self._carry_out(order)
        if answer is not None:
            self.publish(topics.PROCESS_EVENT, answer)

    def _carry_out(self, order: fm.SignalOrder) -> fm.ProcessEvent | None:
        try:
            victim = find_node(order.node, order.signal, self._base_port)
        except UnknownNodeError:
            return None
        except SignalError as refusal:
            pid, incarnation, event, detail = 0, 0, "refused", clip(str(refusal))
        else:
            pid, incarnation = victim.pid, victim.incarnation
            event, detail = "signalled", order.signal
            self.call_later(_ANSWER_S, partial(_send, victim, order.signal))
        answer = fm.ProcessEvent(order.node, event, pid, incarnation, order.order, detail)
        self._signalled.append(answer)
        return answer

    def _known(self, node: str) -> int:
        """Return the highest incarnation of a node, of any host, that is known here."""
        return max(self.context.register(node) or 0, self.highest_of(node))

    def _issue(self, node: str, incarnation: int) -> None:
        """Make an incarnation of another host known to all readers of this one."""
        if incarnation > (self.context.register(node) or 0):
            try:
                issue(self._folder, [node], incarnation)
            except OSError as error:
                self.report_diagnostic("incarnation", f"{incarnation} is not noted: {error}", node)

    def excuse(self, now_s: float, missed_s: float) -> None:
        """Do not count it as silence of other hosts either."""
        super().excuse(now_s, missed_s)
        self._placement.excuse(now_s, missed_s)

    def check(self) -> None:
        """Check for silent processes and hosts."""
        super().check()
        changes = self._placement.look(self._now_s(), self._has_states)
        if changes == Changes():
            return
        for host in changes.lost:
            self._copies.lose(host)
            self._publish_event(host, "unreachable")
        for host in changes.back:
            self._publish_event(host, "back")
        for unit in changes.drop:
            self._drop(unit)
        for unit, above in changes.take:
            self.take_on(unit, above)
        self.publish_table()

    def _drop(self, unit: str) -> None:
        process = self.hand_over(unit)
        if process is not None:
            for node in process.names:  # a requested process may have started
                self._issue(node, process.highest + process.waits)
            self._copies.unsettle(process.names)
            self._ending.update(process.names)
            self._settle(process)

    # -- states of nodes ------------------------------------------------------------------------

    def _state_kept(self, node: str, record: Record | None, is_last: bool) -> None:
        self._copies.note_kept(node, record)
        if is_last and node not in self._ending:
            self._copies.settle(node)
        self.publish(topics.CHECKPOINTS, self._copies.changes())

    def _state_problem(self, node: str, problem: str) -> None:
        self.report_diagnostic("checkpoint", problem, node)

    def _settle(self, process: SupervisedProcess) -> None:
        """Have the last states of a process that was handed over read, when it has ended."""
        if process.is_requested or not process.handle.gone():
            self.call_later(_ENDING_S * self.clock.rate, partial(self._settle, process))
            return
        process.release()
        self._ending.difference_update(process.names)
        for node in process.names:
            if node in self._copies.nodes:
                self._files.settle(node)

    def _has_states(self, unit: str) -> bool:
        """Whether a unit that was given back can start: its states are here, or late."""
        issued, now_s = self._placement.incarnations(unit), self._now_s()
        since_s = self._waits.setdefault((unit, max(issued.values())), now_s)
        if self._copies.is_caught_up(issued):
            return True
        if now_s - since_s < _WAIT_S:
            return False
        self._state_problem(unit, "the host that gave it back has not sent the last state within "
                            f"{_WAIT_S:g} s; starting from the state on this host")
        return True

    @every(0.5)
    def publish_states(self) -> None:
        """Repeat the states that are held here."""
        if self._copies.nodes:
            self.publish(topics.CHECKPOINTS, self._copies.all())

    # -- tables and events ----------------------------------------------------------------------

    def _publish_event(self, host: str, event: str) -> None:
        other, own = host or "the first", self.parameters.host or "the first"
        self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
            on_host(SUPERVISOR, host), event, 0, 0, self.name,
            f"host {other}, as seen from {own}"))

    def _own_rows(self) -> tuple[fm.NodeInfo, ...]:
        return tuple(replace(row, host=self.parameters.host) for row in super().rows())

    def publish_table(self) -> None:
        """Publish what runs here, and what was given back."""
        given_back = (fm.NodeInfo(node, "", 0, fm.NodeState.UNREACHABLE, highest, 0, host=home)
                      for node, home, highest in self._placement.given_back())
        self.publish(topics.HOST_NODES, fm.NodeTable((*self._own_rows(), *given_back)))


def _send(victim: RunProcess, name: str) -> None:
    with contextlib.suppress(OSError):
        send(victim, name)


class FirstSupervisor(HostSupervisor):
    """The first host's supervisor, which also publishes the table of all hosts."""

    outputs: ClassVar[tuple[Topic[Any], ...]] = (*HostSupervisor.outputs, topics.NODES)

    def rows(self) -> tuple[fm.NodeInfo, ...]:
        """Return the nodes of all hosts."""
        others = (
            row if not self._placement.is_lost(row.host) else fm.NodeInfo(
                row.name, row.kind, 0, fm.NodeState.UNREACHABLE, row.incarnation, row.restarts,
                host=row.host) for row in self._placement.rows())
        return (*self._own_rows(), *others)

    def publish_table(self) -> None:
        """Publish both tables."""
        super().publish_table()
        self.publish(topics.NODES, fm.NodeTable(self.rows()))


class HostObserver(Actor):
    """Passes on the process events of one host's supervisor, in the launcher of that host."""

    class Parameters(Actor.Parameters, frozen=True):
        """Name of the supervisor."""

        supervisor: str = ""

    parameters: Parameters

    def __init__(self, context: Context, event: Callable[[fm.ProcessEvent, float], None]) -> None:
        super().__init__(context)
        self._event = event

    @on(topics.PROCESS_EVENT)
    def process_event(self, event: fm.ProcessEvent, header: Header) -> None:
        """Pass on an event with its time."""
        if header.source == self.parameters.supervisor:
            self._event(event, header.stamp)
