"""The FTM Manager: the arbiter as an actor.

The arbiter decides. The actor passes it each report, and sends the resulting commands before the
handler of that message returns, so no recovery waits for a timer. Timers repeat commands, publish
the status, and let the arbiter detect silence.

After its death the manager adopts what the recovery modules report as activated, and releases
nothing before all have reported. The rest comes from its checkpoint
(`rampart.manager.arbitration.arbiter_memory`). Unlike other actors it writes the checkpoint *after*
sending the commands: an emergency stop does not wait for a disk.
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec.structs import replace

from rampart.actors.bus.bounds import DOCUMENT_CHARS, clip
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.machine.absence import ABSENT_S, Absence
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.actors.runtime.run_plan import tailor
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import heard, published
from rampart.manager.arbitration.arbiter import build_arbiter
from rampart.manager.arbitration.arbiter_memory import (
    Memory,
    objection,
    recall,
    remember,
    take_over,
)
from rampart.manager.arbitration.arbiter_state import (
    Command,
    DecisionMade,
    Input,
    RecoveryHeard,
    ResetAnswered,
    ResetAsked,
    ShadowDiffered,
    State,
    Tick,
)
from rampart.manager.arbitration.detection_track import DetectionHeard, overdue
from rampart.manager.spec.adaptation import Action, Change, Document, adapt, describe
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import check_change

MANAGER_STATE = StateFormat(Memory, version=2, objection=objection)

DECISIONS_PER_INCARNATION = 10_000
"""Each incarnation numbers its decisions from a multiple of this."""


class FtmManager(Actor):
    """Receives the reports of all modules, commands the recovery modules."""

    outputs = (topics.RECOVERY_COMMAND, topics.DECISION, topics.SHADOW, topics.RESPAWN,
               topics.MANAGER_STATUS, topics.ADAPTATION, topics.ADAPTED_SYSTEM)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._system: SystemSpec = context.run.system
        self._document: Document = dict(context.run.document)
        self._adapted: m.AdaptedSystem | None = context.run.adapted
        self._arbiter = build_arbiter(self._system, first_start=context.incarnation == 1)
        now_s = self.clock.now()
        self.arbiter_state = self._arbiter.initial(
            now_s, (context.incarnation - 1) * DECISIONS_PER_INCARNATION)
        self._ran_s = now_s
        self._absence = Absence(now_s, self.clock.rate)
        self._shown: m.ManagerStatus | None = None
        self._remembered: tuple[int, tuple[str, ...]] | None = None
        self._replaced: dict[str, int] = {}
        self._request = 0

    @classmethod
    def output_names(cls, topic: Topic[Any], name: str, parameters: Any) -> tuple[str, ...] | None:
        """Allow any recovery module as the receiver of a command."""
        return None if topic is topics.RECOVERY_COMMAND else super().output_names(
            topic, name, parameters)

    def reads(self, topic: Topic[Any]) -> tuple[str, ...]:
        """Read the reports of all modules."""
        modules = self._system.detections if topic is topics.DETECTION else self._system.recoveries
        return tuple(topic.at(module.name) for module in modules)

    def on_start(self) -> None:
        """Publish the status and the latched recoveries at once."""
        memory = self.kept(MANAGER_STATE)
        if memory is not None:
            self.arbiter_state = recall(
                self._arbiter, memory, self.clock.now(), self.arbiter_state.number)
            self.repeat()
        self._show()

    @every(1.0)
    def remember(self) -> None:
        """Write what a successor cannot find out to the checkpoint."""
        self._remembered = self.arbiter_state.number, self.arbiter_state.latched
        self.keep(MANAGER_STATE, remember(self.arbiter_state, self._arbiter))

    # -- inputs ---------------------------------------------------------------------------------

    @on(topics.DETECTION)
    def detection(self, message: m.DetectionReport, header: Header) -> None:
        """Pass the report of a detection module to the arbiter."""
        self._step(DetectionHeard(
            header.source, message.state is m.DetectionState.ACTIVE, message.reason,
            message.nodes, message.since_s, header.stamp, header.incarnation))

    @on(topics.RECOVERY)
    def recovery(self, message: m.RecoveryReport, header: Header) -> None:
        """Pass the report of a recovery module to the arbiter."""
        self._step(RecoveryHeard(
            header.source, message.state is m.RecoveryState.ACTIVATED, message.phase,
            message.decision, message.reason))

    @on(topics.RESET)
    def reset(self, message: m.Reset, header: Header) -> None:
        """Reset a latched recovery for the operator; names of other latches are ignored."""
        if any(recovery.name == message.recovery for recovery in self._system.recoveries):
            self._step(ResetAsked(message.recovery, message.by, header.stamp))

    @on(topics.ADAPT)
    def adapt(self, message: m.AdaptationRequest, _header: Header) -> None:
        """Change the system, if the result is sound and no recovery is under way."""
        try:
            change = Change(Action(message.action), message.name,
                            msgspec.json.decode(message.values, type=dict[str, Any]))
            reason = self._change(change, message.by)
        except Exception as error:  # no input of an operator may end the manager
            reason = " ".join(str(error).split()) or type(error).__name__
        self.publish(topics.ADAPTATION, m.AdaptationAnswer(
            message.request, not reason, clip(reason), self._version))

    @every(1.0)
    def repeat_system(self) -> None:
        """Repeat the changed system for late subscribers."""
        if self._adapted is not None:
            self.publish(topics.ADAPTED_SYSTEM, self._adapted)

    @every(0.1)
    def tick(self) -> None:
        """Let time pass, and publish the status."""
        self.read_postings()
        self._step(Tick())
        self._show()
        if self._system.layers.supervisor_respawn:
            self._replace_the_overdue()

    @every(0.2)
    def repeat(self) -> None:
        """Repeat the commands, in case one was lost."""
        state = self.arbiter_state
        for command in state.desired.values():
            # Until all modules have reported, a running recovery must not be released.
            if command.activate or state.oriented:
                self._command(command)

    # -- adaptation -----------------------------------------------------------------------------

    @property
    def _version(self) -> int:
        return self._adapted.version if self._adapted else 0

    def _change(self, change: Change, by: str) -> str:
        """Apply a change, whole or not at all; return why not, or ""."""
        if not self._document:
            return "this manager was started without a system file"
        file = f"{self._system.name}.toml"
        document, system = adapt(self._document, change, file)
        plan = replace(self.context.run.plan, system_file=file)
        system = tailor(plan, system)
        check_change(self._system, system)
        layout = Layout(plan, system)
        if plan.keys and (names := _with_other_topics(Layout(plan, self._system), layout)):
            return (f"{', '.join(names)}: would need other topics than the credentials of this run "
                    "permit; start it again with the changed system")
        if busy := self.arbiter_state.busy:
            return f"not in the middle of a recovery: {', '.join(busy)}; try again when it is over"
        text = msgspec.json.encode(document).decode()
        if len(text) > DOCUMENT_CHARS:
            return f"the system has {len(text)} characters; expected at most {DOCUMENT_CHARS}"
        arbiter = build_arbiter(system)
        self.arbiter_state = take_over(arbiter, self.arbiter_state, self.clock.now())
        self._arbiter, self._document, self._system = arbiter, document, system
        self._adapted = m.AdaptedSystem(self._version + 1, clip(describe(change)), by, text)
        self.publish(topics.ADAPTED_SYSTEM, self._adapted)
        self._step(Tick())
        return ""

    # -- outputs --------------------------------------------------------------------------------

    def _step(self, event: Input) -> None:
        now_s = self.clock.now()
        self._absence.note(now_s)
        # Before the run begins, silence is start-up.
        is_excused = now_s <= self.context.run.plan.begins_s or self._absence.excuses(now_s)
        missed_s = now_s - self._ran_s - (0.0 if is_excused else ABSENT_S)
        self._ran_s = now_s
        state = self.arbiter_state
        if missed_s > 0:
            state = forgive_absence(state, missed_s, now_s)
        self.arbiter_state, outputs = self._arbiter.step(state, event, now_s)
        for output in outputs:
            match output:
                case Command():
                    self._command(output)
                case DecisionMade():
                    self._publish_decision(output)
                case ShadowDiffered():
                    self.publish(topics.SHADOW, m.ShadowRecord(
                        output.number, output.strategy, output.decision.active,
                        output.decision.rule, output.decision.recoveries, output.taken))
                case ResetAnswered(granted=False):
                    self.report_diagnostic(m.RESET_REFUSED, output.reason, output.recovery)
        if self._status() != self._shown:
            self._show()
        if (self.arbiter_state.number, self.arbiter_state.latched) != self._remembered:
            self.remember()

    def _replace_the_overdue(self) -> None:
        """Request a restart of an overdue detection module, once for each incarnation.

        Not while another detection explains the delay, nor soon after the manager was stopped.
        """
        explaining = set(self._arbiter.mechanisms.explaining)
        if self._absence.excuses(self.clock.now()) or not explaining.isdisjoint(
                self.arbiter_state.active):
            return
        silent = overdue(self.arbiter_state.detections, self._arbiter.rules, self.clock.now())
        if silent is not None and self._replaced.get(silent.name) != silent.incarnation:
            self._replaced[silent.name] = silent.incarnation
            self._request += 1
            self.publish(topics.RESPAWN, m.RespawnRequest(
                self._request, silent.name, silent.incarnation, self.name))

    def _command(self, command: Command) -> None:
        self.publish(topics.RECOVERY_COMMAND, m.RecoveryCommand(
            command.activate, command.decision, command.nodes, clip(command.reason)),
            name=command.recovery)

    def _publish_decision(self, made: DecisionMade) -> None:
        decision = self._arbiter.explain(made)  # after the commands were sent
        self.publish(topics.DECISION, m.DecisionRecord(
            made.number, self._system.strategy, decision.active, decision.rule,
            decision.recoveries, tuple(map(clip, decision.path)),
            tuple((name, clip(why)) for name, why in decision.rejected), made.detected_s))

    def _status(self) -> m.ManagerStatus:
        state = self.arbiter_state
        views = tuple(m.DetectionView(t.name, t.active, t.reason, t.nodes)
                      for t in state.detections)
        return m.ManagerStatus(state.active, state.silent, state.activated, state.latched,
                               self._system.strategy, state.number, views)

    def _show(self) -> None:
        self._shown = self._status()
        self.publish(topics.MANAGER_STATUS, self._shown)


def _with_other_topics(before: Layout, after: Layout) -> list[str]:
    """Return the actors that would receive or publish other topics than before."""
    return [name for name, new in after.members.items() for old in [before.members[name]]
            if (heard(new), published(new)) != (heard(old), published(old))]


def forgive_absence(state: State, missed_s: float, now_s: float) -> State:
    """Return a state in which the last `missed_s` did not pass.

    While a manager is stopped, the reports of all modules wait unread. Taken for silence, this
    would be an emergency stop.
    """
    def later(at_s: float) -> float:
        return min(at_s + missed_s, now_s)

    return replace(
        state, started_s=later(state.started_s),
        since=tuple((name, later(since_s)) for name, since_s in state.since),
        detections=tuple(replace(t, heard_s=later(t.heard_s)) for t in state.detections),
        recoveries=tuple(replace(t, ordered_s=later(t.ordered_s)) for t in state.recoveries))
