"""What a page may ask of the HMI: one struct each, decoded strictly. Pure.

An unknown tag, an unknown field or a wrong type makes the whole message refused; so does a number
that JSON cannot hold. Whether a wish makes sense now is not decided here.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.osmosis.messages import MissionAction

__all__ = ["AdaptWish", "EndFaultWish", "InjectWish", "MissionWish", "OrderWish", "RefusedError",
           "ResetWish", "SignalWish", "StickWish", "Wish", "WishError", "read_wish"]

_Name = Annotated[str, msgspec.Meta(max_length=200)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=86_400)]


class _Wish(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class ResetWish(_Wish, frozen=True, tag="reset"):
    """The operator wants a latched recovery released."""

    recovery: _Name


class MissionWish(_Wish, frozen=True, tag="mission"):
    """The operator wants a mission of the airport started."""

    name: _Name


class OrderWish(_Wish, frozen=True, tag="order"):
    """The operator wants something of the mission under way."""

    action: MissionAction
    reason: _Name = ""


class StickWish(_Wish, frozen=True, tag="stick"):
    """Where the operator's stick is, and whether the dead man is held.

    `ticket` is the newest that the page was given (`hmi_stick`). Forward and left are in [-1, 1].
    """

    held: bool
    ticket: int = 0
    forward: float = 0.0
    left: float = 0.0


class AdaptWish(_Wish, frozen=True, tag="strategy"):
    """The operator wants another strategy."""

    name: _Name


class SignalWish(_Wish, frozen=True, tag="signal"):
    """The operator wants a signal sent to the process of a node."""

    node: _Name
    signal: _Name


class InjectWish(_Wish, frozen=True, tag="inject"):
    """The operator wants a fault injected.

    `duration_s` None takes the fault's own, `permanent` lets it last; both in simulated seconds,
    as is `delay_s`, the time until it begins.
    """

    fault: _Name
    delay_s: _Seconds = 0.0
    duration_s: Annotated[float, msgspec.Meta(gt=0, le=86_400)] | None = None
    permanent: bool = False


class EndFaultWish(_Wish, frozen=True, tag="end-fault"):
    """The operator wants an injected fault to end now."""

    injection: _Name


Wish = (ResetWish | MissionWish | OrderWish | StickWish | AdaptWish | SignalWish | InjectWish
        | EndFaultWish)
_wishes = msgspec.json.Decoder(Wish)


class RefusedError(ValueError):
    """A wish that cannot be fulfilled; the text is shown on the page."""


class WishError(ValueError):
    """A message that is no wish; the text says what is wrong with it."""


def read_wish(text: str | bytes | None) -> Wish:
    """Decode a message of a page.

    Raises:
        WishError: it is none.
    """
    try:
        wish: Wish = _wishes.decode(text or b"")
    except UNREADABLE as error:
        raise WishError(f"message not understood: {error}") from None
    return wish
