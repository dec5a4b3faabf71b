"""The supervisors of a system of several hosts: each runs what `Placement` gives it.

They tell each other what they run, and of which incarnation (`supervisor/{name}/nodes`). What one
hears is noted in the folder of the run on its own host, where every reader looks whether an
incarnation was issued; nobody but a supervisor writes there what another host has issued. The
first host's publishes the table of all.

With checkpoints they also hold the newest state of each node that either of two hosts may run
(`Copies`): what the other lacks they send, and a node that is given back starts when what it has
kept there has come.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable
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
from rampart.actors.hosts.parts import Wait
from rampart.actors.hosts.placement import FIRST, Changes, Home, Placement
from rampart.actors.hosts.state_files import StateFiles
from rampart.actors.runtime.actor import Context, Header, every, on
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.run_plan import SUPERVISOR, on_host
from rampart.actors.supervision.held_process import HeldProcess
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

_ENDING_S = 0.005
"""Real seconds between two looks whether a process that was given back has ended."""

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
        hosts, units = self._layout.hosts, self._layout.units
        own = self.parameters.host
        self._supervisors = {hosts.supervisors[host]: host for host in self.parameters.others}
        self._guards = {name: host for host in hosts.supervisors for name in hosts.guards_of(host)}
        self._signalled: deque[fm.ProcessEvent] = deque(maxlen=_ORDERS_KEPT)
        self._placement = Placement(
            own,
            {name: Home(hosts.home_of[unit.nodes[0].name], tuple(node.name for node in unit.nodes),
                        any(node.command or node.kind is Kind.WORLD for node in unit.nodes))
             for name, unit in units.items()},
            self._guards, hosts.link, self._known, now_s=self._loop.time(), rate=self._plan.rate)
        self._looked_s = self._loop.time()
        self._ending: list[HeldProcess] = []
        self._waits: dict[str, Wait] = {}
        self._copies = Copies(
            self._plan.run_id, own, {} if not self._keeps_states() else {
                node.name: home for name, unit in units.items() for node in unit.nodes
                if (home := hosts.home_of[unit.nodes[0].name]) != FIRST
                and not self._placement.is_fixed(name)},
            self._runs, lambda node: context.register(node) or 0)
        self._files = files(
            Path(self._plan.checkpoints), self._plan.run_id, self._copies.nodes,
            partial(self._from_thread, self._state_kept), partial(
                self._from_thread, self._state_problem))

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

    def on_start(self) -> None:
        """Adopt what is run here in another host's place as well.

        What ran on another host last is not begun here before the first has given it back.
        """
        living = {self._layout.unit_of.get(process.names[0], "")
                  for process in self._machine.living()}
        for unit in living - self._processes.keys() - {""}:
            self._placement.adopted(unit)
            self._processes[unit] = self._held(self._layout.units[unit])
        for unit in self._placement.waits(
                lambda unit: unit not in living and any(
                    is_elsewhere(self._plan.folder, node)
                    for node in self._processes[unit].names)):
            del self._processes[unit]
        super().on_start()
        if self._copies.nodes:
            self._files.start()
            self._tell_states()
            for node in self._copies.nodes:
                self._files.settle(node)
        self._look_at_hosts()

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
        if host != own and self._placement.heard(host, self._loop.time()):
            self._publish_table()  # each soon knows what the other runs
            self.tell_states()

    @on(topics.HOST_NODES)
    def told(self, table: fm.NodeTable, header: Header) -> None:
        """Note what another supervisor runs, and let go of what has a higher incarnation there."""
        host = self._supervisors.get(header.source)
        if host is None:
            return
        now_s = self._loop.time()
        was_missed = self._placement.heard(host, now_s)
        news, drop = self._placement.told(host, table.nodes, now_s)
        news = [row for row in news if row.name != header.source]  # of itself it is believed
        for row in news:
            self._issue(row.name, row.incarnation)
        for unit in drop:
            self._drop(unit)
        if news or drop or was_missed:
            self._publish_table()

    @on(topics.CHECKPOINTS)
    def told_states(self, message: fm.Checkpoints, header: Header) -> None:
        """Keep what another host holds and this one lacks, and note what that one lacks."""
        host = self._supervisors.get(header.source)
        if host is None or not self._copies.nodes:
            return
        taken = self._copies.told(host, message)
        for node, problem in taken.problems:
            self._state_problem(node, problem)
        for node, record in taken.records:
            self._files.take(node, record)
        if taken.wants_answer:
            self._tell_states()

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

    def _known(self, node: str) -> int:
        """Return the highest incarnation of a node that was issued anywhere, as known here."""
        process = self._process_of(node)
        return max(self.context.register(node) or 0, process.highest if process else 0)

    def _issue(self, node: str, incarnation: int) -> None:
        """Have all readers of this host know the incarnation of a node that does not run here."""
        if incarnation > (self.context.register(node) or 0):
            try:
                issue(self._plan.folder, [node], incarnation)
            except OSError as error:
                self.report_diagnostic("incarnation", f"not noted: {error}", node)

    def _look_at_hosts(self) -> None:
        # Who stood still has mail to read before others can be said to be silent.
        stall_s, self._looked_s = self._loop.time() - self._looked_s, self._loop.time()
        if stall_s > 4 * _LOOK_S:
            self._placement.excuse(stall_s)
        changes = self._placement.look(self._loop.time(), self._has_states)
        if changes != Changes():
            for host in changes.lost:
                self._copies.lost(host)
                self._tell_of(host, "unreachable")
            for host in changes.back:
                self._tell_of(host, "back")
            for unit in changes.drop:
                self._drop(unit)
            for unit, above in changes.take:
                self._take(unit, above)
            self._publish_table()
        self.call_later(_LOOK_S * self.clock.rate, self._look_at_hosts)

    # -- what follows ---------------------------------------------------------------------------

    def _take(self, unit: str, above: int) -> None:
        process = self._processes[unit] = self._held(self._layout.units[unit])
        process.incarnation = process.highest = above
        self._on(process, Event.START)

    def _drop(self, unit: str) -> None:
        process = self._processes.pop(unit, None)
        if process is not None:
            self._machine.withdraw(process.names)
            process.forget_step()
            process.kill()
            self._tell(process, "handed over", self.name)
            for node in process.names:  # one that was asked for may have begun
                self._issue(node, process.highest + process.waits)
            self._copies.unsettle(process.names)
            if not self._ending:
                self.call_later(_ENDING_S * self.clock.rate, self._settle)
            self._ending.append(process)

    def _is_let_go(self, process: HeldProcess) -> bool:
        return self._processes.get(process.unit.name) is not process

    def _ended(self, process: HeldProcess, pid: int, detail: str = "") -> None:
        if not self._is_let_go(process):  # while the news waited in the mailbox
            super()._ended(process, pid, detail)

    def _hold(self, process: HeldProcess, pid: int) -> None:
        super()._hold(process, pid)
        if self._is_let_go(process):  # before there was a descriptor to hold it by
            process.kill()

    # -- states of nodes ------------------------------------------------------------------------

    def _keeps_states(self) -> bool:
        return bool(self._plan.checkpoints) and self._spec.layers.checkpoints

    def _runs(self, node: str) -> int:
        """Return the highest incarnation of a node that is run here, 0 if it is not."""
        process = self._process_of(node)
        return process.highest if process else 0

    def _from_thread(self, call: Callable[..., None], node: str, *what: Any) -> None:
        """Have a call made as an item of the mailbox."""
        slot = f"{call.__name__} {node} {what[1:]}"
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(
                self._dispatcher.put, slot, partial(call, node, *what))

    def _state_kept(self, node: str, record: Record | None, is_last: bool) -> None:
        self._copies.kept(node, record)
        if is_last and all(node not in process.names for process in self._ending):
            self._copies.settled(node)
        self._tell_states()

    def _state_problem(self, node: str, problem: str) -> None:
        self.report_diagnostic("checkpoint", problem, node)

    def _settle(self) -> None:
        """Have what was ended here looked at for the last time."""
        gone = [process for process in self._ending if process.handle.gone()]
        for process in gone:
            self._ending.remove(process)
            process.let_go()
            for node in process.names:
                if node in self._copies.nodes:
                    self._files.settle(node)
        if self._ending:
            self.call_later(_ENDING_S * self.clock.rate, self._settle)

    def _has_states(self, unit: str) -> bool:
        """Whether a unit that was given back can go on from what it has kept there."""
        told, now_s = self._placement.told_of(unit), self._loop.time()
        is_caught_up = self._copies.is_caught_up(told, told)
        wait = self._waits.setdefault(unit, Wait(now_s))
        if not wait.is_vain(now_s, self._copies.come(told)) and not is_caught_up:
            return False
        if not is_caught_up:
            self._state_problem(unit, "the last state was not sent in time by the host that gave "
                                "it back; starting with what is here")
        return True

    @every(0.5)
    def tell_states(self) -> None:
        """Repeat what is held here, and what others lack of it."""
        if self._copies.nodes:
            self._tell_states()

    def _tell_states(self) -> None:
        self.publish(topics.CHECKPOINTS, self._copies.message(self._loop.time()))

    # -- what it says ---------------------------------------------------------------------------

    def _tell_of(self, host: str, event: str) -> None:
        other, own = host or "the first", self.parameters.host or "the first"
        self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
            self._layout.hosts.supervisors[host], event, 0, 0, self.name,
            f"host {other}, as seen from {own}"))

    def _own_rows(self) -> tuple[fm.NodeInfo, ...]:
        return tuple(fm.NodeInfo(
            row.name, row.kind, row.pid, row.state, row.incarnation, row.restarts, row.late_s,
            self.parameters.host) for row in super()._rows())

    def _publish_table(self) -> None:
        given_back = (fm.NodeInfo(node, "", 0, fm.NodeState.UNREACHABLE, highest, 0, host=home)
                      for node, home, highest in self._placement.given_back())
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
