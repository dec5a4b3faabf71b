"""`Hold`, `SwitchMode`, `Call`, `CallEach`: recoveries that consist of telling a node something.

The message is data of the specification, checked against the topic's type before anything runs.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from rampart.actors.ftm.messages import RecoveryCommand
from rampart.actors.recovery.holding import HeldOrder, HeldRecovery
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import (
    FieldName,
    MessageOf,
    MessagesOf,
    OptionalFieldName,
    TopicPublished,
)
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.tables import NonNegative, Positive

Value = str | bool | float


class _Telling(RecoveryModule):
    """Publishes messages that its parameters say."""

    class Parameters(RecoveryModule.Parameters, frozen=True, kw_only=True):
        """What is said.

        Attributes:
            topic: key of the topic on which it is said.
            message: its fields; those left out have their defaults.
        """

        topic: TopicPublished
        message: MessageOf

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._topic = self.chosen_topic(self.parameters.topic)
        self._message = self._made(self.parameters.message)

    def _made(self, fields: dict[str, Any]) -> msgspec.Struct:
        made: msgspec.Struct = msgspec.convert(fields, self._topic.type)
        return made

    def _say(self, message: msgspec.Struct) -> None:
        self.publish(self._topic, message, name=self._topic.member(self.parameters.topic) or None)


class Hold(HeldRecovery, _Telling):
    """Says a message again and again while it is in force, and perhaps another when it ends.

    States: acting until the message is confirmed, then degraded; at once without `confirm`.
    A confirmation that is lost and does not come back within the deadline is a failure.
    """

    class Parameters(_Telling.Parameters, frozen=True, kw_only=True):
        """What is said when, and how it is known to be heeded.

        Attributes:
            repeat_s: how often the message is repeated, s.
            back: fields of the message that is said when it is released; none if left out.
            confirm: where it shows that the message is heeded, as "topic:field".
            equals: value of that field when it is.
        """

        repeat_s: Positive = 0.1
        back: MessageOf | None = None
        confirm: OptionalFieldName = ""
        equals: Value | None = None

        def __post_init__(self) -> None:
            """Refuse a confirmation without a value, and a value without a field."""
            if bool(self.confirm) != (self.equals is not None):
                missing = "equals" if self.confirm else "confirm"
                raise ValueError(f"{missing}: missing; confirm and equals go together")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self._back = None if said.back is None else self._made(said.back)
        self.order = HeldOrder(self, self._give, inherits=context.incarnation > 1)
        self._saying: Timer | None = None
        if said.confirm:
            self.hear_field(said.confirm, self._confirmed)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Say it, and go on saying it."""
        super().act(command, renewed=renewed)
        if not self.parameters.confirm:
            self.degrade(f"{self.parameters.topic} is told")
        if self._saying is None:
            self._say_again_later()

    def let_go(self) -> None:
        """Say that it is over, and no more that it is not."""
        if self._saying is not None:
            self._saying.cancel()
            self._saying = None
        super().let_go()

    def repeat(self) -> None:
        """Repeat the end for a while."""
        if not self.activated:
            super().repeat()

    def _give(self, in_force: bool, why: str) -> None:
        del why
        message = self._message if in_force else self._back
        if message is not None:
            self._say(message)

    def _say_again_later(self) -> None:
        self._saying = self.call_later(self.parameters.repeat_s, self._again)

    def _again(self) -> None:
        self.order.repeat()
        self._say_again_later()

    def _confirmed(self, value: Any, header: Header) -> None:
        said = self.parameters
        self.order.status(in_force=value == said.equals, reason=f"{said.confirm} is {value}",
                          stamp_s=header.stamp)


class SwitchMode(Hold):
    """Switches a node to another mode while it is in force, and back: `Hold`, all of it said."""

    class Parameters(Hold.Parameters, frozen=True, kw_only=True):
        """Which mode, how it shows, and to which it goes back; see `Hold.Parameters`."""

        back: MessageOf
        confirm: FieldName
        equals: Value

    parameters: Parameters


class Call(_Telling):
    """Gives one command, and is done when its answer comes.

    States: acting until the answer, then done. The command is repeated until it is answered, so a
    node has to take it as one if it comes twice.
    """

    class Parameters(_Telling.Parameters, frozen=True, kw_only=True):
        """Which command, and which answer.

        Attributes:
            answer: where the answer shows, as "topic:field".
            equals: value of that field when the command has been carried out.
            repeat_s: after how long without an answer the command is given again, s; 0: never.
        """

        answer: FieldName
        equals: Annotated[Value, msgspec.Meta()]
        repeat_s: NonNegative = 0.5

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._given = 0
        self.hear_field(self.parameters.answer, self._answered)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Give the command, once for each order."""
        if renewed:
            self.ordered_s = self.clock.now()
            self.resume(command.reason)
        if renewed or not self._given:
            self._give()

    def let_go(self) -> None:
        """Nothing is to be taken back."""
        self._given = 0

    def unfinished(self) -> str:
        """Name the answer that did not come."""
        return f"{self.parameters.answer} is not {self.parameters.equals}"

    def _give(self) -> None:
        self._given += 1
        self._say(self._message)
        if self.parameters.repeat_s:
            given = self._given
            self.call_later(self.parameters.repeat_s, lambda: self._unanswered(given))

    def _unanswered(self, given: int) -> None:
        if given == self._given and self.unanswered:
            self._give()

    @property
    def unanswered(self) -> bool:
        """Whether a command was given and its answer is still to come."""
        return self.activated and self.report.phase.value == "acting"

    def _answered(self, value: Any, header: Header) -> None:
        if self.unanswered and header.stamp >= self.ordered_s and value == self.parameters.equals:
            self.succeed(f"{self.parameters.answer} is {value}")


class CallEach(RecoveryModule):
    """Gives several commands, each when the one before was answered, and is done with the last.

    As a node of ROS 2 with a life cycle is restarted: deactivate, clean up, configure, activate.
    States: acting until the last answer, then done. An answer that refuses is a failure, unless the
    command was one `that_may_fail`.
    """

    class Parameters(RecoveryModule.Parameters, frozen=True, kw_only=True):
        """Which commands, and which answers.

        Attributes:
            topic: key of the topic of the commands.
            messages: their fields, in order.
            that_may_fail: places of those, from 0, after which it goes on whatever the answer is.
            answer: where the answer shows, as "topic:field".
            equals: value of that field when a command has been carried out.
        """

        topic: TopicPublished
        messages: MessagesOf
        that_may_fail: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] = ()
        answer: FieldName
        equals: Annotated[Value, msgspec.Meta()]

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._topic = self.chosen_topic(self.parameters.topic)
        self._at = -1
        self._given_s = 0.0
        self.hear_field(self.parameters.answer, self._answered)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Begin, once for each order."""
        if renewed:
            self.resume(command.reason)
        if renewed or self._at < 0:
            self._at = -1
            self._next()

    def let_go(self) -> None:
        """Nothing is to be taken back."""
        self._at = -1

    def unfinished(self) -> str:
        """Name the command that was not answered."""
        count = len(self.parameters.messages)
        return f"number {self._at + 1} of {count} on {self.parameters.topic} was not answered"

    def _next(self) -> None:
        self._at += 1
        if self._at == len(self.parameters.messages):
            self.succeed(f"{self._at} commands on {self.parameters.topic} were carried out")
            return
        self._given_s = self.clock.now()
        made: msgspec.Struct = msgspec.convert(
            self.parameters.messages[self._at], self._topic.type)
        self.publish(self._topic, made, name=self._topic.member(self.parameters.topic) or None)

    def _answered(self, value: Any, header: Header) -> None:
        said = self.parameters
        is_acting = self.activated and self.report.phase.value == "acting"
        if not is_acting or header.stamp < self._given_s:
            return
        if value == said.equals or self._at in said.that_may_fail:
            self._next()
        else:
            self.fail(f"number {self._at + 1} of {len(said.messages)} on {said.topic}: "
                      f"{said.answer} is {value}")
