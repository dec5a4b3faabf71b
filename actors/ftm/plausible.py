"""Which stamps and readings are possible at all.

A stamp from the future would stay fresh permanently, and shut out all correct ones after it. An
absurd number would overflow in a square, or stay in a sum. Checked nodes and their checkers share
these functions, as they share the envelope, which refuses such stamps first.
"""

from __future__ import annotations

import math

from rampart.actors.bus.envelope import AHEAD_S

ABSURD = 1e7
"""Larger than any coordinate in m, angle in rad or rate of a robot."""


def is_possible(stamp_s: float, now_s: float) -> bool:
    """Whether a stamp is finite and not in the future."""
    return math.isfinite(stamp_s) and stamp_s <= now_s + AHEAD_S


def is_sane(*values: float) -> bool:
    """Whether all are finite, and none is absurd."""
    return sum(map(abs, values)) < ABSURD
