"""Requests of a page to its node, one struct each, decoded strictly. Pure.

A message with an unknown tag, an unknown field, a wrong type or a number beyond JSON is refused.
Whether a request can be fulfilled is decided elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Generic, TypeVar, Union

import msgspec

from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.web.visitors import Role

Name = Annotated[str, msgspec.Meta(max_length=200)]
_Share = Annotated[float, msgspec.Meta(ge=-1, le=1)]
R = TypeVar("R")


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of requests; the tag of a derived class is the `type` of its JSON.

    Class attributes:
        role: least role of the visitor; by default the highest.
    """

    role: ClassVar[Role] = Role.INJECT


class ResetRequest(Request, frozen=True, tag="reset"):
    """Release a latched recovery."""

    role = Role.DRIVE
    recovery: Name


class StrategyRequest(Request, frozen=True, tag="strategy"):
    """Set another strategy; it changes the reaction to faults, so it needs the role `inject`."""

    name: Name


class SignalRequest(Request, frozen=True, tag="signal"):
    """Send a signal to the process of a node."""

    node: Name
    signal: Name


class InjectRequest(Request, frozen=True, tag="inject"):
    """Inject a fault.

    `duration_s` None is the fault's default duration; `permanent` overrides it.
    """

    fault: Name
    duration_s: Annotated[float, msgspec.Meta(gt=0, le=86_400)] | None = None
    permanent: bool = False


class EndFaultRequest(Request, frozen=True, tag="end-fault"):
    """End an injected fault now."""

    injection: Name


class StickRequest(Request, frozen=True, tag="stick"):
    """Position of a panel's stick, and whether the operator holds it.

    `ticket` is the newest one that the page has received (`stick`), `pressed_s` the time for which
    the stick has been held, by the browser's clock.
    """

    role = Role.DRIVE
    panel: Name
    held: bool
    ticket: float = 0.0
    forward: _Share = 0.0
    left: _Share = 0.0
    pressed_s: float = 0.0


class SeenRequest(Request, frozen=True, tag="seen"):
    """Report that the page has drawn a version of the picture; it gets no answer."""

    version: int


REQUESTS: tuple[type[Request], ...] = (
    ResetRequest, StrategyRequest, SignalRequest, InjectRequest, EndFaultRequest, StickRequest)
"""Requests of every page."""


class RefusedError(ValueError):
    """A request cannot be fulfilled; the page shows the text."""


class RequestReader:
    """Decodes the messages of a page.

    Args:
        kinds: types of requests; `SeenRequest` is always one.
    """

    def __init__(self, kinds: Sequence[type[Request]]) -> None:
        self._decoder: msgspec.json.Decoder[Request] = msgspec.json.Decoder(
            Union[(*kinds, SeenRequest)])

    def read(self, text: str | bytes | None) -> Request:
        """Return the request in a message.

        Raises:
            RefusedError: it is not a request.
        """
        try:
            return self._decoder.decode(text or b"")
        except UNREADABLE as error:
            raise RefusedError(f"message not understood: {error}") from None


class Pending(Generic[R]):
    """The message of a kind that is repeated until it is answered.

    Args:
        prefix: of the messages' ids, unique to each incarnation of the node.
        unanswered: text about a message that was withdrawn.
        patience_s: simulated seconds without an answer after which it is withdrawn.

    Attributes:
        pending: the message to repeat, or None.
        name: name of the message for people.
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
            RefusedError: another message waits.
        """
        if self.pending is not None:
            raise RefusedError(f"{self.name} waits for its answer")
        self._asked += 1
        return f"{self._prefix}.{self._asked}"

    def put(self, name: str, message: R, now_s: float) -> R:
        """Make a message wait for its answer from now on, simulated seconds."""
        self.pending, self.name, self._give_up_s = message, name, now_s + self._patience_s
        return message

    def settle(self) -> str:
        """End the wait, and return the name of the message."""
        self.pending = None
        return self.name

    def expire(self, now_s: float) -> str:
        """Withdraw a message that is too old, and return a line about it; "" if there is none."""
        if self.pending is None or now_s < self._give_up_s:
            return ""
        return f"{self.settle()} {self._unanswered}"
