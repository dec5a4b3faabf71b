"""The kinds of fields that messages are made of, each with its bounds.

A field is bounded where it is decoded, once, so that no handler has to ask whether a number can be
added to or a text be shown: whatever is beyond never reaches an actor, and is reported as `payload
rejected`. The bounds are no contract of the robot's but what a message can mean at all: generous,
and the same for all systems. `tests/actors/bus/test_message_bounds.py` finds a field that has none.

Measurements and commands (poses, velocities, distances, an illuminance) are plain `float` on
purpose. NaN and infinity are what a broken sensor or controller publishes, and it is the subject of
detection modules and of the Safety Pilot to see them and to judge them, which they could not if the
bus took them away.

A node must not publish what its readers refuse: a text that it did not make itself (of an
exception, of a request, of names joined) is shortened with `clip` where the message is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import msgspec

Meta = msgspec.Meta
T = TypeVar("T")

NAME_CHARS = 256
"""Longest name of a node, module, topic, light or order; a file name has as many at most."""

TEXT_CHARS = 2000
"""Longest reason or explanation."""

DOCUMENT_CHARS = 500_000
"""Longest system spec; that of the full robot has ten thousand."""

MAX_PAYLOAD_BYTES = 1 << 20
"""Longest message of any topic, header included. It is looked at before anything is decoded."""

MANY = 4096
"""Most nodes, modules, goals of a mission: things that a system or a person counts one by one."""

MOST = 10_000
"""Most way points of a route, lights of an airport: things that are counted by a program."""

Name = Annotated[str, Meta(max_length=NAME_CHARS)]
Text = Annotated[str, Meta(max_length=TEXT_CHARS)]
Document = Annotated[str, Meta(max_length=DOCUMENT_CHARS)]
Few = Annotated[tuple[T, ...], Meta(max_length=16)]
Many = Annotated[tuple[T, ...], Meta(max_length=MANY)]
Most = Annotated[tuple[T, ...], Meta(max_length=MOST)]
Names = Many[Name]
Texts = Many[Text]
Explained = Many[tuple[Name, Text]]
"""Names, each with what there is to say of it."""

Count = Annotated[int, Meta(ge=0, le=2**53)]
"""Whole numbers that are counted up; exact in JSON and in a page's script too."""

Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
"""A whole number that stands for nothing countable, as a seed does."""

Pid = Annotated[int, Meta(ge=0, le=2**22)]
"""Process of this machine: Linux has no higher ones. 0 if there is none."""

Incarnation = Count
"""How many-th process of a node, from 1; 0 before the first. A lost host takes a million."""

Seconds = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""A point in simulated time: finite."""

Duration = Annotated[float, Meta(ge=0, le=1e12)]
"""A length of simulated time: finite."""

Lasting = Annotated[float, Meta(ge=0)]
"""A length of simulated time, which may be infinite: then it does not end."""

Floats32 = Annotated[bytes, Meta(max_length=4 * 65_536)]
"""Little-endian float32 numbers."""


def clip(text: str, chars: int = TEXT_CHARS) -> str:
    """Return a text as a message can carry it: not longer than `chars`, and encodable."""
    if not text.isascii():
        text = text.encode("utf-8", "replace").decode()
    return text if len(text) <= chars else f"{text[:chars - 3]}..."


def bare(kind: Any) -> Any:
    """Return the type of a field without its bounds; those of its parts are left."""
    return kind.__origin__ if hasattr(kind, "__metadata__") else kind


NARROW = 1e6
"""A range that is wider says what a message can mean at all, and nothing of what is usual."""


def narrow_range(metas: Sequence[msgspec.Meta]) -> tuple[float, float] | None:
    """Return the least and the greatest number that a field declares; None if it does not."""
    low = [b for m in metas for b in (m.ge, m.gt) if b is not None]
    high = [b for m in metas for b in (m.le, m.lt) if b is not None]
    if not low or not high or not 0 < min(high) - max(low) < NARROW:
        return None
    return float(max(low)), float(min(high))


def oversized(value: Any, budget: int, depth: int) -> bool:
    """Tell whether a value of any type holds more than `budget` bytes, or is nested too deep.

    Args:
        value: of what msgpack can hold.
        budget: bytes, where each number or container counts as eight.
        depth: containers that may lie within each other.
    """
    left = budget

    def fits(part: Any, depth: int) -> bool:
        nonlocal left
        left -= len(part) if isinstance(part, str | bytes) else 8
        if left < 0:
            return False
        if isinstance(part, dict):
            return depth > 0 and all(
                fits(k, depth - 1) and fits(v, depth - 1) for k, v in part.items())
        if isinstance(part, list | tuple):
            return depth > 0 and all(fits(p, depth - 1) for p in part)
        return True

    return not fits(value, depth)
