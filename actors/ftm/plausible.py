"""Which stamps and readings are possible at all: what is not must do no harm, now or later.

A stamp from the future would shut out all honest ones after it and stay fresh permanently. A number
beyond all measure would overflow in a square, or stay in a sum for good. The checked and
those who check them share these lines, as they share the envelope that refuses such stamps first.
"""

from __future__ import annotations

import math

from rampart.actors.bus.envelope import AHEAD_S

ABSURD = 1e7
"""No coordinate in m, no angle in rad and no rate of a robot is as large."""


def is_possible(stamp_s: float, now_s: float) -> bool:
    """Whether something may have been true at `stamp_s`: a number, and not ahead of now."""
    return math.isfinite(stamp_s) and stamp_s <= now_s + AHEAD_S


def is_sane(*values: float) -> bool:
    """Whether all are numbers, and none is absurd."""
    return sum(map(abs, values)) < ABSURD
