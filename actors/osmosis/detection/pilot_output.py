"""DM12: the Safety Pilot's output is wrong or missing.

The Safety Pilot passes a command, slows it down, or stops. So each component of its output lies
between a recent command and zero. It equals the command while the pilot's status is that commands
pass unchanged, and it is zero while the status is that it stops. When a source of commands is
silent, the pilot repeats its last command for a while, which explains the output meanwhile.

The pilot's reaction to a command may arrive here before the command. So an output is checked when
the next one arrives, a period later. A single unexplained output may still be a race; several in a
row are an error, as is a silent pilot or one with old stamps.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import chain, takewhile

from rampart.actors.detection.finding import Finding, Lasting
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeName


@dataclass(frozen=True, slots=True)
class PilotLimits:
    """Tolerances.

    Args:
        recent_s: greatest age of a command that explains an output.
        held_s: the same for the last command of each source: the pilot's timeout.
        rounding: tolerated relative and absolute difference.
        wrong_s: longest time of unexplained outputs.
        timeout_s: greatest age of the newest output; below the base's dead man.
        hold_s: time without an error after which it is idle again.
        status_s: longest delay of the pilot's status.
    """

    recent_s: float = 0.3
    held_s: float = 0.3
    rounding: float = 1e-3
    wrong_s: float = 0.1
    timeout_s: float = 0.3
    hold_s: float = 0.5
    status_s: float = 0.25


class PilotOutputMonitor(Finding):
    """Active while the Safety Pilot's output is unexplained or missing.

    Args:
        pilot: name of its node.
        start_s: now.
        grace_s: longest time until the first output.
        limits: tolerances.
        known: whether it may be idle before any input.
    """

    def __init__(self, pilot: str, start_s: float, grace_s: float,
                 limits: PilotLimits | None = None, *, known: bool = True) -> None:
        super().__init__(-math.inf if known else math.inf)
        self.limits = limits or PilotLimits()
        self._pilot = pilot
        self._incarnation = 0
        self._commands: deque[tuple[float, float, float]] = deque(maxlen=64)
        self._held: dict[str, tuple[float, float, float]] = {}
        self._newest_s = -math.inf
        self._overdue_s = start_s + grace_s
        self._last: tuple[float, float, float] | None = None
        self._wrong = Lasting(self.limits.wrong_s)
        self._well = Lasting(self.limits.hold_s)
        self._status = (False, False)  # it stops the robot; commands pass unchanged
        self._status_s = -math.inf

    @property
    def due_s(self) -> float:
        """Time at which the next output is overdue."""
        return math.inf if self.active else self._overdue_s

    def expire(self, now_s: float) -> None:
        """Become active if the output is overdue."""
        if now_s >= self._overdue_s and not self.active:
            self._accuse(f"no fresh command for the base for {self.limits.timeout_s:g} s")

    def commanded(self, linear_mps: float, angular_radps: float, now_s: float,
                  source: str = "") -> None:
        """Take a command for the pilot, of Osmosis Control or its standby, or a joystick ("")."""
        command = (now_s, linear_mps, angular_radps)
        self._commands.append(command)
        if source:
            self._held[source] = command

    def status(self, *, stopped: bool, reason: str, now_s: float) -> None:
        """Take the pilot's status: whether it stops the robot, and why it changes commands."""
        before, self._status = self._status, (stopped, not stopped and not reason)
        if self._status != before:
            self._status_s = now_s

    def sent(self, linear_mps: float, angular_radps: float, stamp_s: float, incarnation: int,
             now_s: float) -> None:
        """Take an output of the time `stamp_s`."""
        if incarnation != self._incarnation:
            self._incarnation = incarnation
            self._wrong.forget()
            self._status_s = now_s
            self._last = None
        if is_possible(stamp_s, now_s):
            self._newest_s = max(self._newest_s, min(stamp_s, now_s))
            self._overdue_s = self._newest_s + self.limits.timeout_s
        fresh = now_s < self._overdue_s
        self.known = self.known or (fresh and self._newest_s > -math.inf)
        last, self._last = self._last, (now_s, linear_mps, angular_radps)
        wrong = self._unexplained(*last) if last is not None else ""
        if self._wrong.note(bool(wrong), now_s) and not self._is_accused:
            self._accuse(wrong)
        elif self._well.note(fresh and not wrong, now_s):
            self.clear()

    def _unexplained(self, sent_s: float, linear_mps: float, angular_radps: float) -> str:
        """Return why no command explains an output of the time `sent_s`, or ""."""
        if (linear_mps, angular_radps) == (0.0, 0.0):
            return ""
        limits = self.limits
        settled = sent_s - self._status_s > limits.status_s
        stops, unchanged = self._status
        if stops and settled:
            return f"{_shown(linear_mps, angular_radps)} while the safety pilot reports a stop"
        exactly = unchanged and settled
        moves = turns = False
        recent = takewhile(lambda command: sent_s - command[0] <= limits.recent_s,
                           reversed(self._commands))
        held = (command for command in self._held.values()
                if sent_s - command[0] <= limits.held_s)
        for _, linear, angular in chain(recent, held):
            moves = moves or self._explains(linear, linear_mps, exactly=exactly)
            turns = turns or self._explains(angular, angular_radps, exactly=exactly)
            if moves and turns:
                return ""
        return f"{_shown(linear_mps, angular_radps)}, which no command explains"

    def _explains(self, command: float, output: float, *, exactly: bool) -> bool:
        slack = self.limits.rounding * (1.0 + abs(command))
        if exactly:
            return abs(command - output) <= slack
        return min(0.0, command) - slack <= output <= max(0.0, command) + slack

    def _accuse(self, reason: str) -> None:
        self.known = True
        self.reason = reason
        self.nodes = (f"{self._pilot}#{self._incarnation}",)
        self._well.forget()

    @property
    def _is_accused(self) -> bool:
        return self.nodes == (f"{self._pilot}#{self._incarnation}",)


def _shown(linear_mps: float, angular_radps: float) -> str:
    return f"the base got {linear_mps:.2f} m/s {angular_radps:.2f} rad/s"


class PilotOutput(DetectionModule):
    """Compares the base's commands with the inputs and the status of the Safety Pilot.

    It names the pilot's incarnation, since a restart removes an error in its process.
    """

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Parameters.

        Attributes:
            pilot: name of the Safety Pilot's node.
        """

        pilot: NodeName = "safety_pilot"

    parameters: Parameters
    optional_inputs = (topics.STANDBY_COMMAND,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system = context.run.system
        # Without its checks the Safety Pilot repeats the last command permanently.
        limits = PilotLimits(held_s=system.timing.command_timeout_s
                             if system.layers.safety_pilot_checks else math.inf)
        self.monitor = self.judged_by(PilotOutputMonitor(
            self.parameters.pilot, self.clock.now(), self.grace_s(limits.timeout_s), limits,
            known=self.first_life))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, _header: Header) -> None:
        """Take Osmosis Control's command."""
        self.monitor.commanded(
            message.linear_mps, message.angular_radps, self.clock.now(), "active")

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, _header: Header) -> None:
        """Take the standby's command."""
        self.monitor.commanded(
            message.linear_mps, message.angular_radps, self.clock.now(), "standby")

    @on(topics.TELEOP_COMMAND)
    def joystick(self, message: m.Twist, _header: Header) -> None:
        """Take the operator's command."""
        self.monitor.commanded(message.linear_mps, message.angular_radps, self.clock.now())

    @on(topics.PILOT_STATUS)
    def status(self, message: m.PilotStatus, _header: Header) -> None:
        """Take the Safety Pilot's status."""
        self.monitor.status(stopped=message.stopped, reason=message.reason, now_s=self.clock.now())

    @on(topics.BASE_COMMAND)
    def sent(self, message: m.BaseCommand, header: Header) -> None:
        """Take the command for the base."""
        self.monitor.sent(message.linear_mps, message.angular_radps, header.stamp,
                          header.incarnation, self.clock.now())
        self.follow()
