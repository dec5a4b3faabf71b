"""`Hold` and `Call`: recoveries that consist of messages to a node.

The messages are data of the specification, checked against the topic's type before anything runs.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.recovery.holding import HeldRecovery
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
    """Publishes messages that its parameters contain."""

    class Parameters(RecoveryModule.Parameters, frozen=True, kw_only=True):
        """Where they are published.

        Attributes:
            topic: key of the topic.
        """

        topic: TopicPublished

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._topic = self.chosen_topic(self.parameters.topic)

    def _say(self, fields: dict[str, Any]) -> None:
        message: msgspec.Struct = msgspec.convert(fields, self._topic.type)
        self.publish(self._topic, message, name=self._topic.member(self.parameters.topic) or None)


class Hold(HeldRecovery, _Telling):
    """Repeats a message while it is in force, and publishes another one when it ends.

    States: acting until the message is confirmed, then degraded; at once without `confirm`.
    A confirmation that is lost and does not come back within the deadline is a failure.
    """

    class Parameters(_Telling.Parameters, frozen=True, kw_only=True):
        """What is published when, and how it is known to be obeyed.

        Attributes:
            message: its fields; those left out have their defaults.
            repeat_s: how often the message is repeated, s.
            back: fields of the message that is published when it is released; none if left out.
            confirm: where it shows that the message is obeyed, as "topic:field".
            equals: value of that field when it is.
        """

        message: MessageOf
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
        self._repetition: Timer | None = None
        if self.parameters.confirm:
            self.hear_field(self.parameters.confirm, self._confirmed)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Publish the message, and repeat it from now on."""
        super().act(command, renewed=renewed)
        if not self.parameters.confirm:
            self.degrade(f"{self.parameters.topic} is told")
        if self._repetition is None:
            self._again_later()

    def let_go(self) -> None:
        """Publish the end, and the message no more."""
        if self._repetition is not None:
            self._repetition.cancel()
            self._repetition = None
        super().let_go()

    def repeat(self) -> None:
        """Repeat the end for a while; the message has a period of its own."""
        if not self.activated:
            super().repeat()

    def give(self, in_force: bool, why: str) -> None:  # noqa: ARG002
        """Publish the message, or the one for the end."""
        message = self.parameters.message if in_force else self.parameters.back
        if message is not None:
            self._say(message)

    def _again_later(self) -> None:
        self._repetition = self.call_later(self.parameters.repeat_s, self._again)

    def _again(self) -> None:
        self.give(True, self.why)
        self._again_later()

    def _confirmed(self, value: Any, header: Header) -> None:
        self.confirm(in_force=value == self.parameters.equals, stamp_s=header.stamp,
                     reason=f"{self.parameters.confirm} is {value}")


class Call(_Telling):
    """Publishes commands, each when the one before was answered; done with the last answer.

    As a node of ROS 2 with a life cycle is restarted: deactivate, clean up, configure, activate.
    States: acting until the last answer, then done. A command is repeated until it is answered, so
    a node has to take it as one if it comes twice. Without repetition each answer counts: one that
    refuses is a failure, unless the command was one `that_may_fail`.
    """

    class Parameters(_Telling.Parameters, frozen=True, kw_only=True):
        """Which commands, and which answers.

        Attributes:
            messages: fields of the commands, in order.
            answer: where the answer shows, as "topic:field".
            equals: value of that field when a command has been carried out.
            repeat_s: after how long without that answer a command is repeated, s; 0: never.
            that_may_fail: places of commands, from 0, that may be refused.
        """

        messages: MessagesOf
        answer: FieldName
        equals: Annotated[Value, msgspec.Meta()]
        repeat_s: NonNegative = 0.5
        that_may_fail: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._at = -1
        self._given_s = 0.0
        self._repetition: Timer | None = None
        self.hear_field(self.parameters.answer, self._answered)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Begin, once for each order."""
        if renewed:
            self.resume(command.reason)
        if renewed or self._at < 0:
            self._at = -1
            self._next()

    def let_go(self) -> None:
        """Begin again with the next order; nothing is to be taken back."""
        self._at = -1

    def unfinished(self) -> str:
        """Name the command that was not answered."""
        told = self.parameters
        return (f"number {self._at + 1} of {len(told.messages)} on {told.topic} was not answered: "
                f"{told.answer} is not {told.equals}")

    def _next(self) -> None:
        self._at += 1
        if self._at == len(self.parameters.messages):
            self.succeed(f"{self._at} commands on {self.parameters.topic} were carried out")
        else:
            self._given_s = self.clock.now()
            self._give()

    def _give(self) -> None:
        if self._repetition is not None:
            self._repetition.cancel()
        if self.phase is RecoveryPhase.ACTING:
            self._say(self.parameters.messages[self._at])
            if self.parameters.repeat_s:
                self._repetition = self.call_later(self.parameters.repeat_s, self._give)

    def _answered(self, value: Any, header: Header) -> None:
        told = self.parameters
        if self.phase is not RecoveryPhase.ACTING or header.stamp < self._given_s:
            return
        if value == told.equals or self._at in told.that_may_fail:
            self._next()
        elif not told.repeat_s:
            self.fail(f"number {self._at + 1} of {len(told.messages)} on {told.topic}: "
                      f"{told.answer} is {value}")
