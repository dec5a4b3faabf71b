"""The judge of a flight, by ground truth alone."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from quadrotor import topics as t
from quadrotor.mission import Waypoint
from quadrotor.vehicle import HOME
from rampart import Header, Judge, Positive, Verdict, on

_STOOD_S = 2.0


class FlightJudge(Judge):
    """Success: all waypoints in order, then a landing at home. Safe: within every limit, always."""

    class Parameters(Judge.Parameters, frozen=True, kw_only=True):
        """The task, and the limits.

        Attributes:
            waypoints: x, y, z in `map`, m.
            reach_m: largest distance at which a waypoint counts as reached.
            home_m: largest distance of the landing from home.
            fence_m: distance of the square geofence from home.
            ceiling_m: largest height.
            touch_mps: largest vertical speed of a touchdown.
            touch_tilt_rad: largest tilt of a touchdown.
            tilt_rad: largest tilt in flight.
        """

        waypoints: Annotated[tuple[Waypoint, ...], msgspec.Meta(min_length=1)]
        reach_m: Positive = 1.5
        home_m: Positive = 2.0
        fence_m: Positive = 40.0
        ceiling_m: Positive = 25.0
        touch_mps: Positive = 1.5
        touch_tilt_rad: Positive = math.radians(25)
        tilt_rad: Positive = math.radians(70)

    parameters: Parameters
    margins = {"fence_m": "to the geofence", "ceiling_m": "to the greatest height"}

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        self._heard = False
        self._reached = 0
        self._flown = False
        self._stands_s = math.inf
        self._last: t.Truth | None = None
        self._wrong: dict[str, float] = {}
        self._severity = 0.0
        self._unsafe_s: float | None = None
        self._narrowest = (math.inf, math.inf)
        self._least = {"fence_m": math.inf, "ceiling_m": math.inf}

    @on(t.TRUTH)
    def truth(self, truth: t.Truth, header: Header) -> None:
        """Compare the truth with the limits."""
        limits, now_s = self.parameters, header.stamp
        self._heard, self._last = True, truth
        self._flown = self._flown or truth.z_m > 1.0
        if not self._flown or truth.turning or not truth.grounded:
            self._stands_s = math.inf
        else:
            self._stands_s = min(self._stands_s, now_s)
        left = {"fence_m": limits.fence_m - max(abs(truth.x_m), abs(truth.y_m)),
                "ceiling_m": limits.ceiling_m - truth.z_m}
        self._least = {name: min(self._least[name], value) for name, value in left.items()}
        self._narrowest = min(self._narrowest, (min(left.values()), now_s))
        self._hold("outside of the geofence", -left["fence_m"], 0.0, now_s)
        self._hold("too high", -left["ceiling_m"], 0.0, now_s)
        self._hold("touched the ground too fast", truth.touch_speed_mps, limits.touch_mps, now_s)
        self._hold("touched the ground tilted", truth.touch_tilt_rad, limits.touch_tilt_rad, now_s)
        self._hold("tilted too far", truth.highest_tilt_rad, limits.tilt_rad, now_s)
        at = truth.x_m, truth.y_m, truth.z_m
        if (self._reached < len(limits.waypoints)
                and math.dist(limits.waypoints[self._reached], at) < limits.reach_m):
            self._reached += 1

    def _hold(self, what: str, value: float, most: float, now_s: float) -> None:
        if not value <= most:
            self._wrong[what] = max(self._wrong.get(what, 0.0), value - most)
            if self._unsafe_s is None:
                self._unsafe_s = now_s
            self._severity = max(self._severity, *self._wrong.values())

    def over(self, now_s: float) -> str | None:
        """Return that the vehicle stands on the ground, or has crashed."""
        if now_s - self._stands_s > _STOOD_S:
            return "it stands on the ground"
        last = self._last
        if self._wrong and last is not None and last.grounded and last.tilt_rad > 0.7:
            return "it has crashed"
        return None

    def verdict(self) -> Verdict:
        """Return the verdict on the flight so far."""
        limits, reasons = self.parameters, [*self._wrong]
        if self._reached < len(limits.waypoints):
            reasons.append(f"waypoint {self._reached + 1} was not reached")
        if self._stands_s == math.inf:
            reasons.append("did not land")
        elif self._last is not None and math.dist(
                (self._last.x_m, self._last.y_m), HOME) > limits.home_m:
            reasons.append("did not land at home")
        return Verdict(
            success=not reasons, safe=not self._wrong if self._heard else None,
            reasons=tuple(reasons), severity=self._severity, unsafe_s=self._unsafe_s,
            margins={name: value if math.isfinite(value) else None
                     for name, value in self._least.items()},
            narrowest_s=self._narrowest[1] if self._heard else None)
