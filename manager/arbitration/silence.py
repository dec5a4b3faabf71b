"""How long a node has been silent, charged across its incarnations.

A process that hangs right after its start still sends its first message, and so does each
successor. If that message ended the silence, a node that never works would never be silent. So the
first message of a new incarnation only starts an account: silence is repaid by the time over which
one and the same incarnation is received, `REPAID` times as fast as it ran up. A successor that
works has repaid its predecessor's gap after two or three messages; a successor that hangs adds to
it. Only the incarnation that a reader meets first is believed at once: no silence came before.
"""

from __future__ import annotations

import math

import msgspec

REPAID = 5.0
"""Seconds of silence that one second of work repays: who works for less than a sixth of the time is
silent in the end. A successor that is heard ten times a second repays a second in 0.2 s."""


class Silence(msgspec.Struct, frozen=True):
    """What is known of one node; times are those at which its messages were true, in seconds.

    Attributes:
        worked_s: Since when it is silent; as of the newest message, until when it worked.
        heard_s: Of its newest message.
        incarnation: That sent it; 0 before the first one.
    """

    worked_s: float = -math.inf
    heard_s: float = -math.inf
    incarnation: int = 0

    def heard(self, stamp_s: float, incarnation: int) -> Silence:
        """Return what is known after a message; an overtaken one changes nothing."""
        if not self.incarnation:
            return Silence(stamp_s, stamp_s, incarnation)
        if incarnation != self.incarnation:
            return Silence(self.worked_s, stamp_s, incarnation)
        if stamp_s <= self.heard_s:
            return self
        worked_s = self.worked_s + REPAID * (stamp_s - self.heard_s)
        return Silence(min(worked_s, stamp_s), stamp_s, incarnation)
