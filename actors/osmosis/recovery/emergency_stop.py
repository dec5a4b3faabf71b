"""RM1: emergency stop, at low level (paper, table II)."""

from __future__ import annotations

from typing import Any

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
    WayOutAnswer,
    WayOutRequest,
)
from rampart.actors.osmosis.recovery.way_out import PERIOD_S, TAKE_S, TOP_SPEED_MPS, Look, WayOut
from rampart.actors.recovery.holding import HeldRecovery
from rampart.actors.runtime.actor import Context, Header, on

_LOOKED_AT = (topics.POSE, topics.GPS, topics.TELEOP_COMMAND, topics.PILOT_STATUS)
"""Inputs of a way out, which are heard from the first one on."""

_LOOK_S = 0.5
"""How long the readings of the first way out may take to come."""

_TOO_NEAR_M = 0.1
"""DM1 takes the robot for safe again at this distance beyond the least one."""

_MARGIN_M = 0.15
"""Beyond that, for the error of a position."""

_FAREWELLS = 5

_FOUND_ENGAGED = "the brake was found engaged"
_PATIENCE_S = 0.5
"""How long a respawned module waits to see the brake before it says that it is idle."""


class EmergencyStop(HeldRecovery):
    """Engages the brake of the Summit XL layer, past the Safety Pilot and all control nodes.

    The brake itself remembers. When this module and the manager die in the same moment, the
    brake is all that knows of the emergency stop; so a respawned module looks at it before it
    says anything, and if it is engaged, counts as activated. The manager then adopts it.

    An operator may ask for a way out (`way_out`). Meanwhile this module orders the Safety Pilot to
    obey the stick alone, and lets go of the brake. It counts as activated all the time. Before that
    order ends the brake is engaged again; if this module dies, the order becomes one to stop.
    """

    outputs = (*HeldRecovery.outputs, topics.BRAKE, topics.PILOT_ORDER, topics.WAY_OUT_ANSWER)
    optional_inputs = (*_LOOKED_AT, topics.WAY_OUT)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._looking = context.incarnation > 1
        self._look = Look()
        self._hears_all = False
        self._request: WayOutRequest | None = None
        self._answer: WayOutAnswer | None = None
        self._out: WayOut | None = None
        self._manager = 0
        self._pilot = 0
        # An earlier life may have died with an order to the Safety Pilot in force.
        self._stops_pilot = context.incarnation > 1
        self._farewells = 0

    def listens(self, topic: Topic[Any]) -> bool:
        """Leave out what only a way out needs."""
        return topic not in _LOOKED_AT

    def on_start(self) -> None:
        """Say at once that it is there, unless it has to look at the brake first."""
        super().on_start()
        if self._looking:
            self.call_later(_PATIENCE_S, self._stop_looking)

    def _stop_looking(self) -> None:
        if self._looking:
            self._looking = False
            self._tell_change()

    def give(self, in_force: bool, why: str) -> None:
        """Engage the brake, or let go of it."""
        driven = self._out is not None and self._out.open
        self.publish(topics.BRAKE, BrakeCommand(in_force and not driven, why))

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Engage the brake."""
        self._looking = False
        super().act(command, renewed=renewed)

    @on(topics.BASE_STATUS)
    def base_status(self, message: BaseStatus, header: Header) -> None:
        """See whether the brake is engaged."""
        if self._looking:
            self._looking = False
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
        """Obey the manager; another one knows nothing of a way out."""
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
        """End what a predecessor may have ordered; the brake that it left makes one activated."""
        self._let_pilot_go()

    def repeat(self) -> None:
        """Repeat the order; and to the Safety Pilot the end of its own."""
        super().repeat()
        if self._farewells:
            self._farewells -= 1
            self.publish(topics.PILOT_ORDER, PilotOrder(False, PilotMode.STOP, ""))
        elif self._stops_pilot and self.activated and self._out is None:
            self.publish(topics.PILOT_ORDER, PilotOrder(True, PilotMode.STOP, "the way out ended"))

    # -- the way out ----------------------------------------------------------------------------

    @on(topics.WAY_OUT)
    def way_out(self, message: WayOutRequest, _header: Header) -> None:
        """Look whether the robot may be driven out of a prohibited area."""
        if self._request is not None and message.order == self._request.order:
            if self._answer is not None:
                self.publish(topics.WAY_OUT_ANSWER, self._answer)
            return
        if self._out is not None or (self._request is not None and self._answer is None):
            self.publish(topics.WAY_OUT_ANSWER, WayOutAnswer(
                message.order, False, "another way out is under way"))
            return
        self._request, self._answer = message, None
        if not self._hears_all:
            self._hears_all = True
            self.hear_after_all(topics.POSE, self.pose)
            self.hear_after_all(topics.GPS, self.gps)
            self.hear_after_all(topics.TELEOP_COMMAND, self.stick)
            self.hear_after_all(topics.PILOT_STATUS, self.pilot)
        self.call_later(_LOOK_S, self._grant)

    def _grant(self) -> None:
        known = self.context.run.application
        if not isinstance(known, Osmosis):
            self._tell_operator(granted=False, why="no airport is known")
            return
        robot, now_s = self.context.run.system.robot, self.clock.now()
        too_near_m = half_diagonal_m(robot) + robot.gps_accuracy_m + _TOO_NEAR_M
        out = WayOut(known.airport.prohibited_distance_m, too_near_m, too_near_m + _MARGIN_M, now_s)
        held = self.phase is RecoveryPhase.DEGRADED
        refusal = out.refusal(self._look, now_s) if held else "the emergency stop is not in force"
        self._tell_operator(granted=not refusal,
                            why=refusal or f"take the stick within {TAKE_S:g} s")
        if not refusal:
            self._out = out
            self._stops_pilot, self._farewells = True, 0
            self._follow()

    def _follow(self) -> None:
        """Renew the order to the Safety Pilot, or end the way out."""
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
        self._tell_operator(granted=False, why=why, is_out=out.is_out)

    def _let_pilot_go(self) -> None:
        """End the order to the Safety Pilot."""
        if self._stops_pilot:
            self._stops_pilot, self._farewells = False, _FAREWELLS
            self.publish(topics.PILOT_ORDER, PilotOrder(False, PilotMode.STOP, ""))

    def _tell_operator(self, *, granted: bool, why: str, is_out: bool = False) -> None:
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
        """See where the robot is and where it looks."""
        self._look.pose = (message.x_m, message.y_m, message.yaw_rad)
        self._look.pose_s = min(header.stamp, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: GpsFix, header: Header) -> None:
        """See where the robot is, independently."""
        self._look.fix = (message.x_m, message.y_m)
        self._look.fix_s = min(header.stamp, self.clock.now())

    @on(topics.TELEOP_COMMAND)
    def stick(self, message: StickTwist, header: Header) -> None:
        """See that the operator has taken the stick since, and holds it."""
        if self._out is not None and message.held_since_s > self._out.began_s:
            self._look.stick_s = min(header.stamp, self.clock.now())

    @on(topics.PILOT_STATUS)
    def pilot(self, message: PilotStatus, header: Header) -> None:
        """See that the Safety Pilot obeys, and is the same all the while."""
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
        if not self._looking:
            super()._tell()
