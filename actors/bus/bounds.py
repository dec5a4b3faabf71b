"""Field types of messages, each with its bounds.

A field is checked once, where it is decoded. A message beyond the bounds never reaches an actor and
is reported as `payload rejected`, so no handler has to check sizes. The bounds are generous and the
same for all systems: they limit what a message can mean, not what a robot does.
`tests/actors/bus/test_message_bounds.py` finds fields without bounds.

Measurements and commands (poses, velocities, distances, an illuminance) are plain `float` on
purpose. A broken sensor or controller publishes NaN and infinity. Detection modules and the Safety
Pilot have to see these values, so the bus must not remove them.

A node must not publish what its readers refuse. Text from elsewhere (exceptions, requests, joined
names) is shortened with `clip` when the message is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import msgspec

Meta = msgspec.Meta
T = TypeVar("T")

NAME_CHARS = 256
"""Longest name of a node, module, topic, light or order; also the limit of file names."""

TEXT_CHARS = 2000
"""Longest reason or explanation."""

DOCUMENT_CHARS = 500_000
"""Longest system specification."""

MAX_PAYLOAD_BYTES = 1 << 20
"""Longest message of any topic, header included; checked before decoding."""

MANY = 4096
"""Most items of lists that people write: nodes, modules, goals of a mission."""

MOST = 10_000
"""Most items of lists that programs make: way points of a route, lights of an airport."""

Name = Annotated[str, Meta(max_length=NAME_CHARS)]
Text = Annotated[str, Meta(max_length=TEXT_CHARS)]
Document = Annotated[str, Meta(max_length=DOCUMENT_CHARS)]
Few = Annotated[tuple[T, ...], Meta(max_length=16)]
Many = Annotated[tuple[T, ...], Meta(max_length=MANY)]
Most = Annotated[tuple[T, ...], Meta(max_length=MOST)]
Names = Many[Name]
Texts = Many[Text]
Explained = Many[tuple[Name, Text]]
"""Names, each with an explanation."""

Count = Annotated[int, Meta(ge=0, le=2**53)]
"""A counter; exact in JSON and JavaScript too."""

Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
"""Any integer of 64 bits, such as a seed."""

Pid = Annotated[int, Meta(ge=0, le=2**22)]
"""Process of this machine, up to the kernel's maximum; 0 for none."""

Incarnation = Count
"""Number of a node's process, from 1; 0 before the first. A lost host adds a million."""

Seconds = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""A point in simulated time: finite."""

Duration = Annotated[float, Meta(ge=0, le=1e12)]
"""A length of simulated time: finite."""

Lasting = Annotated[float, Meta(ge=0)]
"""A length of simulated time; infinity means without end."""

Floats32 = Annotated[bytes, Meta(max_length=4 * 65_536)]
"""Little-endian float32 numbers."""


def clip(text: str, chars: int = TEXT_CHARS) -> str:
    """Return a text shortened to `chars` and encodable, as messages require."""
    if not text.isascii():
        text = text.encode("utf-8", "replace").decode()
    return text if len(text) <= chars else f"{text[:chars - 3]}..."


def bare(kind: Any) -> Any:
    """Return the type of a field without its bounds; bounds of its parts stay."""
    return kind.__origin__ if hasattr(kind, "__metadata__") else kind


NARROW = 1e6
"""Widest range that describes usual values; wider ones only limit what a message can mean."""


def narrow_range(metas: Sequence[msgspec.Meta]) -> tuple[float, float] | None:
    """Return the range that a field declares; None if it has none, or a wide one."""
    low = [b for m in metas for b in (m.ge, m.gt) if b is not None]
    high = [b for m in metas for b in (m.le, m.lt) if b is not None]
    if not low or not high or not 0 < min(high) - max(low) < NARROW:
        return None
    return float(max(low)), float(min(high))


def oversized(value: Any, budget: int, depth: int) -> bool:
    """Return whether a value has more than `budget` bytes or is nested too deep.

    Args:
        value: Anything that msgpack can hold.
        budget: Bytes; each number or container counts as eight.
        depth: Most levels of nested containers.
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
