"""A stick made of keys, for a terminal. Pure.

A terminal tells that a key was pressed, and goes on telling while it is held; it never tells that
it was let go. So the dead man is the *repetition*: each key counts for `HOLD_S`, and without the
next one the stick is let go. Between the first press and its first repetition most keyboards wait
for 0.25 to 0.5 s; on one that waits longer the robot stops once before it drives on.
"""

from __future__ import annotations

from rampart.actors.osmosis.messages import Joystick

HOLD_S = 0.5
"""Real seconds for which a key counts; with the period of sending and the way to the base it
stands within 0.6 s."""

STEP = 0.1
_DIRECTIONS: dict[str, tuple[float, float]] = {
    "up": (1, 0), "down": (-1, 0), "left": (0, 1), "right": (0, -1),
    "u": (1, 1), "i": (1, 0), "o": (1, -1), "j": (0, 1), "l": (0, -1),
    "m": (-1, -1), ",": (-1, 0), ".": (-1, 1)}
"""Arrow keys, and the letters of ROS's teleop_twist_keyboard, which can do both at once. Backing
up, m and . turn so that the robot's tail goes to their side."""

_LET_GO = (" ", "k")


class KeyboardStick:
    """Keys in, position of the stick out.

    Args:
        speed: share of full speed to begin with, 0.1 to 1.
    """

    def __init__(self, speed: float = 0.5) -> None:
        self.speed = min(max(speed, STEP), 1.0)
        self._direction = (0.0, 0.0)
        self._until_s = 0.0

    def press(self, key: str, now_s: float) -> bool:
        """Take a key at a real time; return whether it means anything."""
        if key in _DIRECTIONS:
            self._direction = _DIRECTIONS[key]
            self._until_s = now_s + HOLD_S
        elif key in _LET_GO:
            self._until_s = now_s
        elif key in {"+", "="}:
            self.speed = min(1.0, round(self.speed + STEP, 1))
        elif key == "-":
            self.speed = max(STEP, round(self.speed - STEP, 1))
        else:
            return False
        return True

    def stick(self, now_s: float) -> Joystick:
        """Return the position at a real time."""
        if not now_s < self._until_s:
            return Joystick(0.0, 0.0, False)
        forward, left = self._direction
        return Joystick(forward * self.speed, left * self.speed, True)
