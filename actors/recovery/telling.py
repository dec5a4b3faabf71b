"""`Hold` and `Call`: recoveries that send messages to a node.

The messages are data of the specification. They are checked against the topic's type at load.
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


class _Messaging(RecoveryModule):
    """Publishes messages from its parameters."""

    class Parameters(RecoveryModule.Parameters, frozen=True, kw_only=True):
        """Topic of the messages.

        Attributes:
            topic: key of the topic.
        """

        topic: TopicPublished

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._topic = self.chosen_topic(self.parameters.topic)

    def _publish_fields(self, fields: dict[str, Any]) -> None:
        message: msgspec.Struct = msgspec.convert(fields, self._topic.type)
        self.publish(self._topic, message, name=self._topic.member(self.parameters.topic) or None)


class Hold(HeldRecovery, _Messaging):
    """Repeats a message while it is in force, and publishes another one when it ends.

    It is acting until the message is confirmed, and then degraded; without `confirm` at once. It
    fails if a lost confirmation does not come back within the deadline.
    """

    class Parameters(_Messaging.Parameters, frozen=True, kw_only=True):
        """Messages and confirmation.

        Attributes:
            message: fields of the message; others have their defaults.
            repeat_s: period of the message, s.
            back: fields of the message on release; none if left out.
            confirm: field that confirms the message, as "topic:field".
            equals: value of that field that confirms it.
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
        """Publish the message and repeat it."""
        super().act(command, renewed=renewed)
        if not self.parameters.confirm:
            self.degrade(f"published on {self.parameters.topic}")
        if self._repetition is None:
            self._again_later()

    def let_go(self) -> None:
        """Publish the end, and stop the message."""
        if self._repetition is not None:
            self._repetition.cancel()
            self._repetition = None
        super().let_go()

    def repeat(self) -> None:
        """Repeat only the end, since the message has its own period."""
        if not self.activated:
            super().repeat()

    def give(self, in_force: bool, why: str) -> None:  # noqa: ARG002
        """Publish the message, or the one on release."""
        message = self.parameters.message if in_force else self.parameters.back
        if message is not None:
            self._publish_fields(message)

    def _again_later(self) -> None:
        self._repetition = self.call_later(self.parameters.repeat_s, self._again)

    def _again(self) -> None:
        self.give(True, self.why)
        self._again_later()

    def _confirmed(self, value: Any, header: Header) -> None:
        self.confirm(in_force=value == self.parameters.equals, stamp_s=header.stamp,
                     reason=f"{self.parameters.confirm} is {value}")


class Call(_Messaging):
    """Publishes commands in order, each when the one before was answered.

    Example: restart a ROS 2 node with a life cycle by deactivate, clean up, configure, activate. It
    is acting until the last answer, and then done. A command is repeated until it is answered, so
    the node must accept it twice. Without repetition each answer counts, and a refusal is a failure
    unless the command is in `that_may_fail`.
    """

    class Parameters(_Messaging.Parameters, frozen=True, kw_only=True):
        """Commands and answers.

        Attributes:
            messages: fields of the commands, in order.
            answer: field with the answer, as "topic:field".
            equals: value of that field after a command was carried out.
            repeat_s: period of a command without that answer, s; 0 for no repetition.
            that_may_fail: indices of commands, from 0, that may be refused.
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
        """Begin, once per order."""
        if renewed:
            self.resume(command.reason)
        if renewed or self._at < 0:
            self._at = -1
            self._next()

    def let_go(self) -> None:
        """Forget the commands; none is taken back."""
        self._at = -1

    def unfinished(self) -> str:
        """Name the command without an answer."""
        chosen = self.parameters
        return (f"command {self._at + 1} of {len(chosen.messages)} on {chosen.topic} has no "
                f"answer: {chosen.answer} is not {chosen.equals}")

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
            self._publish_fields(self.parameters.messages[self._at])
            if self.parameters.repeat_s:
                self._repetition = self.call_later(self.parameters.repeat_s, self._give)

    def _answered(self, value: Any, header: Header) -> None:
        chosen = self.parameters
        if self.phase is not RecoveryPhase.ACTING or header.stamp < self._given_s:
            return
        if value == chosen.equals or self._at in chosen.that_may_fail:
            self._next()
        elif not chosen.repeat_s:
            self.fail(f"command {self._at + 1} of {len(chosen.messages)} on {chosen.topic}: "
                      f"{chosen.answer} is {value}")
