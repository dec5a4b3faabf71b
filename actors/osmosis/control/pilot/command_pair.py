"""Selects between the commands of Osmosis Control and its hot standby. Pure.

Osmosis Control drives. The standby takes over as soon as the active command is refused or late, and
returns control after the active one has been good for a while, so that control does not alternate
with an intermittent source.

**Comparison.** Two instances cannot show which one is wrong, but in each component the smaller
value is the safer one. While they disagree the robot drives these values, and slowly, so that it
cannot leave its lane until detection and restart are complete. If one turn rate has a constant
error, the healthy instance turns more and more against the growing heading error, until *its* rate
is the smaller one: the loop stays closed. (This is duplex with comparison; a third instance could
vote, at the cost of a third process.)

A disagreement has to last, because the processes compute at different times, which shows while the
turn rate changes. Without a partner for comparison the doubt ends after `FORGET_S`, in which the
restarts had their chance.
"""

from __future__ import annotations

import math

Command = tuple[float, float]
"""Linear velocity, m/s, and turn rate, rad/s, of `base_link`."""

FORGET_S = 5.0
"""Time after the last comparison at which a doubt ends."""

TAKEOVER_S = 0.2
"""Age of the active command at which a fresher standby drives: four periods."""

RETURN_S = 0.5
"""Time that the active command must have been good to drive again."""

SETTLING_S = 1.5
"""Time that a restarted follower takes to accelerate; meanwhile the other one drives, and
differences raise no new doubt."""

LINEAR_MPS = 0.25
"""Tolerated difference of speeds."""

ANGULAR_RADPS = 0.35
"""Tolerated difference of turn rates."""

DOUBT_S = 0.15
"""Time of disagreement that raises a doubt."""

REASSURED_S = 0.3
"""Time of agreement that ends a doubt."""

CAUTION_MPS = 0.3
"""Top speed during a doubt."""


class CommandPair:
    """Selects one of two commands. Times are simulated seconds; refused commands are None."""

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
        if self._is_restarted(0, incarnation):
            self._good_from_s = self._settled_s = now + SETTLING_S
        elif command is None:
            self._good_from_s = math.inf
        elif self._good_from_s == math.inf or (
                now - self._active_s > TAKEOVER_S and self._active_s > -math.inf):
            # A source that was wrong or late has to prove itself; a first command has not.
            self._good_from_s = now + RETURN_S
        self._active, self._active_s = command, max(stamp_s, self._active_s)
        self._compare(now)

    def standby(self, command: Command | None, stamp_s: float, incarnation: int, now: float
                ) -> None:
        """Take the standby's command, or None for a refused one."""
        if self._is_restarted(1, incarnation):
            self._settled_s = now + SETTLING_S
        self._standby, self._standby_s = command, max(stamp_s, self._standby_s)
        self._compare(now)

    def _is_restarted(self, source: int, incarnation: int) -> bool:
        before, self._incarnations[source] = self._incarnations[source], incarnation
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
        """Whether the two disagree."""
        return now - self._apart_since_s >= DOUBT_S and now - self._compared_s <= FORGET_S

    def choice(self, active: tuple[Command | None, str], standby: Command | None, now: float
               ) -> tuple[Command | None, str]:
        """Return the command to execute with a remark; None with the reason.

        Args:
            active: the active command, or None with the reason.
            standby: the standby's command, or None.
            now: now.
        """
        command, why = active
        if standby is None:
            return self._carefully(command, now) if command is not None else (None, why)
        late = now - self._active_s > TAKEOVER_S and self._standby_s > self._active_s
        if command is None or late or now < self._good_from_s:
            reason = why or ("no fresh command" if late else "osmosis control has just recovered")
            standby, doubt = self._carefully(standby, now)
            return standby, f"standby drives: {reason}" + (f"; {doubt}" if doubt else "")
        if not self.in_doubt(now):
            return command, ""
        gentle = (min(command[0], standby[0], key=abs), min(command[1], standby[1], key=abs))
        return self._carefully(gentle, now)

    def _carefully(self, command: Command, now: float) -> tuple[Command, str]:
        """Return a command, slowed down during a doubt, and a remark."""
        if not self.in_doubt(now):
            return command, ""
        linear_mps = max(-CAUTION_MPS, min(CAUTION_MPS, command[0]))
        return (linear_mps, command[1]), "active and standby disagree"
