"""Safety Pilot: the gate before the base."""

from __future__ import annotations

import math

from rampart.actors.bus.bounds import clip
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import Holds, ManagerStatus, Reset
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.limits_from_spec import checks_of, gate_of, reach_of
from rampart.actors.osmosis.control.pilot.laser_pair import LOWER, UPPER, LaserPair
from rampart.actors.osmosis.control.pilot.safety_gate import GateOutput, SafetyGate
from rampart.actors.runtime.actor import Actor, Context, Header, every, on

_PERIOD_S = 0.05


class SafetyPilot(Actor):
    """Wires `SafetyGate` to its topics.

    Commands and orders act at once. The timer repeats the output for the base's dead man, and
    applies timeouts.
    """

    outputs = (topics.BASE_COMMAND, topics.PILOT_STATUS, ftm_topics.HOLDS)
    optional_inputs = (topics.STANDBY_COMMAND,)
    node_kind = "pilot"

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system = context.run.system
        self._recoveries = frozenset(recovery.name for recovery in system.recoveries)
        self._gate = SafetyGate(
            gate_of(system), checks_of(system), context.clock.now(), self._recoveries)
        self._lasers = LaserPair(reach_of(system))
        self._laser_fault = ""
        self._ordered, self._unknown = (self._gate.mode, 0.0), self._gate.orders.unknown
        self._sent_s = -math.inf
        self._last = GateOutput(0.0, 0.0, m.PilotMode.AUTO, True, "just started")

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Pass Osmosis Control's command to the gate and act."""
        self._report_refusal(self._gate.command(message, header, self.clock.now()), header)
        self._act()

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, header: Header) -> None:
        """Pass the standby's command to the gate; act only if it affects the output."""
        now = self.clock.now()
        self._report_refusal(self._gate.standby(message, header, now), header)
        if self._gate.standby_drives(now):
            self._act()

    @on(topics.TELEOP_COMMAND)
    def joystick(self, message: m.StickTwist, header: Header) -> None:
        """Pass the operator's command to the gate and act."""
        self._report_refusal(self._gate.joystick(message, header, self.clock.now()), header)
        self._act()

    @on(topics.BASE_STATUS)
    def base(self, message: m.BaseStatus, header: Header) -> None:
        """Take whether the base brakes, by its dead man or by an order past this node."""
        if message.brake_engaged or message.dead_man_tripped:
            self._gate.braked(min(header.stamp, self.clock.now()))
            if not self._last.stopped and self._gate.forbidden(self.clock.now()):
                self._act()

    @on(topics.SCAN)
    def scan(self, message: m.LaserScan, header: Header) -> None:
        """Update the view; without a trusted view the robot stops."""
        self._see(LOWER, message, header)

    @on(topics.UPPER_SCAN)
    def upper_scan(self, message: m.LaserScan, header: Header) -> None:
        """Update the view by the second laser, if the robot has one."""
        self._see(UPPER, message, header)

    @on(topics.PILOT_ORDER)
    def order(self, message: m.PilotOrder, header: Header) -> None:
        """Take an order, of unknown modules too, and act on a change."""
        self._gate.order(header.source, message, min(header.stamp, self.clock.now()))
        if message.engaged and header.source not in self._recoveries:
            self.report_diagnostic("pilot order", f"given by {header.source!r}, which is not a "
                                   "recovery module of this system; rampart reset ends it",
                                   header.source)
        self._act_on_orders()

    @on(ftm_topics.RESET)
    def reset(self, message: Reset, _header: Header) -> None:
        """End the order of a module that is not a recovery module of the system."""
        if self._gate.orders.reset(message.recovery):
            self._act_on_orders()

    def _act_on_orders(self) -> None:
        """Act if the orders have changed."""
        gate, ordered, unknown = self._gate, self._ordered, self._unknown
        self._ordered, self._unknown = (gate.mode, gate.top_speed_mps), gate.orders.unknown
        if self._ordered != ordered:
            self._act()
            self._publish_status()
        if self._unknown != unknown:
            self._publish_holds()

    def _publish_holds(self) -> None:
        """Publish the modules that order something and should not."""
        self.publish(ftm_topics.HOLDS, Holds("pilot", self._gate.orders.unknown))

    @on(ftm_topics.MANAGER_STATUS)
    def manager(self, _message: ManagerStatus, header: Header) -> None:
        """Take the time of the manager's status."""
        self._gate.manager_alive(min(header.stamp, self.clock.now()), header.incarnation)

    @every(_PERIOD_S)
    def repeat(self) -> None:
        """Repeat the output, unless fresh commands cause it at this rate anyway."""
        self.read_postings()
        if self.clock.now() - self._sent_s > 1.2 * _PERIOD_S:
            self._act()

    @every(0.2)
    def repeat_status(self) -> None:
        """Repeat the status."""
        self._publish_status()
        if self._gate.orders.unknown:
            self._publish_holds()

    def _see(self, laser: int, message: m.LaserScan, header: Header) -> None:
        view = self._lasers.take(laser, message, header.stamp, self.clock.now())
        if view is None:
            return
        self._gate.scan(view.points, view.stamp_s, view.fault)
        if view.fault != self._laser_fault:
            self._laser_fault = view.fault
            self._act()

    def _act(self) -> None:
        now = self.clock.now()
        before, self._last = self._last, self._gate.output(now)
        self._sent_s = now
        self.publish(
            topics.BASE_COMMAND, m.BaseCommand(self._last.linear_mps, self._last.angular_radps))
        shown = (before.mode, before.stopped, before.reason)
        if shown != (self._last.mode, self._last.stopped, self._last.reason):
            self._publish_status()

    def _publish_status(self) -> None:
        last = self._last
        self.publish(topics.PILOT_STATUS, m.PilotStatus(
            last.mode, last.stopped, clip(last.reason), self._gate.refused,
            self._gate.top_speed_mps, clip(self._gate.forbidden(self.clock.now()))))

    def _report_refusal(self, refused: str, header: Header) -> None:
        if refused:
            self.report_diagnostic("command refused", refused, header.source)
