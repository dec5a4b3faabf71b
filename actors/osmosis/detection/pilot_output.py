"""DM12: the Safety Pilot's output is wrong, or is not there.

Is what reaches the base what somebody asked the Safety Pilot for? It only ever takes away: it lets
a command pass, slows it down, or stops. So each component of what the base gets is explained by a
command that was given a moment ago, between that and zero; exactly that one, while the pilot says
that commands pass unchanged; and nothing but zero while it says that it stops. When a computer of
the command falls silent the pilot goes on with its last one for a while, and that one explains what
it sends for as long.

What the pilot sends at once upon a command may arrive here before the command does. So an output
is judged when the next one arrives, a period later, when all that explains it has come. One that
nothing explains may be a race all the same. Two or three in a row, and a pilot that is silent or
sends old news, are not.
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
from rampart.actors.runtime.parameters import ControlTimeout, NodeName
from rampart.manager.spec.tables import NonNegative


@dataclass(frozen=True, slots=True)
class PilotLimits:
    """What counts.

    Args:
        recent_s: a command younger than this explains an output.
        held_s: so does the last one of a computer of the command, so long: the pilot's timeout.
        rounding: relative and absolute difference that is none.
        wrong_s: how long outputs may be without explanation.
        timeout_s: how old the newest output may be.
        hold_s: how long all must have been well again.
        status_s: how long the pilot's word may take to follow its deed.
    """

    recent_s: float = 0.3
    held_s: float = 0.3
    rounding: float = 1e-3
    wrong_s: float = 0.1
    timeout_s: float = 0.3
    hold_s: float = 0.5
    status_s: float = 0.25


class PilotOutputMonitor(Finding):
    """Active while the Safety Pilot's output is not explained, or not there.

    Args:
        pilot: name of its node, which is accused.
        start_s: now.
        grace_s: how long the first output may take.
        limits: what counts.
        known: whether idle may be claimed before anything was heard.
    """

    def __init__(self, pilot: str, start_s: float, grace_s: float,
                 limits: PilotLimits | None = None, *, known: bool = True) -> None:
        super().__init__(-math.inf if known else math.inf)
        self.limits = limits or PilotLimits()
        self._pilot = pilot
        self._incarnation = 0
        self._asked: deque[tuple[float, float, float]] = deque(maxlen=64)
        self._held: dict[str, tuple[float, float, float]] = {}
        self._newest_s = -math.inf
        self._overdue_s = start_s + grace_s
        self._last: tuple[float, float, float] | None = None
        self._wrong = Lasting(self.limits.wrong_s)
        self._well = Lasting(self.limits.hold_s)
        self._says = (False, False)  # that it stops the robot, that commands pass unchanged
        self._said_s = -math.inf

    @property
    def due_s(self) -> float:
        """When the next output is overdue."""
        return math.inf if self.active else self._overdue_s

    def expire(self, now_s: float) -> None:
        """Conclude from the time without an output."""
        if now_s >= self._overdue_s and not self.active:
            self._accuse(f"no fresh command for the base for {self.limits.timeout_s:g} s")

    def asked(self, linear_mps: float, angular_radps: float, now_s: float,
              computer: str = "") -> None:
        """Take a command given to the pilot: by a computer of it, or by a joystick ("")."""
        asked = (now_s, linear_mps, angular_radps)
        self._asked.append(asked)
        if computer:
            self._held[computer] = asked

    def said(self, *, stopped: bool, reason: str, now_s: float) -> None:
        """Take the pilot's own word: whether it stops the robot, and why commands are changed."""
        before, self._says = self._says, (stopped, not stopped and not reason)
        if self._says != before:
            self._said_s = now_s

    def sent(self, linear_mps: float, angular_radps: float, stamp_s: float, incarnation: int,
             now_s: float) -> None:
        """Take a command for the base, sent at `stamp_s`."""
        if incarnation != self._incarnation:
            self._incarnation = incarnation
            self._wrong.forget()
            self._said_s = now_s
            self._last = None
        if is_possible(stamp_s, now_s):
            self._newest_s = max(self._newest_s, min(stamp_s, now_s))
            self._overdue_s = self._newest_s + self.limits.timeout_s
        fresh = now_s < self._overdue_s
        self.known = self.known or (fresh and self._newest_s > -math.inf)
        last, self._last = self._last, (now_s, linear_mps, angular_radps)
        wrong = self._unexplained(*last) if last is not None else ""
        if self._wrong.note(bool(wrong), now_s) and not self._is_accused:
            self._accuse(wrong)  # a later life as well, if that is wrong for long enough too
        elif self._well.note(fresh and not wrong, now_s):
            self.clear()

    def _unexplained(self, sent_s: float, linear_mps: float, angular_radps: float) -> str:
        """Why nothing explains an output that arrived at `sent_s`, or ""."""
        if (linear_mps, angular_radps) == (0.0, 0.0):
            return ""
        limits = self.limits
        has_said = sent_s - self._said_s > limits.status_s
        says_stop, says_unchanged = self._says
        if says_stop and has_said:
            return f"{_shown(linear_mps, angular_radps)} while the safety pilot says that it stops"
        exactly = says_unchanged and has_said
        moves = turns = False
        recent = takewhile(lambda asked: sent_s - asked[0] <= limits.recent_s,
                           reversed(self._asked))
        held = (asked for asked in self._held.values() if sent_s - asked[0] <= limits.held_s)
        for _, linear_asked, angular_asked in chain(recent, held):
            moves = moves or self._explains(linear_asked, linear_mps, exactly=exactly)
            turns = turns or self._explains(angular_asked, angular_radps, exactly=exactly)
            if moves and turns:
                return ""
        return f"{_shown(linear_mps, angular_radps)}, which nobody has asked for"

    def _explains(self, asked: float, got: float, *, exactly: bool) -> bool:
        slack = self.limits.rounding * (1.0 + abs(asked))
        if exactly:
            return abs(asked - got) <= slack
        return min(0.0, asked) - slack <= got <= max(0.0, asked) + slack

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
    """Compares what the base gets with what the Safety Pilot was asked for and says it does.

    Names the pilot's life, so that it can be respawned: an error of software that sits in its
    process goes with it.
    """

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Whom it checks, and how strictly.

        Attributes:
            pilot: name of the Safety Pilot's node.
            timeout_s: how old the newest command for the base may be; below the base's dead man.
            wrong_s: how long commands for the base may be without explanation, s.
            hold_s: how long all must have been well again before the module is idle, s.
        """

        pilot: NodeName = "safety_pilot"
        timeout_s: ControlTimeout = PilotLimits().timeout_s
        wrong_s: NonNegative = PilotLimits().wrong_s
        hold_s: NonNegative = PilotLimits().hold_s

    parameters: Parameters
    optional_inputs = (topics.STANDBY_COMMAND,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system, parameters = context.run.system, self.parameters
        limits = PilotLimits(
            # As the Safety Pilot has it: without its checks it goes on for ever.
            held_s=(system.timing.command_timeout_s if system.layers.safety_pilot_checks
                    else math.inf),
            timeout_s=parameters.timeout_s, wrong_s=parameters.wrong_s, hold_s=parameters.hold_s)
        self.monitor = self.judged_by(PilotOutputMonitor(
            parameters.pilot, self.clock.now(), self.grace_s(limits.timeout_s), limits,
            known=self.first_life))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, _header: Header) -> None:
        """Hear what Osmosis Control asks for."""
        self.monitor.asked(message.linear_mps, message.angular_radps, self.clock.now(), "active")

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, _header: Header) -> None:
        """Hear what its standby asks for."""
        self.monitor.asked(message.linear_mps, message.angular_radps, self.clock.now(), "standby")

    @on(topics.TELEOP_COMMAND)
    def joystick(self, message: m.Twist, _header: Header) -> None:
        """Hear what the operator asks for."""
        self.monitor.asked(message.linear_mps, message.angular_radps, self.clock.now())

    @on(topics.PILOT_STATUS)
    def status(self, message: m.PilotStatus, _header: Header) -> None:
        """Hear what the Safety Pilot says that it does."""
        self.monitor.said(stopped=message.stopped, reason=message.reason, now_s=self.clock.now())

    @on(topics.BASE_COMMAND)
    def sent(self, message: m.BaseCommand, header: Header) -> None:
        """Hear what the base gets."""
        self.monitor.sent(message.linear_mps, message.angular_radps, header.stamp,
                          header.incarnation, self.clock.now())
        self.follow()
