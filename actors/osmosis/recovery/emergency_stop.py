"""RM1: emergency stop by the low-level brake (paper, table II)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.detection.area.prohibited_area import half_diagonal_m
from rampart.actors.osmosis.messages import (
    BaseStatus,
    BrakeCommand,
    GpsFix,
    PilotMode,
    PilotOrder,
    PilotStatus,
    Pose,
    StickTwist,
    Way,
    WayOutAnswer,
    WayOutRequest,
)
from rampart.actors.recovery.holding import HeldRecovery
from rampart.actors.runtime.actor import Context, Header, on

PERIOD_S = 0.1
"""Period of the decision."""

FRESH_S = 0.3
"""Greatest age of pose, fix and joystick."""

PILOT_S = 0.6
"""Greatest age of the Safety Pilot's status: three of its periods."""

TAKE_S = 10.0
"""Time in which the operator has to press the dead man."""

TOP_SPEED_MPS = 0.2
STANDING_RADPS = 0.1
"""Largest wheel speed at a standstill."""

APART_M = 0.5
"""Greatest distance of pose and GPS."""

DEEPER_M = 0.15
"""Increase of depth by GPS that ends the way out."""

_STEP_M = 0.25
_STEEP = 0.3
"""Least metres towards the edge per metre driven."""


class Look(msgspec.Struct):
    """Newest readings with their stamps; simulated seconds, metres and radians in `map`."""

    pose: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    pose_s: float = -math.inf
    fix: tuple[float, float] = (math.nan, math.nan)
    fix_s: float = -math.inf
    stick_s: float = -math.inf
    pilot_s: float = -math.inf
    wheels_radps: float = math.inf
    wheels_s: float = -math.inf


class WayOut:
    """The way out of a prohibited area during an emergency stop: one permission, until its end.

    A robot inside a prohibited area, or too near to one, keeps DM1 active and RM1 latched, so it
    could not be driven out. On request of an operator RM1 releases the brake while the dead man is
    held once: slowly, and only in directions that lead out. RM1 determines the direction from the
    pose, ten times a second, and the Safety Pilot enforces it. An independent check of GPS ends the
    way out if the robot gets deeper. Any missing input ends it too; then the brake is engaged
    again.

    Args:
        distance_m: signed distance from a point in `map` to the area; negative inside.
        too_near_m: distance of the robot's centre up to which it cannot be released.
        far_m: distance at which it can be released, with a margin.
        now_s: now.

    Attributes:
        began_s: time of the permission.
        way: allowed directions.
        is_out: whether the robot is far enough from the area.
        open: whether the Safety Pilot obeys, so that the brake may be released.
    """

    def __init__(self, distance_m: Callable[[float, float], float], too_near_m: float,
                 far_m: float, now_s: float) -> None:
        self._distance_m = distance_m
        self._too_near_m, self._far_m = too_near_m, far_m
        self.began_s = now_s
        self._held = False
        self._farthest_m = -math.inf
        self.way = Way.NEITHER
        self.is_out = False
        self.open = False

    def refusal(self, look: Look, now_s: float) -> str:
        """Return why a way out is refused, or ""."""
        unknown = self._unknown(look, now_s)
        if unknown:
            return unknown
        if now_s - look.wheels_s > FRESH_S or look.wheels_radps > STANDING_RADPS:
            return "the robot moves"
        self._farthest_m = self._distance_m(*look.fix)
        if self._farthest_m > self._too_near_m:
            return (f"the robot is {self._farthest_m:.2f} m from the prohibited area: "
                    "reset the emergency stop")
        return ""

    def look(self, look: Look, now_s: float) -> str:
        """Determine the allowed directions; return why the way out ends, or ""."""
        self.way = Way.NEITHER
        lost = self._lost(look, now_s) or self._unknown(look, now_s)
        if lost:
            return lost
        distance_m = self._distance_m(*look.fix)
        self.is_out = distance_m >= self._far_m
        if self.is_out:
            return f"the robot is {distance_m:.2f} m from the prohibited area"
        if distance_m < self._farthest_m - DEEPER_M:
            return "the robot got deeper into the prohibited area"
        self._farthest_m = max(self._farthest_m, distance_m)
        self.way = self._outwards(*look.pose)
        return ""

    def _lost(self, look: Look, now_s: float) -> str:
        """Return whether operator or Safety Pilot ended it, or ""."""
        before, self._held = self._held, now_s - look.stick_s <= FRESH_S
        if before and not self._held:
            return "the operator released the dead man"
        if not self._held and now_s - self.began_s > TAKE_S:
            return f"the dead man was not pressed within {TAKE_S:g} s"
        if self.open and now_s - look.pilot_s > PILOT_S:
            return "the safety pilot is silent"
        return ""

    def _unknown(self, look: Look, now_s: float) -> str:
        if not now_s - look.pose_s <= FRESH_S:
            return "the pose is unknown"
        if not now_s - look.fix_s <= FRESH_S:
            return "GPS is silent"
        if not math.dist(look.pose[:2], look.fix) <= APART_M:
            return "pose and GPS differ"
        return ""

    def _outwards(self, x_m: float, y_m: float, yaw_rad: float) -> Way:
        step_x, step_y = _STEP_M * math.cos(yaw_rad), _STEP_M * math.sin(yaw_rad)
        here_m = self._distance_m(x_m, y_m)
        for way, sign in ((Way.FORWARDS, 1), (Way.BACKWARDS, -1)):
            there_m = self._distance_m(x_m + sign * step_x, y_m + sign * step_y)
            if there_m - here_m >= _STEEP * _STEP_M:
                return way
        return Way.NEITHER


_LOOKED_AT = (topics.POSE, topics.GPS, topics.TELEOP_COMMAND, topics.PILOT_STATUS)
"""Inputs of a way out; subscribed at the first request."""

_LOOK_S = 0.5
"""Time until the inputs of the first way out have arrived."""

_TOO_NEAR_M = 0.1
"""Hysteresis of DM1."""

_MARGIN_M = 0.15
"""Additional margin for position errors."""

_FAREWELLS = 5

_FOUND_ENGAGED = "the brake was found engaged"
_PATIENCE_S = 0.5
"""Time that a restarted module waits for the state of the brake before it reports idle."""


class EmergencyStop(HeldRecovery):
    """Engages the brake of the Summit XL layer, past the Safety Pilot and all control nodes.

    If this module and the manager crash at the same time, only the state of the brake shows the
    emergency stop. So a restarted module first reads it, and is activated if the brake is engaged.
    The manager then adopts it.

    An operator may request a way out (`WayOut`). Meanwhile this module orders the Safety Pilot
    into teleoperation and releases the brake; it stays activated. The brake is engaged again before
    that order ends. If this module crashes, the order becomes one to stop.
    """

    outputs = (*HeldRecovery.outputs, topics.BRAKE, topics.PILOT_ORDER, topics.WAY_OUT_ANSWER)
    optional_inputs = (*_LOOKED_AT, topics.WAY_OUT)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._awaits_brake = context.incarnation > 1
        self._look = Look()
        self._subscribed = False
        self._request: WayOutRequest | None = None
        self._answer: WayOutAnswer | None = None
        self._out: WayOut | None = None
        self._manager = 0
        self._pilot = 0
        # The previous incarnation may have left an order to the Safety Pilot engaged.
        self._stops_pilot = context.incarnation > 1
        self._farewells = 0

    def listens(self, topic: Topic[Any]) -> bool:
        """Leave out the inputs of a way out."""
        return topic not in _LOOKED_AT

    def on_start(self) -> None:
        """Report at once, unless it waits for the state of the brake."""
        super().on_start()
        if self._awaits_brake:
            self.call_later(_PATIENCE_S, self._stop_awaiting)

    def _stop_awaiting(self) -> None:
        if self._awaits_brake:
            self._awaits_brake = False
            self._tell_change()

    def give(self, in_force: bool, why: str) -> None:
        """Engage or release the brake."""
        driven = self._out is not None and self._out.open
        self.publish(topics.BRAKE, BrakeCommand(in_force and not driven, why))

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Engage the brake."""
        self._awaits_brake = False
        super().act(command, renewed=renewed)

    @on(topics.BASE_STATUS)
    def base_status(self, message: BaseStatus, header: Header) -> None:
        """Take the state of the brake."""
        if self._awaits_brake:
            self._awaits_brake = False
            if message.brake_engaged:
                self.why = _FOUND_ENGAGED
                self.ordered_s = header.stamp
                self.resume(_FOUND_ENGAGED)
            else:
                self._tell_change()
        self._look.wheels_s = min(header.stamp, self.clock.now())
        self._look.wheels_radps = max(map(abs, message.wheel_speeds_radps))
        if message.brake_engaged and self._stops_pilot and self._out is None:
            self._let_pilot_go()
        self.confirm(
            in_force=message.brake_engaged or self._out is not None, stamp_s=header.stamp,
            reason="brake engaged" if message.brake_engaged else "brake not engaged")

    def command(self, message: RecoveryCommand, header: Header) -> None:
        """Execute a command; a restarted manager ends a way out."""
        before, self._manager = self._manager, header.incarnation
        if before != header.incarnation:
            self._close("the manager was restarted")
        super().command(message, header)

    def let_go(self) -> None:
        """Release the brake, and the Safety Pilot."""
        self._close("the emergency stop is released")
        super().let_go()
        self._let_pilot_go()

    def stay_idle(self) -> None:
        """End the order of a predecessor to the Safety Pilot."""
        self._let_pilot_go()

    def repeat(self) -> None:
        """Repeat the order to the brake, and the end of the order to the Safety Pilot."""
        super().repeat()
        if self._farewells:
            self._farewells -= 1
            self.publish(topics.PILOT_ORDER, PilotOrder(False, PilotMode.STOP, ""))
        elif self._stops_pilot and self.activated and self._out is None:
            self.publish(topics.PILOT_ORDER, PilotOrder(True, PilotMode.STOP, "the way out ended"))

    # -- the way out ----------------------------------------------------------------------------

    @on(topics.WAY_OUT)
    def way_out(self, message: WayOutRequest, _header: Header) -> None:
        """Decide whether the robot may be driven out of a prohibited area."""
        if self._request is not None and message.order == self._request.order:
            if self._answer is not None:
                self.publish(topics.WAY_OUT_ANSWER, self._answer)
            return
        if self._out is not None or (self._request is not None and self._answer is None):
            self.publish(topics.WAY_OUT_ANSWER, WayOutAnswer(
                message.order, False, "another way out is under way"))
            return
        self._request, self._answer = message, None
        if not self._subscribed:
            self._subscribed = True
            self.hear_after_all(topics.POSE, self.pose)
            self.hear_after_all(topics.GPS, self.gps)
            self.hear_after_all(topics.TELEOP_COMMAND, self.stick)
            self.hear_after_all(topics.PILOT_STATUS, self.pilot)
        self.call_later(_LOOK_S, self._grant)

    def _grant(self) -> None:
        known = self.context.run.application
        if not isinstance(known, Osmosis):
            self._answer_operator(granted=False, why="there is no airport")
            return
        robot, now_s = self.context.run.system.robot, self.clock.now()
        too_near_m = half_diagonal_m(robot) + robot.gps_accuracy_m + _TOO_NEAR_M
        out = WayOut(known.airport.prohibited_distance_m, too_near_m, too_near_m + _MARGIN_M, now_s)
        held = self.phase is RecoveryPhase.DEGRADED
        refusal = out.refusal(self._look, now_s) if held else "the emergency stop is not in force"
        self._answer_operator(granted=not refusal,
                              why=refusal or f"press the dead man within {TAKE_S:g} s")
        if not refusal:
            self._out = out
            self._stops_pilot, self._farewells = True, 0
            self._follow()

    def _follow(self) -> None:
        """Renew the order to the Safety Pilot or end the way out."""
        out = self._out
        if out is None:
            return
        if why := out.look(self._look, self.clock.now()):
            self._close(why)
            return
        self.publish(topics.PILOT_ORDER, PilotOrder(
            True, PilotMode.TELEOPERATION, "way out", TOP_SPEED_MPS, out.way))
        self.call_later(PERIOD_S, self._follow)

    def _close(self, why: str) -> None:
        out = self._out
        if out is None:
            return
        self._out = None
        self.give(True, self.why)
        self.publish(topics.PILOT_ORDER, PilotOrder(True, PilotMode.STOP, clip(f"way out: {why}")))
        self._answer_operator(granted=False, why=why, is_out=out.is_out)

    def _let_pilot_go(self) -> None:
        """End the order to the Safety Pilot."""
        if self._stops_pilot:
            self._stops_pilot, self._farewells = False, _FAREWELLS
            self.publish(topics.PILOT_ORDER, PilotOrder(False, PilotMode.STOP, ""))

    def _answer_operator(self, *, granted: bool, why: str, is_out: bool = False) -> None:
        request = self._request
        if request is None:
            return
        began = self._answer is not None
        self._answer = WayOutAnswer(request.order, granted, clip(why), is_out)
        self.publish(topics.WAY_OUT_ANSWER, self._answer)
        what = "granted" if granted else "ended" if began else "refused"
        self.report_diagnostic("way out", clip(
            f"{what}: {why}; asked for by {request.by}: {request.reason}"), request.by)

    @on(topics.POSE)
    def pose(self, message: Pose, header: Header) -> None:
        """Take the pose."""
        self._look.pose = (message.x_m, message.y_m, message.yaw_rad)
        self._look.pose_s = min(header.stamp, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: GpsFix, header: Header) -> None:
        """Take a fix."""
        self._look.fix = (message.x_m, message.y_m)
        self._look.fix_s = min(header.stamp, self.clock.now())

    @on(topics.TELEOP_COMMAND)
    def stick(self, message: StickTwist, header: Header) -> None:
        """Take that the operator holds a stick pressed after the request."""
        if self._out is not None and message.held_since_s > self._out.began_s:
            self._look.stick_s = min(header.stamp, self.clock.now())

    @on(topics.PILOT_STATUS)
    def pilot(self, message: PilotStatus, header: Header) -> None:
        """Check that the Safety Pilot obeys and was not restarted."""
        self._look.pilot_s = min(header.stamp, self.clock.now())
        out, before, self._pilot = self._out, self._pilot, header.incarnation
        if out is None:
            return
        if out.open and before != header.incarnation:
            self._close("the safety pilot was restarted")
        elif not out.open and message.mode is PilotMode.TELEOPERATION \
                and 0.0 < message.top_speed_mps <= TOP_SPEED_MPS:
            out.open = True
            self.give(True, self.why)
        elif out.open and message.mode is not PilotMode.TELEOPERATION:
            self._close(f"the safety pilot is in mode {message.mode}")

    def _tell(self) -> None:
        if not self._awaits_brake:
            super()._tell()
