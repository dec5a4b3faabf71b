"""A pilot: keeps the attitude, and chooses the input to fly by.

A vehicle in the air cannot stop: without thrust it falls. So the pilot always flies, by the first
of these that it can:

1. in mode NORMAL by the setpoint, if that is fresh and sound;
2. by the estimate, if that is fresh and sound: it hovers in NORMAL and HOVER, flies home and lands
   in RETURN, and lands in LAND;
3. otherwise, and in mode LEVEL, by its sensors: level, for two seconds at its height, then down
   gently. Wind carries it along.

The attitude loop runs here, so that the death of the flight controller costs nothing. Two pilots
fly all the time, and the rotors' speed controllers choose one (`rotors.py`). The other pilot
integrates nothing, follows the trim of the first, and does not publish `pilot/status`. A restarted
pilot begins with the estimator's attitude.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from quadrotor import topics as t
from quadrotor.attitude import VerticalFilter
from quadrotor.control import STEP_S, AttitudeControl, PositionControl, bounded
from quadrotor.rotation import tilt, yaw
from quadrotor.sensing import Sensing
from quadrotor.vehicle import G_MPS2, HOME, MASS_KG, Thrusts, Vector
from rampart import Context, Header, Positive, StateFormat, every, on

MODES = ("NORMAL", "HOVER", "RETURN", "LAND", "LEVEL")
"""In order of strictness: each trusts fewer inputs than the one before."""

FRESH_S = 0.15
"""Older setpoints and estimates are ignored."""

_BLIND_S = 5.0
"""Without a fix for longer, the estimate's horizontal velocity is ignored."""

_HOLD_S = 2.0
_MOST_ACCEL_MPS2, _MOST_SPEED_MPS, _MOST_PLACE_M, _JUMP_M, _JUMP_S = 5.0, 12.0, 1000.0, 1.0, 1.0
_STANDS_S, _STANDS_SHARE = 0.3, 0.75
_NEAR_HOME_M = 1.0
_IDLE: Thrusts = (0.0, 0.0, 0.0, 0.0)


class Memory(msgspec.Struct, frozen=True):
    """State that survives the process.

    Attributes:
        landed: whether the vehicle stands on the ground.
        stays: whether it must stay there, since it landed in another mode than NORMAL.
    """

    landed: bool
    stays: bool


MEMORY = StateFormat(Memory)


class Believed:
    """Passes the estimates that are fresh, finite and without jumps.

    After a jump it refuses estimates for one second.
    """

    def __init__(self) -> None:
        self._last: t.Estimate | None = None
        self._stamp_s = self._refused_s = -math.inf

    def take(self, at: t.Estimate, stamp_s: float) -> None:
        """Take an estimate, or refuse it."""
        place = at.x_m, at.y_m, at.z_m
        speed = at.velocity_x_mps, at.velocity_y_mps, at.velocity_z_mps
        if stamp_s <= self._stamp_s or at == self._last or not (
                all(abs(p) < _MOST_PLACE_M for p in place)
                and all(abs(v) < _MOST_SPEED_MPS for v in speed)
                and all(map(math.isfinite, at.attitude))):
            return
        last, step_s = self._last, stamp_s - self._stamp_s
        if last is not None and step_s < 1.0:
            there = (last.x_m + last.velocity_x_mps * step_s,
                     last.y_m + last.velocity_y_mps * step_s,
                     last.z_m + last.velocity_z_mps * step_s)
            then = last.velocity_x_mps, last.velocity_y_mps, last.velocity_z_mps
            if math.dist(place, there) > _JUMP_M or math.dist(speed, then) > _JUMP_M + 5 * step_s:
                if self._refused_s == -math.inf:
                    self._refused_s = stamp_s
                if stamp_s - self._refused_s < _JUMP_S:
                    return
        self._last, self._stamp_s, self._refused_s = at, stamp_s, -math.inf

    def at(self, now_s: float) -> t.Estimate | None:
        """Return the last sound estimate, None if it is too old."""
        return self._last if now_s - self._stamp_s <= FRESH_S else None


class Pilot(Sensing):
    """Converts setpoints to thrusts of the rotors, and flies without setpoints if need be."""

    class Parameters(Sensing.Parameters, frozen=True):
        """Speeds and limits of flights without setpoints.

        Attributes:
            descent_mps: speed of descent in LAND, and in RETURN above home.
            level_descent_mps: speed of descent without an estimate.
            return_mps: speed of the flight home.
            most_tilt_rad: largest tilt demanded of the attitude loop.
            first: whether it assumes to fly while the speed controllers are silent.
        """

        descent_mps: Annotated[float, msgspec.Meta(gt=0, le=1.2)] = 0.9
        level_descent_mps: Annotated[float, msgspec.Meta(gt=0, le=1.2)] = 0.8
        return_mps: Positive = 2.5
        most_tilt_rad: Annotated[float, msgspec.Meta(gt=0, lt=0.8)] = 0.4
        first: bool = True

    parameters: Parameters
    outputs = (t.ROTORS, t.PILOT)
    wait_s = 0.08

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._vertical = VerticalFilter()
        self._attitude, self._position = AttitudeControl(), PositionControl()
        self._believed = Believed()
        self._setpoint: t.Setpoint | None = None
        self._setpoint_s = -math.inf
        self._refused = 0.0
        self._orders: dict[str, str] = {}
        self._held_yaw_rad = 0.0
        self._rest_mps2 = 0.0
        self._held: tuple[str, Vector] | None = None
        self._source, self._source_s = "", self.clock.now()
        self._last_n = _IDLE
        self._esc: t.EscStatus | None = None
        self._esc_s = -math.inf
        self._light_s = 0.0
        self._landed = context.incarnation == 1
        self._stays = False

    def on_start(self) -> None:
        """Load whether the vehicle stands on the ground."""
        kept = self.kept(MEMORY)
        if kept is not None:
            self._landed, self._stays = kept.landed, kept.stays

    # -- inputs -----------------------------------------------------------------------------------

    @on(t.BAROMETER)
    def barometer(self, message: t.Barometer, _header: Header) -> None:
        """Take a height."""
        self._vertical.measured(message.altitude_m, 1 / t.BAROMETER.rate_hz)

    @on(t.ESC)
    def esc(self, message: t.EscStatus, header: Header) -> None:
        """Note which pilot the rotors obey; if it is the other one, follow its trim."""
        self._esc, self._esc_s = message, header.stamp
        if not self._flies():
            self._attitude.follow(message.thrust_n)

    def _flies(self) -> bool:
        """Whether the rotors obey this pilot, as far as it knows."""
        if self._esc is None or self.clock.now() - self._esc_s > FRESH_S:
            return self.parameters.first
        return self._esc.obeys == self.name

    @on(t.ESTIMATE)
    def estimate(self, message: t.Estimate, header: Header) -> None:
        """Take an estimate; after a restart begin with its attitude."""
        self._believed.take(message, header.stamp)
        if not self._filter.known and all(map(math.isfinite, message.attitude)):
            self._filter.begin(message.attitude)
            self._vertical.speed_mps = bounded(message.velocity_z_mps, 3.0)

    @on(t.SETPOINT)
    def setpoint(self, message: t.Setpoint, header: Header) -> None:
        """Take a setpoint, or refuse it."""
        asked = message.accel_x_mps2, message.accel_y_mps2, message.accel_z_mps2
        sound = all(abs(a) <= _MOST_ACCEL_MPS2 for a in asked) and math.isfinite(message.yaw_rad)
        self._refused = 0.0 if sound else 1.0
        if sound:
            self._setpoint, self._setpoint_s = message, header.stamp

    @on(t.PILOT_ORDER)
    def order(self, message: t.PilotOrder, header: Header) -> None:
        """Enter a mode for the sender, or with NORMAL leave it. The strictest mode holds."""
        if message.mode not in MODES:
            self.report_diagnostic("order", f"unknown mode {message.mode!r}", header.source)
        elif message.mode == MODES[0]:
            self._orders.pop(header.source, None)
        elif header.source in self._orders or len(self._orders) < 16:
            self._orders[header.source] = message.mode

    @property
    def mode(self) -> str:
        """The strictest mode that is ordered."""
        return max(self._orders.values(), key=MODES.index, default=MODES[0])

    # -- flying -----------------------------------------------------------------------------------

    @every(STEP_S)
    def step(self) -> None:
        """Run the loops once."""
        sensed = self._sense()
        if sensed is None:
            return  # the speed controllers hold the last command for a while
        rate, force = sensed
        self._vertical.step(self._filter.upward(force), STEP_S)
        asked, yaw_rad = self._asked(self.clock.now())
        self._see_ground(asked[2], force[2])
        if self._landed:
            self._attitude.reset()
            self._last_n = _IDLE
        else:
            self._last_n = self._attitude.step(
                asked, yaw_rad, self._filter.q, rate, flies=self._flies())
        self.publish(t.ROTORS, t.RotorCommand(self._last_n))

    def _asked(self, now_s: float) -> tuple[Vector, float]:
        """Return the acceleration in `map`, m/s², and the yaw, rad, to fly with."""
        mode, at, setpoint = self.mode, self._believed.at(now_s), self._setpoint
        if mode == MODES[0] and setpoint is not None and now_s - self._setpoint_s <= FRESH_S:
            self._follows("setpoint", now_s)
            self._held_yaw_rad = setpoint.yaw_rad
            wanted = setpoint.accel_x_mps2, setpoint.accel_y_mps2, setpoint.accel_z_mps2
            if self._landed and not setpoint.fly:
                wanted = 0.0, 0.0, -G_MPS2
        elif at is not None and mode != MODES[-1]:
            self._follows("estimate", now_s)
            wanted = self._by_estimate(mode, at)
        else:
            self._follows("own sensors", now_s)
            wanted = self._by_own_sensors(now_s, hold=mode != MODES[-1])
        east, north, upward = wanted
        most = math.tan(self.parameters.most_tilt_rad) * max(upward + G_MPS2, 2.0)
        shorter = min(1.0, most / max(math.hypot(east, north), 1e-6))
        return (east * shorter, north * shorter, upward), self._held_yaw_rad

    def _follows(self, source: str, now_s: float) -> None:
        if source != self._source:
            self._source, self._source_s = source, now_s
            self._held_yaw_rad = yaw(self._filter.q)
            self._position.reset()
            self._rest_mps2 = 0.0
            self._held = None

    def _by_estimate(self, mode: str, at: t.Estimate) -> Vector:
        limits = self.parameters
        # Half of the vertical speed is its own, so that a wrong estimate does half the harm.
        at = msgspec.structs.replace(
            at, velocity_z_mps=(at.velocity_z_mps + self._vertical.speed_mps) / 2)
        if self._held is None or self._held[0] != mode:
            self._held = mode, (at.x_m, at.y_m, at.z_m)
        x_m, y_m, z_m = self._held[1]
        if mode == "LAND":
            velocity = 0.0, 0.0, -limits.descent_mps
            if at.gps_age_s < _BLIND_S:
                return self._position.towards(velocity, at, STEP_S)
            return 0.0, 0.0, self._position.towards(velocity, at, STEP_S)[2]
        if mode == "RETURN":
            (x_m, y_m), z_m = HOME, max(z_m, 3.0)
            if math.hypot(at.x_m - x_m, at.y_m - y_m) < _NEAR_HOME_M:
                z_m = -20.0
        goal = t.Goal(True, x_m, y_m, z_m, self._held_yaw_rad, limits.return_mps,
                      limits.descent_mps)
        return self._position.step(goal, at, STEP_S)

    def _by_own_sensors(self, now_s: float, *, hold: bool) -> Vector:
        """Return a level acceleration: hold the height for a while, then descend gently."""
        waits = hold and now_s - self._source_s < _HOLD_S
        wanted_mps = 0.0 if waits else -self.parameters.level_descent_mps
        wrong_mps = wanted_mps - self._vertical.speed_mps
        self._rest_mps2 = bounded(self._rest_mps2 + 1.0 * bounded(wrong_mps, 1.0) * STEP_S, 2.5)
        return 0.0, 0.0, bounded(2.0 * wrong_mps + self._rest_mps2, 3.0)

    def _see_ground(self, upward_mps2: float, force_mps2: float) -> None:
        """Detect takeoff and landing: little thrust at full weight means standing on the ground.

        If the rotors obey the other pilot, its thrust must be little too.
        """
        before = self._landed
        flown_n = self._last_n if self._flies() or self._esc is None else self._esc.thrust_n
        thrust_mps2 = max(sum(self._last_n), sum(flown_n)) / MASS_KG
        if self._landed:
            follows = self._source == "setpoint" and not self._stays
            self._landed = not (follows and self._setpoint is not None and self._setpoint.fly
                                and upward_mps2 > 0.5)
        elif thrust_mps2 < _STANDS_SHARE * G_MPS2 and force_mps2 > 0.85 * G_MPS2:
            self._light_s += STEP_S
            self._landed = self._light_s > _STANDS_S
        else:
            self._light_s = 0.0
        if before is not self._landed:
            self._light_s = 0.0
            self._stays = self._landed and self.mode != MODES[0]
            self.keep(MEMORY, Memory(self._landed, self._stays))

    @every(0.05)
    def say(self) -> None:
        """Publish its status, if the rotors obey it."""
        if self._filter.known and self._flies():
            self.publish(t.PILOT, t.PilotStatus(
                self.mode, self._source, self._landed, tilt(self._filter.q), self._filter.q,
                self._imus.sound, self._attitude.trim, self._refused))
