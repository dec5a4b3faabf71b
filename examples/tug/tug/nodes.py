"""The tug's nodes: localization, mission, controller, pilot."""

from __future__ import annotations

import math

import msgspec

from rampart import Actor, Header, StateFormat, every, on
from tug import topics
from tug.floor import DOCK, DROP_OFF, PICK_UP, clearance_m
from tug.topics import Base, Free, Goal, Motion, Order, Place, Status


class Localization(Actor):
    """Integrates the motion of the wheels, corrected by the markers."""

    outputs = (topics.POSE,)
    _at: tuple[float, float, float] | None = None
    _wheels_s = 0.0

    @on(topics.WHEELS)
    def wheels(self, message: Motion, header: Header) -> None:
        """Integrate the motion of the wheels."""
        lasted_s = min(max(header.stamp - self._wheels_s, 0.0), 0.2)
        self._wheels_s = header.stamp
        if self._at is not None:
            x_m, y_m, heading_rad = self._at
            heading_rad += message.turn_radps * lasted_s
            way_m = message.speed_mps * lasted_s
            self._at = (x_m + way_m * math.cos(heading_rad), y_m + way_m * math.sin(heading_rad),
                        heading_rad)

    @on(topics.MARKER)
    def marker(self, message: Place, header: Header) -> None:
        """Correct the pose by a part of the difference to the markers, and publish it."""
        seen = (message.x_m, message.y_m, message.heading_rad)
        x_m, y_m, heading_rad = self._at or seen
        turned = math.remainder(seen[2] - heading_rad, math.tau)
        self._at = (0.8 * x_m + 0.2 * seen[0], 0.8 * y_m + 0.2 * seen[1],
                    math.remainder(heading_rad + 0.2 * turned, math.tau))
        self.publish(topics.POSE, Place(*self._at, clearance_m(*self._at[:2])),
                     stamp=min(header.stamp, self._wheels_s))


AISLES = ((1.0, 0.9), (7.0, 0.9)), ((1.0, 5.1), (7.0, 5.1))
STEPS = *((*place, hitched) for aisle in AISLES for place, hitched in (
    *((corner, False) for corner in aisle), (PICK_UP, False), (PICK_UP, True), (DROP_OFF, True),
    (DROP_OFF, False))), (*DOCK, False)
"""Places in order, each with the state of the hitch there."""


class Progress(msgspec.Struct, frozen=True):
    """State that survives the process: the next step."""

    step: int = 0


FORMAT = StateFormat(Progress, objection=lambda progress: (
    "" if 0 <= progress.step < len(STEPS) else f"step {progress.step}: unknown"))


class Mission(Actor):
    """Fetches a trailer by each aisle, and goes home."""

    outputs = (topics.GOAL,)
    _step, _hitched = 0, False

    def on_start(self) -> None:
        """Load the step."""
        self._step = (self.kept(FORMAT) or Progress()).step

    @on(topics.BASE)
    def base(self, message: Base, _header: Header) -> None:
        """Note whether the hitch is closed."""
        self._hitched = message.hitched

    @on(topics.POSE)
    def pose(self, message: Place, header: Header) -> None:
        """Go to the next step if this one is done; publish the goal."""
        x_m, y_m, hitched = STEPS[self._step]
        reached = math.dist((x_m, y_m), (message.x_m, message.y_m)) < 0.25
        if reached and hitched is self._hitched and self._step + 1 < len(STEPS):
            self._step += 1
            self.keep(FORMAT, Progress(self._step))
        self.publish(topics.GOAL, Goal(self._step, *STEPS[self._step]), stamp=header.stamp)


class Controller(Actor):
    """Turns to the goal, and drives there."""

    outputs = (topics.MOTION,)
    _goal = Goal(0, *DOCK, False)
    _goal_s = 0.0

    @on(topics.GOAL)
    def goal(self, message: Goal, header: Header) -> None:
        """Note the goal."""
        self._goal, self._goal_s = message, header.stamp

    @on(topics.POSE)
    def pose(self, message: Place, header: Header) -> None:
        """Publish the motion, with the time stamp of its inputs."""
        dx, dy = self._goal.x_m - message.x_m, self._goal.y_m - message.y_m
        away_m = math.hypot(dx, dy)
        turn = math.remainder(math.atan2(dy, dx) - message.heading_rad, math.tau)
        speed_mps = min(0.8, 0.8 * away_m) if abs(turn) < 0.3 else 0.0
        turn_radps = min(1.0, 4.0 * away_m) * min(max(2.0 * turn, -1.0), 1.0)
        self.publish(topics.MOTION, Motion(speed_mps, turn_radps),
                     stamp=min(header.stamp, self._goal_s + 0.2))


class Pilot(Actor):
    """Limits the motion: never too fast for the free way, and never by stale inputs."""

    outputs = (topics.DRIVE, topics.STATUS)
    _motion, _motion_s = Motion(0.0, 0.0), 0.0
    _free_m, _free_s = 0.0, 0.0
    _ordered, _why = False, ""

    @on(topics.MOTION)
    def motion(self, message: Motion, header: Header) -> None:
        """Note the controller's motion."""
        self._motion, self._motion_s = message, header.stamp

    @on(topics.FREE)
    def free(self, message: Free, header: Header) -> None:
        """Note the free way."""
        self._free_m, self._free_s = message.free_m, header.stamp

    @on(topics.ORDER)
    def order(self, message: Order, _header: Header) -> None:
        """Stop, or drive on."""
        self._ordered = message.stop

    @every(0.05)
    def drive(self) -> None:
        """Command the wheels, so that half of their braking power suffices to stop."""
        self._why = self._why_not()
        most_mps = math.sqrt(max(0.0, self._free_m))
        self.publish(topics.DRIVE, Motion(0.0, 0.0) if self._why else Motion(
            min(self._motion.speed_mps, most_mps), self._motion.turn_radps))

    @every(0.1)
    def publish_status(self) -> None:
        """Publish whether it stops the tug, and why."""
        self.publish(topics.STATUS, Status(bool(self._why), self._why))

    def _why_not(self) -> str:
        now_s, system = self.clock.now(), self.context.run.system
        checks = {
            "the motion is stale": now_s - self._motion_s < system.timing.command_timeout_s,
            "the laser is stale": now_s - self._free_s < system.timing.scan_timeout_s,
            "a stamp is ahead": max(self._motion_s, self._free_s) < now_s + 0.1,
            "it is too fast": 0.0 <= self._motion.speed_mps <= 0.9}
        wrong = next((why for why, well in checks.items() if not well), "")
        return "ordered" if self._ordered else wrong * system.layers.safety_pilot_checks
