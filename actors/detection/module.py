"""Base of detection modules: the paper's two states, reports, exact timers.

A detection module is a pure monitor inside an actor. The actor hands events to the monitor, wakes
it at its next deadline, and publishes its finding on `detection/NAME`: each change at once, and the
present state at 5 Hz.

A missing message is not its sender's fault if the module could not receive it:

* A late timer shows that the module itself lacks processor time. It reads its mail for as long as
  it was late, and then decides.
* When its router dies, the module receives nothing. It blames no node until the bus has changed to
  the other router (`FAILOVER_S`).
* A module that was stopped finds all deadlines passed, although messages are waiting. It becomes
  active a little later, if there is still a reason (`Absence`).

The first two excuses count once a second at most.

A respawned module does not know whether the fault is present. If it reported idle at once, the
manager would release a robot whose fault persists. So from its second incarnation on a module is
silent until it knows, and the manager takes silence for activity.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Protocol, TypeVar

from rampart.actors.bus.bounds import MANY, NAME_CHARS, clip
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import DetectionReport, DetectionState
from rampart.actors.machine.absence import Absence
from rampart.actors.runtime.actor import Actor, Context, Header, every
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.tables import FAILOVER_S

LATE_S = 0.02
"""A timer this late shows a lack of processor time; simulated seconds."""

EXCUSE_S = 0.1
"""Longest time for which a late module reads its mail first: a period of the slowest input."""

NEXT_EXCUSE_S = 1.0
"""Pause until the next excuse, or a module that is always late would never decide."""

_SHORTEST_SLEEP_S = 1e-4
"""Rounding must not make a timer come again at once, endlessly."""


class Monitor(Protocol):
    """The pure part of a detection module. Times are simulated seconds.

    Attributes:
        active: Whether the fault is present.
        reason: Why; constant while nothing changes.
        nodes: The failed nodes, where nodes are the subject.
        known: False until the monitor has received enough to decide.
        due_s: When to call `expire` next; infinite if only an event can change the finding.
    """

    @property
    def active(self) -> bool: ...  # noqa: D102
    @property
    def reason(self) -> str: ...  # noqa: D102
    @property
    def nodes(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def known(self) -> bool: ...  # noqa: D102
    @property
    def due_s(self) -> float: ...  # noqa: D102

    def expire(self, now_s: float) -> None:
        """Conclude from the time without an event."""


M = TypeVar("M", bound=Monitor)


class DetectionModule(Actor):
    """Base of every detection module.

    A subclass either calls `activate` and `know_idle` itself, or has a `Monitor` (`judged_by`),
    hands it each event, and calls `follow` afterwards. In the first case it calls `know_idle`
    whenever an event proves that the fault is absent, also while idle. From its second incarnation
    on it is silent, and counts as active, until it has called one of the two.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.DETECTION,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._report = DetectionReport(DetectionState.IDLE, "", (), self.clock.now())
        self.first_life = context.incarnation == 1
        self._has_reported = False
        self._monitor: Monitor | None = None
        self._wake_s = math.inf
        self._alarm: Timer | None = None
        self._senders: dict[str, int] = Remembered(MANY)
        self._absence = Absence(self.clock.now(), self.clock.rate)
        self._decides_from_s = context.run.plan.begins_s  # before, the system is starting

    def grace_s(self, timeout_s: float) -> float:
        """Return how long the first input may take, s.

        The timeout for a respawned module, which joins a running system; longer at the start.
        """
        startup_s = self.context.run.system.timing.startup_grace_s
        return max(timeout_s, startup_s) if self.first_life else timeout_s

    # -- the state machine ----------------------------------------------------------------------

    @property
    def state(self) -> DetectionState:
        """Idle or active."""
        return self._report.state

    def activate(self, reason: str, nodes: tuple[str, ...] = ()) -> None:
        """Become active, or update reason and nodes while active. Report changes."""
        reason = clip(reason)
        nodes = tuple(clip(name, NAME_CHARS) for name in nodes)
        since_s = self.clock.now()
        if self.state is DetectionState.ACTIVE:
            since_s = self._report.since_s
            if (reason, nodes) == (self._report.reason, self._report.nodes):
                return
        self._send(DetectionReport(DetectionState.ACTIVE, reason, nodes, since_s))

    def know_idle(self) -> None:
        """Become or stay idle, since the fault is known to be absent. Report changes."""
        if self.state is DetectionState.ACTIVE:
            self._send(DetectionReport(DetectionState.IDLE, "", (), self.clock.now()))
        elif not self._has_reported:
            self._send(self._report)

    def _send(self, report: DetectionReport) -> None:
        self._report = report
        self._has_reported = True
        self.publish(topics.DETECTION, report)

    @every(0.2, with_heartbeat=True)
    def repeat(self) -> None:
        """Repeat the report for nodes that have joined."""
        self.note_absence()
        self._note_move()
        if self._has_reported or self.first_life:
            self.publish(topics.DETECTION, self._report)

    def accused(self, suspects: tuple[str, ...], header: Header) -> tuple[str, ...]:
        """Return the suspects, each with the incarnation of its last message.

        A suspect that has sent none has the incarnation that was issued last. A recovery leaves a
        later incarnation alone, since it has done nothing wrong.

        Args:
            suspects: Names of nodes.
            header: Of the last message.
        """
        self._senders[header.source] = header.incarnation
        latest = {name: self._senders.get(name) or self.context.register(name)
                  for name in suspects}
        return tuple(f"{name}#{number}" if number else name for name, number in latest.items())

    # -- the monitor ----------------------------------------------------------------------------

    def judged_by(self, monitor: M) -> M:
        """Use a monitor from the start on; return it."""
        self._monitor = monitor
        return monitor

    def known_after_s(self, wait_s: float) -> float:
        """Return when to report idle without any input: at once in a system that starts."""
        return -math.inf if self.first_life else self.clock.now() + wait_s

    def on_start(self) -> None:
        """Wait for the first input."""
        self.follow()

    def follow(self) -> None:
        """Take over the finding of the monitor, and set a timer for its deadline."""
        monitor = self._monitor
        if monitor is None:
            return
        self.note_absence()
        if self._is_withheld():
            self._sleep_until(self._absence.until_s)
            return
        if monitor.active:
            self.activate(monitor.reason, monitor.nodes)
        elif monitor.known or self.state is DetectionState.ACTIVE:
            self.know_idle()
        self._sleep_until(monitor.due_s)

    def _sleep_until(self, due_s: float) -> None:
        # A later deadline does not cancel the timer, which wakes and sleeps again: so there is one
        # timer per timeout, not one per message.
        if due_s < self._wake_s:
            now_s = self.clock.now()
            self._wake_s = max(due_s, now_s + _SHORTEST_SLEEP_S)  # it may have passed
            if self._alarm is not None:
                self._alarm.cancel()
            self._alarm = self.call_later(self._wake_s - now_s, self._woken)

    def _woken(self) -> None:
        monitor = self._monitor
        if monitor is None:
            return
        due_s, self._wake_s, self._alarm = self._wake_s, math.inf, None
        self.read_postings()
        self.note_absence()
        now_s = self.clock.now()
        if monitor.due_s <= now_s:
            self._note_move()
            if now_s - due_s > LATE_S:
                self._read_mail_until(now_s + min(now_s - due_s, EXCUSE_S))
        if now_s < self._decides_from_s:
            self._sleep_until(self._decides_from_s)
        else:
            monitor.expire(now_s)
            self.follow()

    def missed(self) -> None:
        """React to having been stopped: only the newest messages of that time are left."""

    def note_absence(self) -> None:
        """Note that the module runs, and whether it did not for a while; before each decision."""
        if self._absence.note(self.clock.now()):
            self._decides_from_s = max(self._decides_from_s, self._absence.until_s)
            self.missed()

    def _is_withheld(self) -> bool:
        """Whether the monitor may be active only because the module itself did not run."""
        return self.state is DetectionState.IDLE and self._monitor is not None and (
            self._monitor.active and self._absence.excuses(self.clock.now()))

    def _note_move(self) -> None:
        if self._bus.moved():
            self._read_mail_until(self.clock.now() + FAILOVER_S * self.clock.rate)

    def _read_mail_until(self, until_s: float) -> None:
        if self.clock.now() > self._decides_from_s + NEXT_EXCUSE_S:
            self._decides_from_s = until_s
