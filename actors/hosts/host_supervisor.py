"""The supervisors of a system of several hosts: each runs what `Placement` gives it.

They tell each other what they run, and of which incarnation (`supervisor/{name}/nodes`). What one
hears is noted in the folder of the run on its own host, where every reader looks whether an
incarnation was issued; nobody but a supervisor writes there what another host has issued. The
first host's publishes the table of all.

With checkpoints they also hold the newest state of each node that either of two hosts may run
(`Copies`), which they publish, and a node that is given back starts when what it has
kept there has come.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Collection, Iterable
from functools import partial
from pathlib import Path
from signal import Signals
from typing import Any, ClassVar

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
from rampart.actors.runtime.actor import Context, Header, every, on
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.run_plan import SUPERVISOR, on_host
from rampart.actors.supervision.kill_node import (
    SIGNALS,
    SignalError,
    UnknownNodeError,
    find_node,
)
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.processes import Processes
from rampart.actors.supervision.supervised_process import SupervisedProcess
from rampart.actors.supervision.supervisor import Supervisor
from rampart.manager.spec.schema import Kind

_SAID_S = 0.1
"""Simulated seconds after which it is signalled itself: the answer has gone by then."""

_ENDING_S = 0.005
"""Real seconds between two looks whether a process that was given back has ended."""

_WAIT_S = 2.0
"""Real seconds after which the last state of a node that is given back is not waited for."""

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
    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        topics.HOST_NODES, topics.PROCESS_EVENT, topics.CHECKPOINTS)

    def __init__(self, context: Context, processes: Processes | None = None,
                 files: Callable[..., StateFiles] = StateFiles) -> None:
        super().__init__(context, processes)
        plan, spec, own = context.run.plan, context.run.system, self.parameters.host
        hosts, units = self.layout.hosts, self.layout.units
        loop = asyncio.get_running_loop()
        self._now_s = loop.time
        self._folder, self._base_port = plan.folder, plan.base_port
        self._supervisors = {hosts.supervisors[host]: host for host in self.parameters.others}
        self._guards = {name: host for host in hosts.supervisors for name in hosts.guards_of(host)}
        self._signalled: deque[fm.ProcessEvent] = deque(maxlen=_ORDERS_KEPT)
        self._placement = Placement(
            own,
            {name: Home(hosts.home_of[unit.nodes[0].name], tuple(node.name for node in unit.nodes),
                        any(node.command or node.kind is Kind.WORLD for node in unit.nodes))
             for name, unit in units.items()},
            self._guards, hosts.link, self._known, now_s=loop.time(), rate=plan.rate)
        self._ending: set[str] = set()
        self._waits: dict[tuple[str, int], float] = {}
        keeps_states = bool(plan.checkpoints) and spec.layers.checkpoints
        self._copies = Copies(
            plan.run_id, own, {
                node.name: home for name, unit in units.items() for node in unit.nodes
                if keeps_states and (home := hosts.home_of[unit.nodes[0].name]) != FIRST
                and not self._placement.is_fixed(name)},
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
        """Hear the other supervisors, too; of states, those with which it shares some."""
        if topic in (topics.HOST_NODES, topics.CHECKPOINTS):
            assert isinstance(parameters, HostSupervisor.Parameters)  # noqa: S101 for the type checker
            shares_all = topic is topics.HOST_NODES or parameters.host == FIRST
            return tuple(on_host(SUPERVISOR, host) for host in parameters.others
                         if shares_all or host == FIRST)
        return super().names(topic, name, parameters)

    @classmethod
    def output_names(cls, topic: Topic[Any], name: str, parameters: Supervisor.Parameters
                     ) -> Members:
        """Publish what runs here, and what it holds, under its own name."""
        if topic in (topics.HOST_NODES, topics.CHECKPOINTS):
            return (name,)
        return super().output_names(topic, name, parameters)

    def units_at_start(self, running: Collection[str]) -> Iterable[str]:
        """Return what has its home here, and what runs here already in another host's place.

        What ran on another host last is not begun here before the first has given it back.
        """
        return self._placement.begin(running, lambda node: is_elsewhere(self._folder, node))

    def on_start(self) -> None:
        """Start what is kept here, and look at the other hosts from now on."""
        super().on_start()
        if self._copies.nodes:
            self._files.start()
            self.tell_states()
            for node in self._copies.nodes:
                self._files.settle(node)

    def on_stop(self) -> None:
        """End all processes as any supervisor, and look at no states any more."""
        super().on_stop()
        self._files.close()

    # -- what it hears --------------------------------------------------------------------------

    @on(bus_topics.HEARTBEAT)
    def guard_heard(self, _message: Heartbeat, header: Header) -> None:
        """Note that another host is there."""
        own = self.parameters.host
        host = self._guards.get(header.source, own)
        if host != own and self._placement.heard(host, self._now_s()):
            self.publish_table()  # each soon knows what the other runs
            self.tell_states()

    @on(topics.HOST_NODES)
    def told(self, table: fm.NodeTable, header: Header) -> None:
        """Note what another supervisor runs, and let go of what has a higher incarnation there."""
        host = self._supervisors.get(header.source)
        if host is None:
            return
        now_s = self._now_s()
        was_missed = self._placement.heard(host, now_s)
        news, drop = self._placement.told(host, table.nodes, now_s)
        news = [row for row in news if row.name != header.source]  # of itself it is believed
        for unit in drop:  # first: what runs here must not be found with a higher one known
            self._drop(unit)
        for row in news:
            self._issue(row.name, row.incarnation)
        if news or drop or was_missed:
            self.publish_table()

    @on(topics.CHECKPOINTS)
    def told_states(self, message: fm.Checkpoints, header: Header) -> None:
        """Keep what another host holds and this one lacks."""
        host = self._supervisors.get(header.source)
        if host is None or not self._copies.nodes:
            return
        taken = self._copies.told(host, message)
        for node, problem in taken.problems:
            self._state_problem(node, problem)
        for node, record in taken.records:
            self._files.take(node, record)

    @on(topics.SIGNAL)
    def signal(self, order: fm.SignalOrder, _header: Header) -> None:
        """Signal a process of this host; what is none, another supervisor may know."""
        answers = [answer for answer in self._signalled if answer.by == order.order]
        answer = answers[0] if answers else self._carried_out(order)
        if answer is not None:
            self.publish(topics.PROCESS_EVENT, answer)

    def _carried_out(self, order: fm.SignalOrder) -> fm.ProcessEvent | None:
        try:
            victim = find_node(order.node, order.signal, self._base_port)
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

    def _known(self, node: str) -> int:
        """Return the highest incarnation of a node that was issued anywhere, as known here."""
        return max(self.context.register(node) or 0, self.highest_of(node))

    def _issue(self, node: str, incarnation: int) -> None:
        """Have all readers of this host know the incarnation of a node that does not run here."""
        if incarnation > (self.context.register(node) or 0):
            try:
                issue(self._folder, [node], incarnation)
            except OSError as error:
                self.report_diagnostic("incarnation", f"not noted: {error}", node)

    def excuse(self, now_s: float, missed_s: float) -> None:
        """Do not count as silence of other hosts either what could not be received."""
        super().excuse(now_s, missed_s)
        self._placement.excuse(now_s, missed_s)

    def check(self) -> None:
        """Look for processes and for hosts that are silent."""
        super().check()
        changes = self._placement.look(self._now_s(), self._has_states)
        if changes == Changes():
            return
        for host in changes.lost:
            self._copies.lost(host)
            self._tell_of(host, "unreachable")
        for host in changes.back:
            self._tell_of(host, "back")
        for unit in changes.drop:
            self._drop(unit)
        for unit, above in changes.take:
            self.take_on(unit, above)
        self.publish_table()

    # -- what follows ---------------------------------------------------------------------------

    def _drop(self, unit: str) -> None:
        process = self.hand_over(unit)
        if process is not None:
            for node in process.names:  # one that was asked for may have begun
                self._issue(node, process.highest + process.waits)
            self._copies.unsettle(process.names)
            self._ending.update(process.names)
            self._settle(process)

    # -- states of nodes ------------------------------------------------------------------------

    def _state_kept(self, node: str, record: Record | None, is_last: bool) -> None:
        self._copies.kept(node, record)
        if is_last and node not in self._ending:
            self._copies.settled(node)
        self.publish(topics.CHECKPOINTS, self._copies.changes())

    def _state_problem(self, node: str, problem: str) -> None:
        self.report_diagnostic("checkpoint", problem, node)

    def _settle(self, process: SupervisedProcess) -> None:
        """Have the states of a process that was handed over looked at when it has ended."""
        if process.asks or not process.handle.gone():
            self.call_later(_ENDING_S * self.clock.rate, partial(self._settle, process))
            return
        process.let_go()
        self._ending.difference_update(process.names)
        for node in self._copies.nodes:
            if node in process.names:
                self._files.settle(node)

    def _has_states(self, unit: str) -> bool:
        """Whether a unit that was given back can go on from what it has kept there."""
        told, now_s = self._placement.told_of(unit), self._now_s()
        since_s = self._waits.setdefault((unit, max(told.values())), now_s)
        if self._copies.is_caught_up(told, told):
            return True
        if now_s - since_s < _WAIT_S:
            return False
        self._state_problem(unit, "the last state was not sent in time by the host that gave "
                                "it back; starting with what is here")
        return True

    @every(0.5)
    def tell_states(self) -> None:
        """Repeat what is held here."""
        if self._copies.nodes:
            self.publish(topics.CHECKPOINTS, self._copies.all())

    # -- what it says ---------------------------------------------------------------------------

    def _tell_of(self, host: str, event: str) -> None:
        other, own = host or "the first", self.parameters.host or "the first"
        self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
            on_host(SUPERVISOR, host), event, 0, 0, self.name,
            f"host {other}, as seen from {own}"))

    def _own_rows(self) -> tuple[fm.NodeInfo, ...]:
        return tuple(fm.NodeInfo(
            row.name, row.kind, row.pid, row.state, row.incarnation, row.restarts, row.late_s,
            self.parameters.host) for row in super().rows())

    def publish_table(self) -> None:
        """Publish what runs here, and what was given back."""
        given_back = (fm.NodeInfo(node, "", 0, fm.NodeState.UNREACHABLE, highest, 0, host=home)
                      for node, home, highest in self._placement.given_back())
        self.publish(topics.HOST_NODES, fm.NodeTable((*self._own_rows(), *given_back)))


def _kill(pid: int, number: Signals) -> None:
    kill(pid, number)  # it may be gone by now


class FirstSupervisor(HostSupervisor):
    """The first host's, which tells what runs on all of them."""

    outputs: ClassVar[tuple[Topic[Any], ...]] = (*HostSupervisor.outputs, topics.NODES)

    def rows(self) -> tuple[fm.NodeInfo, ...]:
        """Return the nodes of all hosts."""
        others = tuple(
            row if not self._placement.is_lost(row.host) else fm.NodeInfo(
                row.name, row.kind, 0, fm.NodeState.UNREACHABLE, row.incarnation, row.restarts,
                host=row.host) for row in self._placement.rows())
        return (*self._own_rows(), *others)

    def publish_table(self) -> None:
        """Publish likewise, and what runs on all hosts."""
        super().publish_table()
        self.publish(topics.NODES, fm.NodeTable(self.rows()))
