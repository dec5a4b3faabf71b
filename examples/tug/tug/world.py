"""The world: the tug's base on the floor, its sensors, and the ground truth."""

from __future__ import annotations

import math
from random import Random

from rampart import Actor, Header, Positive, every, on
from tug import topics
from tug.floor import DOCK, DROP_OFF, PICK_UP, clearance_m, free_m
from tug.topics import Base, Free, Goal, Motion, Order, Place, Truth

STEP_S = 0.05
FASTEST_MPS, DRIVES_MPS2, BRAKES_MPS2 = 1.6, 1.0, 2.5


class World(Actor):
    """Simulates the tug: its wheels, which brake without a command, and its brake."""

    class Parameters(Actor.Parameters, frozen=True):
        """seed: of the noise; dead_man, dead_man_timeout_s: whether the wheels brake, and when."""

        seed: int = 1
        dead_man: bool = True
        dead_man_timeout_s: Positive = 0.4

    parameters: Parameters
    outputs = (topics.WHEELS, topics.MARKER, topics.FREE, topics.BASE, topics.TRUTH)

    _x_m, _y_m, _heading_rad = *DOCK, 0.0
    _moves = _commanded = Motion(0.0, 0.0)
    _commanded_s, _deliveries = 0.0, 0
    _braked = _hitched = _wants_hitch = False

    def on_start(self) -> None:
        """Seed the noise."""
        self._dice = Random(f"tug {self.parameters.seed}")  # noqa: S311 no secret

    @on(topics.DRIVE)
    def drive(self, message: Motion, header: Header) -> None:
        """Take a command of the wheels."""
        self._commanded, self._commanded_s = message, header.stamp

    @on(topics.BRAKE)
    def brake(self, message: Order, _header: Header) -> None:
        """Apply or lift the brake."""
        self._braked = message.stop

    @on(topics.GOAL)
    def goal(self, message: Goal, _header: Header) -> None:
        """Close or open the hitch."""
        self._wants_hitch = message.hitched

    @every(STEP_S)
    def step(self) -> None:
        """Advance by one step, and measure."""
        age_s = self.clock.now() - self._commanded_s
        lost = self.parameters.dead_man and not -0.1 < age_s < self.parameters.dead_man_timeout_s
        wanted = Motion(0.0, 0.0) if self._braked or lost else self._commanded
        most = (BRAKES_MPS2 if self._braked or lost else DRIVES_MPS2) * STEP_S
        speed = self._moves.speed_mps
        speed += min(max(wanted.speed_mps - speed, -most), most)
        speed = min(max(speed, -FASTEST_MPS), FASTEST_MPS)
        self._moves = Motion(speed, wanted.turn_radps)
        self._heading_rad += wanted.turn_radps * STEP_S
        self._x_m += speed * math.cos(self._heading_rad) * STEP_S
        self._y_m += speed * math.sin(self._heading_rad) * STEP_S
        self._couple()
        self._measure()

    def _couple(self) -> None:
        at = math.dist(DROP_OFF if self._hitched else PICK_UP, (self._x_m, self._y_m))
        if self._wants_hitch is not self._hitched and self._moves.speed_mps < 0.05 and at < 0.6:
            self._deliveries += self._hitched
            self._hitched = not self._hitched

    def _measure(self) -> None:
        x_m, y_m, moves, noise = self._x_m, self._y_m, self._moves, self._dice.gauss
        gap_m = clearance_m(x_m, y_m)
        goes_rad = self._heading_rad + math.pi * (moves.speed_mps < 0)
        self.publish(topics.TRUTH, Truth(x_m, y_m, moves.speed_mps, gap_m, self._deliveries))
        self.publish(topics.WHEELS, Motion(
            moves.speed_mps * noise(1.0, 0.02), moves.turn_radps * noise(1.0, 0.02)))
        self.publish(topics.FREE, Free(
            free_m(x_m, y_m, goes_rad), gap_m + noise(0.0, 0.01)))

    @every(2 * STEP_S)
    def look_up(self) -> None:
        """Read the markers and the base."""
        noise = self._dice.gauss
        self.publish(topics.MARKER, Place(
            self._x_m + noise(0.0, 0.02), self._y_m + noise(0.0, 0.02),
            self._heading_rad + noise(0.0, 0.01), 0.0))
        self.publish(topics.BASE, Base(self._braked, self._hitched))
