"""The mission: takeoff, one leg to each waypoint, landing at home.

Its checkpoint contains the step, so a restarted process continues with the same leg.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from quadrotor import topics as t
from quadrotor.vehicle import HOME
from rampart import Actor, Context, Header, Positive, StateFormat, every, on

_BEGIN_S = 2.0
_DOWN_M = -20.0
"""Height of the landing's goal, safely below the ground."""

Coordinate = Annotated[float, msgspec.Meta(ge=-1000, le=1000)]
Waypoint = tuple[Coordinate, Coordinate, Annotated[float, msgspec.Meta(gt=0, le=120)]]


class Memory(msgspec.Struct, frozen=True):
    """State that survives the process: the number of steps that are done."""

    step: Annotated[int, msgspec.Meta(ge=0, le=1000)]


MEMORY = StateFormat(Memory)


class Mission(Actor):
    """Publishes goal and step: waiting, takeoff, leg 1 …, land, done."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """The flight.

        Attributes:
            waypoints: x, y, z in `map`, m.
            takeoff_m: height of the takeoff.
            speed_mps: speed on the legs.
            descent_mps: speed of the landing.
            reach_m: largest distance at which a waypoint counts as reached.
        """

        waypoints: Annotated[tuple[Waypoint, ...], msgspec.Meta(min_length=1, max_length=100)]
        takeoff_m: Positive = 5.0
        speed_mps: Annotated[float, msgspec.Meta(gt=0, le=5)] = 3.0
        descent_mps: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.6
        reach_m: Positive = 0.7

    parameters: Parameters
    outputs = (t.GOAL, t.MISSION)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        legs = self.parameters.waypoints
        self._steps = ("waiting", "takeoff", *(f"leg {i + 1}" for i in range(len(legs))), "land",
                       "done")
        self._step = 0
        self._pilot: t.PilotStatus | None = None

    def on_start(self) -> None:
        """Load the step."""
        kept = self.kept(MEMORY)
        if kept is not None:
            self._step = min(kept.step, len(self._steps) - 1)

    @on(t.PILOT)
    def pilot(self, message: t.PilotStatus, _header: Header) -> None:
        """Note whether the pilot follows the setpoint, and whether it has landed."""
        self._pilot = message

    @on(t.ESTIMATE)
    def estimate(self, at: t.Estimate, _header: Header) -> None:
        """Go to the next step if this one is done."""
        pilot = self._pilot
        if pilot is None or pilot.mode != "NORMAL":
            return
        step, now_s = self._steps[self._step], self.clock.now()
        if step == "waiting":
            done = now_s > _BEGIN_S and at.gps_age_s < 0.5
        elif step == "land":
            done = pilot.landed
        elif step == "done":
            done = False
        else:
            x_m, y_m, z_m = self._place()
            done = math.dist((x_m, y_m, z_m), (at.x_m, at.y_m, at.z_m)) < self.parameters.reach_m
        if done:
            self._step += 1
            self.keep(MEMORY, Memory(self._step))
            self.publish_step()
            self.publish_goal()

    def _place(self) -> tuple[float, float, float]:
        flight, number = self.parameters, self._step
        if number <= 1:
            return *HOME, flight.takeoff_m
        if number < 2 + len(flight.waypoints):
            return flight.waypoints[number - 2]
        return *HOME, _DOWN_M

    @every(0.1)
    def publish_goal(self) -> None:
        """Publish where to fly."""
        flight, step = self.parameters, self._steps[self._step]
        x_m, y_m, z_m = self._place()
        descent_mps = flight.descent_mps if step == "land" else 1.0
        self.publish(t.GOAL, t.Goal(
            step not in ("waiting", "done"), x_m, y_m, z_m, 0.0, flight.speed_mps, descent_mps))

    @every(0.2)
    def publish_step(self) -> None:
        """Publish the step, and that it cannot advance while the pilot does not follow."""
        now_s = self.clock.now()
        follows = self._pilot is not None and self._pilot.mode == "NORMAL"
        self.publish(t.MISSION, t.MissionState(
            self._steps[self._step], 0.0 if follows else now_s + 10.0))
