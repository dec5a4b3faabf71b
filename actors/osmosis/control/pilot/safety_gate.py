"""Core of the Safety Pilot: the gate between all commands and the base. Pure.

Each output depends on the recovery modules' orders, the manager's status, the joystick, the last
valid command and the last scan. Each input has an age, and a stale input stops the robot.

The strictest engaged order applies: stop > teleoperation > auto. A fresh joystick pre-empts auto.

The joystick drives only if the operator pressed its dead man after the last stop: an order to stop,
a brake, the base's dead man, silence of manager or lasers, or the start of this process. If it was
held before, the robot stands until it is released, so that no input from the time of a stop acts
when the stop ends. The message contains the time of the press, so neither a lost message nor a
restarted process counts as a release.

In auto, `command_pair` selects between Osmosis Control and its standby. In the paper's unprotected
baseline (`Checks` all off) three functions remain: the last command is repeated, obstacles stop the
robot, and the joystick pre-empts.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import msgspec

from rampart.actors.bus.envelope import AHEAD_S, Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.ftm.holders import Holders
from rampart.actors.osmosis.control.pilot.command_pair import CommandPair
from rampart.actors.osmosis.control.pilot.swept_path import StoppingRoom, limited
from rampart.actors.osmosis.control.polyline import NO_POINTS, Array
from rampart.actors.osmosis.messages import PilotMode, PilotOrder, StickTwist, Twist, Way
from rampart.manager.arbitration.silence import Silence

STRICTNESS = (PilotMode.AUTO, PilotMode.TELEOPERATION, PilotMode.STOP)
"""Modes from the most permissive to the strictest."""

_STANDING_MPS = 1e-3
"""Rounding of a standstill."""

_SOURCES = 64
"""Number of command sources whose newest sequence number is stored."""

_RENEWED_S = 0.35
"""Age at which an order with a `way` becomes an order to stop."""

_WAY_TURN_RADPS = 0.5
"""Largest turn rate during an order with a `way`."""

HELD_TOO_LONG = "the joystick was held during a stop: release it first"

_SLOWED = 0.999
"""Share of the command below which the reason names the obstacle."""


class Checks(msgspec.Struct, frozen=True):
    """Enabled checks; the system spec's layers set them.

    Args:
        inputs: refuse commands that exceed the limits, are stale or out of sequence, and stop
            without a fresh scan.
        manager: stop while the manager is silent.
    """

    inputs: bool = True
    manager: bool = True


class GateLimits(msgspec.Struct, frozen=True):
    """Bounds and timeouts.

    Args:
        max_linear_mps: largest speed, either direction.
        max_angular_radps: largest turn rate, either direction.
        reverse_mps: largest speed backwards, where there is no laser; for the joystick only.
        command_timeout_s: age of a stale command.
        scan_timeout_s: age of a stale scan.
        joystick_timeout_s: silence after which the joystick counts as released.
        manager_timeout_s: silence of the manager that stops the robot, over all its incarnations;
            see `Silence`.
        settling_s: time after the start in which nothing passes, until each recovery module has
            repeated its order.
        room: distances of the obstacle stop.
    """

    max_linear_mps: float = 1.0
    max_angular_radps: float = 2.0
    reverse_mps: float = 0.25
    command_timeout_s: float = 0.5
    scan_timeout_s: float = 0.5
    joystick_timeout_s: float = 0.3
    manager_timeout_s: float = 0.5
    settling_s: float = 0.45
    room: StoppingRoom = StoppingRoom()


class GateOutput(msgspec.Struct, frozen=True, gc=False):
    """Output to the base. `stopped`: the gate stops the robot, and not the command."""

    linear_mps: float
    angular_radps: float
    mode: PilotMode
    stopped: bool
    reason: str


class _Line(msgspec.Struct):
    """State of a command source: auto, standby or joystick."""

    twist: tuple[float, float] | None = None
    stamp_s: float = -math.inf
    heard_s: float = -math.inf
    newest: dict[str, tuple[int, int]] = msgspec.field(
        default_factory=lambda: Remembered(_SOURCES))
    fault: str = ""


class SafetyGate:
    """Takes the inputs and gives `output(now)`. Times are simulated seconds.

    Args:
        limits: bounds and timeouts.
        checks: enabled checks.
        started_s: now.
        recoveries: modules that may give orders; orders of others apply too and are reported.

    Attributes:
        orders: engaged orders by module.
        refused: number of refused commands.
    """

    def __init__(self, limits: GateLimits, checks: Checks, started_s: float,
                 recoveries: Collection[str] | None = None) -> None:
        self._limits = limits
        self._checks = checks
        self._started_s = started_s
        self.orders: Holders[PilotOrder] = Holders(recoveries, PilotOrder(
            True, PilotMode.STOP, "orders of too many unknown modules"))
        self._ordered_s: dict[str, float] = {}
        self._auto = _Line()
        self._standby = _Line()
        self._pair = CommandPair()
        self._stick = _Line()
        self._stick_since_s = -math.inf
        self._stopped_s = started_s
        self._manager = Silence()
        self._points: Array = NO_POINTS
        self._scan_s = -math.inf
        self._scan_fault = ""
        self.refused = 0

    def order(self, recovery: str, order: PilotOrder, stamp_s: float = math.inf) -> None:
        """Take an order of a recovery module, which applies until the module ends it.

        Args:
            recovery: name of the module.
            order: the order.
            stamp_s: time of the order; an order with a `way` has to be renewed.
        """
        self._ordered_s.pop(recovery, None)
        if order.engaged:
            self.orders.hold(recovery, order)
            if order.way is not Way.ANY and recovery in self.orders:
                self._ordered_s[recovery] = stamp_s
        else:
            self.orders.let_go(recovery)

    def _expire(self, now: float) -> None:
        """Turn orders with a `way` that were not renewed into orders to stop."""
        for recovery, stamp_s in list(self._ordered_s.items()):
            if not now - stamp_s <= _RENEWED_S:
                del self._ordered_s[recovery]
                if recovery in self.orders:
                    self.orders[recovery] = PilotOrder(
                        True, PilotMode.STOP, "the way out is not renewed")

    def manager_alive(self, stamp_s: float, incarnation: int) -> None:
        """Take the time of the manager's status; see `Silence`."""
        self._manager = self._manager.heard(stamp_s, incarnation)

    def braked(self, stamp_s: float) -> None:
        """Take the time at which the base braked, by order or by its dead man."""
        self._stopped_s = max(self._stopped_s, stamp_s)

    def scan(self, points: Array, stamp_s: float, fault: str = "") -> None:
        """Take a scan: echoes in `base_link`, shape (n, 2), and the time of measurement.

        A scan with a `fault` counts as missing.
        """
        self._points, self._scan_s, self._scan_fault = points, stamp_s, fault

    def command(self, command: Twist, header: Header, now: float) -> str:
        """Take Osmosis Control's command; return why it was refused, or ""."""
        refused = self._take(self._auto, command, header, now)
        if self._standby.twist is not None:
            self._pair.active(*self._offer(self._auto, now), header.incarnation, now)
        return refused

    def standby(self, command: Twist, header: Header, now: float) -> str:
        """Take the standby's command; return why it was refused, or ""."""
        refused = self._take(self._standby, command, header, now)
        self._pair.standby(*self._offer(self._standby, now), header.incarnation, now)
        return refused

    def standby_drives(self, now: float) -> bool:
        """Whether the standby's command affects the output now."""
        stick = now - self._stick.heard_s <= self._limits.joystick_timeout_s
        return not stick and bool(self._wanted(stick, now)[1])

    def _held_too_long(self, now: float) -> bool:
        """Whether the joystick is held since before the end of the last stop."""
        heard = now - self._stick.heard_s <= self._limits.joystick_timeout_s
        return heard and not self._stopped_s < self._stick_since_s <= now + AHEAD_S

    def _offer(self, line: _Line, now: float) -> tuple[tuple[float, float] | None, float]:
        """Return the usable command of a source and its time."""
        return self._usable(line, now)[0], line.stamp_s

    def joystick(self, command: StickTwist, header: Header, now: float) -> str:
        """Take Teleoperation's command; return why it was refused, or ""."""
        refused = self._take(self._stick, command, header, now)
        if not refused:
            self._stick_since_s = command.held_since_s
        return refused

    def _take(self, line: _Line, command: Twist, header: Header, now: float) -> str:
        position = (header.incarnation, header.sequence)
        if self._checks.inputs:
            newest = line.newest.get(header.source)
            if newest is not None and position <= newest:
                # The newer command stays valid.
                self.refused += 1
                return (f"command {header.source}:{position[0]}/{position[1]} is out of sequence,"
                        f" newest is {newest[0]}/{newest[1]}")
            line.newest[header.source] = position
        line.fault = self._fault(command, now - header.stamp)
        backwards = line is not self._stick and command.linear_mps < -_STANDING_MPS
        if backwards and self._checks.inputs and not line.fault:
            line.fault = (f"command of {command.linear_mps:.2f} m/s is backwards, "
                          "where there is no laser")
        if line.fault:
            self.refused += 1
            if self._checks.inputs:
                line.twist = (0.0, 0.0)
            return line.fault
        line.twist = (command.linear_mps, command.angular_radps)
        line.stamp_s = header.stamp
        line.heard_s = now
        return ""

    def _fault(self, command: Twist, age_s: float) -> str:
        linear, angular = command.linear_mps, command.angular_radps
        limits = self._limits
        if not (math.isfinite(linear) and math.isfinite(angular)):
            # Also in the baseline: the base cannot execute it, and the last command stays.
            return f"command ({linear}, {angular}) is not finite"
        if self._checks.inputs:
            slack = 1.0 + 1e-6
            if abs(linear) > limits.max_linear_mps * slack:
                return f"command of {linear:.2f} m/s exceeds {limits.max_linear_mps:.2f} m/s"
            if abs(angular) > limits.max_angular_radps * slack:
                return (f"command of {angular:.2f} rad/s exceeds"
                        f" {limits.max_angular_radps:.2f} rad/s")
            if not age_s <= limits.command_timeout_s:
                return f"command is {age_s:.2f} s old, limit {limits.command_timeout_s:.2f} s"
            if age_s < -AHEAD_S:
                return f"command is stamped {-age_s:.2f} s ahead of now"
        return ""

    @property
    def mode(self) -> PilotMode:
        """Mode of the strictest engaged order; auto without orders."""
        if not self.orders:
            return PilotMode.AUTO
        return max((order.mode for order in self.orders.values()), key=STRICTNESS.index)

    def output(self, now: float) -> GateOutput:
        """Return the output to the base."""
        self._expire(now)
        mode = self.mode
        reason = self._stop(now)
        if reason:
            self._stopped_s = now
        elif self._held_too_long(now):
            reason = HELD_TOO_LONG
        if reason:
            return GateOutput(0.0, 0.0, mode, True, reason)
        stick = now - self._stick.heard_s <= self._limits.joystick_timeout_s
        if mode is PilotMode.TELEOPERATION and not stick:
            return GateOutput(0.0, 0.0, mode, True, self._why(mode) or "waiting for the joystick")
        wanted, passing = self._wanted(stick, now)
        if wanted is None:
            return GateOutput(0.0, 0.0, mode, True, passing or "no command yet")
        wanted, passing = self._bounded(wanted, passing)
        linear, angular = limited(*wanted, self._points, self._limits.room)
        reason = passing
        if stick and mode is PilotMode.AUTO:
            reason = ", ".join(filter(None, ("the joystick pre-empts", passing)))
        stopped = (linear, angular) == (0.0, 0.0) != wanted
        if abs(linear) < abs(wanted[0]) * _SLOWED or stopped:
            reason = "obstacle: stopped" if linear == 0.0 else "obstacle: slowed down"
        return GateOutput(linear, angular, mode, stopped, reason)

    @property
    def top_speed_mps(self) -> float:
        """Lowest speed limit of the engaged orders; 0 without a valid one."""
        return min((order.top_speed_mps for order in self.orders.values()
                    if order.top_speed_mps > 0), default=0.0)

    def _bounded(self, wanted: tuple[float, float], passing: str
                 ) -> tuple[tuple[float, float], str]:
        """Limit a command by orders and the missing view to the rear; return it with a remark."""
        top_mps, reverse_mps = self.top_speed_mps, self._limits.reverse_mps
        ways = {order.way for order in self.orders.values()} - {Way.ANY}
        if ways:
            along = Way.FORWARDS if wanted[0] > 0 else Way.BACKWARDS
            linear = wanted[0] if ways == {along} else 0.0
            turn = min(max(wanted[1], -_WAY_TURN_RADPS), _WAY_TURN_RADPS)
            passing = passing or ("" if (linear, turn) == wanted else "only the way out, slowly")
            wanted = (linear, turn)
        if self._checks.inputs and wanted[0] < -reverse_mps:
            wanted, passing = (-reverse_mps, wanted[1]), passing or "slowly: no laser to the rear"
        if not top_mps or abs(wanted[0]) <= top_mps:
            return wanted, passing
        limited_mps = math.copysign(top_mps, wanted[0])
        return (limited_mps, wanted[1]), passing or "speed limited by an order"

    def _wanted(self, stick: bool, now: float) -> tuple[tuple[float, float] | None, str]:
        """Return the command to execute with a remark; None with the reason."""
        active = self._usable(self._stick if stick else self._auto, now)
        if stick or self._standby.twist is None:
            return active
        return self._pair.choice(active, self._usable(self._standby, now)[0], now)

    def forbidden(self, now: float) -> str:
        """Return why not even the joystick may drive now, or ""."""
        return self._stop(now) or (HELD_TOO_LONG if self._held_too_long(now) else "")

    def _stop(self, now: float) -> str:
        """Return what stops the robot regardless of the source of the command, or ""."""
        limits = self._limits
        if self.mode is PilotMode.STOP:
            return self._why(PilotMode.STOP) or "ordered to stop"
        if self._checks.manager:
            if now - self._manager.worked_s > limits.manager_timeout_s:
                return "the manager is silent"
            if now - self._started_s < limits.settling_s:
                return "just started, orders may not have arrived yet"
        if self._checks.inputs:
            if self._scan_fault:
                return self._scan_fault
            if not -AHEAD_S <= now - self._scan_s <= limits.scan_timeout_s:
                return "no fresh laser scan"
        return ""

    def _usable(self, line: _Line, now: float) -> tuple[tuple[float, float] | None, str]:
        """Return the last command of a source; None with the reason if it is unusable."""
        if self._checks.inputs and line.fault:
            return None, line.fault
        late = now - line.stamp_s > self._limits.command_timeout_s
        if self._checks.inputs and line.twist is not None and late:
            return None, "no fresh command"
        return line.twist, ""

    def _why(self, mode: PilotMode) -> str:
        """Return the reasons of the orders for a mode."""
        named = sorted(self.orders.items())
        return "; ".join(f"{name}: {order.reason}" for name, order in named if order.mode is mode)
