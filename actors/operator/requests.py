"""What a page may ask of its node: one struct each, decoded strictly. Pure.

An unknown tag, an unknown field or a wrong type makes the whole message refused; so does a number
that JSON cannot hold. Whether a request makes sense now is not decided here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Generic, TypeVar, Union

import msgspec

from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.web.visitors import Role

Name = Annotated[str, msgspec.Meta(max_length=200)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=86_400)]
_Share = Annotated[float, msgspec.Meta(ge=-1, le=1)]
R = TypeVar("R")


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks for; the tag of a derived class is the `type` of its JSON.

    Class attributes:
        role: who may; what declares none is for those who may do everything.
    """

    role: ClassVar[Role] = Role.INJECT


class ResetRequest(Request, frozen=True, tag="reset"):
    """A latched recovery is to be released."""

    role = Role.DRIVE
    recovery: Name


class StrategyRequest(Request, frozen=True, tag="strategy"):
    """Another strategy is to be set: it changes what is done about faults, as injecting does."""

    name: Name


class SignalRequest(Request, frozen=True, tag="signal"):
    """A signal is to be sent to the process of a node."""

    node: Name
    signal: Name


class InjectRequest(Request, frozen=True, tag="inject"):
    """A fault is to be injected.

    `duration_s` None takes the fault's own, `permanent` lets it last; both in simulated seconds,
    as is `delay_s`, the time until it begins.
    """

    fault: Name
    delay_s: _Seconds = 0.0
    duration_s: Annotated[float, msgspec.Meta(gt=0, le=86_400)] | None = None
    permanent: bool = False


class EndFaultRequest(Request, frozen=True, tag="end-fault"):
    """An injected fault is to end now."""

    injection: Name


class StickRequest(Request, frozen=True, tag="stick"):
    """Where the stick of a panel is, and whether the operator holds it.

    `ticket` is the newest that the page was given (`stick`), `pressed_s` for how long the stick has
    been held by the browser's clock.
    """

    role = Role.DRIVE
    panel: Name
    held: bool
    ticket: float = 0.0
    forward: _Share = 0.0
    left: _Share = 0.0
    pressed_s: float = 0.0


REQUESTS: tuple[type[Request], ...] = (
    ResetRequest, StrategyRequest, SignalRequest, InjectRequest, EndFaultRequest, StickRequest)
"""What every page may ask for."""


class RefusedError(ValueError):
    """A request that cannot be met; the text is shown on the page."""


class RequestError(ValueError):
    """A message that is no request; the text says what is wrong with it."""


class RequestReader:
    """Reads the messages of a page.

    Args:
        kinds: of requests that there are.
    """

    def __init__(self, kinds: Sequence[type[Request]]) -> None:
        self._decoder: msgspec.json.Decoder[Request] = msgspec.json.Decoder(
            Union[tuple(kinds)])  # noqa: UP007 known at run time

    def read(self, text: str | bytes | None) -> Request:
        """Decode a message of a page.

        Raises:
            RequestError: it is none.
        """
        try:
            return self._decoder.decode(text or b"")
        except UNREADABLE as error:
            raise RequestError(f"message not understood: {error}") from None


class Pending(Generic[R]):
    """The one message of a kind that is sent again and again until it is answered.

    Args:
        prefix: of the messages' ids; another one for each incarnation of the node.
        unanswered: what is said of one that was withdrawn.
        patience_s: simulated seconds after which it is.

    Attributes:
        pending: the message to be sent now and again, or None.
        name: what it asks for, for people.
    """

    def __init__(self, prefix: str, unanswered: str, patience_s: float) -> None:
        self.pending: R | None = None
        self.name = ""
        self._prefix = prefix
        self._unanswered = unanswered
        self._patience_s = patience_s
        self._asked = 0
        self._give_up_s = float("inf")

    def new_id(self) -> str:
        """Return the id of the next message.

        Raises:
            RefusedError: there is one that waits.
        """
        if self.pending is not None:
            raise RefusedError(f"{self.name} waits for its answer")
        self._asked += 1
        return f"{self._prefix}.{self._asked}"

    def put(self, name: str, message: R, now_s: float) -> R:
        """Have a message wait from now on, simulated seconds; for ever without patience."""
        self.pending, self.name, self._give_up_s = message, name, now_s + self._patience_s
        return message

    def settle(self) -> str:
        """Take an answer: nothing waits any more. Return what was asked for."""
        self.pending = None
        return self.name

    def expire(self, now_s: float) -> str:
        """Withdraw a message that stays without an answer, and return what to tell; "" if none."""
        if self.pending is None or now_s < self._give_up_s:
            return ""
        return f"{self.settle()} {self._unanswered}"
