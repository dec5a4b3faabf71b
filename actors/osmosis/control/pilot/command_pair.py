"""Two computers of one command: who drives, and what, when they disagree. Pure.

Osmosis Control drives. Its hot standby takes over in the moment in which the active one's command
is unusable (refused) or late, and gives back when the active one has been good for a while: going
back and forth with a source that stutters would help nobody.

**Comparison.** Of two that differ nobody can say which is wrong, but it is known which is the safer
in each component: the slower and the one that turns less. While they disagree the robot drives
that, and slowly, so that in the time that detection and respawn take it cannot leave its lane,
whoever is right. With a turn rate that is wrong by a constant, the healthy one turns more and more
against the growing heading error, until *its* rate is the smaller: the loop stays closed.
(Duplex with comparison, as in any textbook on fault-tolerant control; a third computer could vote,
and would cost a third process.)

A disagreement counts when it has lasted: two processes tick at different moments, and in a swing
of the turn rate that is a difference. When nobody is left to compare with, doubt ends after a
while: the comparison's respawns have then had their chance (`FORGET_S`).
"""

from __future__ import annotations

import math

Command = tuple[float, float]
"""Linear velocity, m/s, and turn rate, rad/s, of `base_link`."""

FORGET_S = 5.0
"""So long after the last comparison a doubt is over."""

# When the standby drives, and when the two disagree.
TAKEOVER_S = 0.2
"""Age of the active one's command at which a fresher standby drives: four periods."""

RETURN_S = 0.5
"""How long the active one must have been good to drive again."""

SETTLING_S = 1.5
"""How long a respawned follower takes to accelerate from its zero: meanwhile the other drives, and
a difference raises no new doubt."""

LINEAR_MPS = 0.25
"""Difference of speed that is none."""

ANGULAR_RADPS = 0.35
"""Difference of turn rate that is none."""

DOUBT_S = 0.15
"""How long they must have differed."""

REASSURED_S = 0.3
"""How long they must have agreed again."""

CAUTION_MPS = 0.3
"""Top speed while in doubt."""


class CommandPair:
    """Remembers from when the active one is good again, and since when the two differ.

    Times are simulated seconds. Commands that the gate refused are None.
    """

    def __init__(self) -> None:
        self._active: Command | None = None
        self._active_s = -math.inf
        self._good_from_s = -math.inf
        self._standby: Command | None = None
        self._standby_s = -math.inf
        self._incarnations = [0, 0]
        self._settled_s = -math.inf
        self._apart_since_s = math.inf
        self._agreed_since_s = -math.inf
        self._compared_s = -math.inf

    def active(self, command: Command | None, stamp_s: float, incarnation: int, now: float) -> None:
        """Take Osmosis Control's command, or None for a refused one."""
        if self._is_reborn(0, incarnation):
            self._good_from_s = self._settled_s = now + SETTLING_S
        elif command is None:
            self._good_from_s = math.inf
        elif self._good_from_s == math.inf or (
                now - self._active_s > TAKEOVER_S and self._active_s > -math.inf):
            # It makes good what was wrong or late; a first command has nothing to make good.
            self._good_from_s = now + RETURN_S
        self._active, self._active_s = command, max(stamp_s, self._active_s)
        self._compare(now)

    def standby(self, command: Command | None, stamp_s: float, incarnation: int, now: float
                ) -> None:
        """Take the standby's command, or None for a refused one."""
        if self._is_reborn(1, incarnation):
            self._settled_s = now + SETTLING_S
        self._standby, self._standby_s = command, max(stamp_s, self._standby_s)
        self._compare(now)

    def _is_reborn(self, who: int, incarnation: int) -> bool:
        before, self._incarnations[who] = self._incarnations[who], incarnation
        return 0 < before < incarnation

    def _compare(self, now: float) -> None:
        a, b = self._active, self._standby
        if a is None or b is None or now - min(self._active_s, self._standby_s) > TAKEOVER_S:
            return
        self._compared_s = now
        if abs(a[0] - b[0]) > LINEAR_MPS or abs(a[1] - b[1]) > ANGULAR_RADPS:
            self._agreed_since_s = math.inf
            if now >= self._settled_s:
                self._apart_since_s = min(self._apart_since_s, now)
            return
        self._agreed_since_s = min(self._agreed_since_s, now)
        doubt = now - self._apart_since_s >= DOUBT_S
        if not doubt or now - self._agreed_since_s >= REASSURED_S:
            self._apart_since_s = math.inf

    def in_doubt(self, now: float) -> bool:
        """Whether the two have differed for long enough, and have not agreed since."""
        return now - self._apart_since_s >= DOUBT_S and now - self._compared_s <= FORGET_S

    def choice(self, active: tuple[Command | None, str], standby: Command | None, now: float
               ) -> tuple[Command | None, str]:
        """Return the command to execute with what is special about it; None with why not.

        Args:
            active: the active one's command, or None and why it may not be executed.
            standby: the standby's, or None.
            now: now.
        """
        command, why = active
        if standby is None:
            return self._carefully(command, now) if command is not None else (None, why)
        late = now - self._active_s > TAKEOVER_S and self._standby_s > self._active_s
        if command is None or late or now < self._good_from_s:
            reason = why or ("no fresh command" if late else "the other is not good for long yet")
            standby, doubt = self._carefully(standby, now)
            return standby, f"standby drives: {reason}" + (f"; {doubt}" if doubt else "")
        if not self.in_doubt(now):
            return command, ""
        gentle = (min(command[0], standby[0], key=abs), min(command[1], standby[1], key=abs))
        return self._carefully(gentle, now)

    def _carefully(self, command: Command, now: float) -> tuple[Command, str]:
        """Return a command no faster than caution allows, and why."""
        if not self.in_doubt(now):
            return command, ""
        linear_mps = max(-CAUTION_MPS, min(CAUTION_MPS, command[0]))
        return (linear_mps, command[1]), "active and standby disagree"
