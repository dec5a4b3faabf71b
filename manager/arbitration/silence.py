"""How long a node has been silent, accumulated over its incarnations.

A process that hangs right after its start still sends its first message, as does each successor. If
that message ended the silence, a node that never works would never be silent. So the silence goes
on, and decreases only while messages of one incarnation arrive, `REPAID` times as fast as it grew.
A working successor clears the gap within two or three messages. Only the first incarnation that a
reader meets counts at once, since no silence came before.
"""

from __future__ import annotations

import math

import msgspec

REPAID = 5.0
"""Seconds of silence that one second of messages clears: a node that works for less than a sixth of
the time becomes silent. Ten messages a second clear one second of silence in 0.2 s."""


class Silence(msgspec.Struct, frozen=True):
    """Silence of one node; times are time stamps of its messages, in seconds.

    Attributes:
        worked_s: Since when the node is silent.
        heard_s: Time stamp of its newest message.
        incarnation: Incarnation that sent it; 0 before the first message.
    """

    worked_s: float = -math.inf
    heard_s: float = -math.inf
    incarnation: int = 0

    def heard(self, stamp_s: float, incarnation: int) -> Silence:
        """Return the silence after a message; an overtaken message changes nothing."""
        if not self.incarnation:
            return Silence(stamp_s, stamp_s, incarnation)
        if incarnation != self.incarnation:
            return Silence(self.worked_s, stamp_s, incarnation)
        if stamp_s <= self.heard_s:
            return self
        worked_s = self.worked_s + REPAID * (stamp_s - self.heard_s)
        return Silence(min(worked_s, stamp_s), stamp_s, incarnation)
