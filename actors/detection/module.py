"""What all detection modules have in common: the paper's two states, reports, exact timers.

A detection module is a pure monitor (what it heard, and by when it must have heard more) and an
actor round it. The actor hands events to the monitor, wakes it when its next deadline is due,
and publishes on `detection/NAME` what the monitor found: at once when it changes, and at 5 Hz.

A missing message is not its sender's fault if the module could not have received it:

* A timer that is late shows that the module, too, waits for a processor. It reads its mail for as
  long as it was late, and then judges.
* When its router dies a module receives nothing, and blames no node until the bus has
  gone over to the other one (`FAILOVER_S`).

Neither counts again within a second. Two more subtleties, about a module that was away for longer:

* A module that was itself stopped and goes on, or a machine that hung, finds every deadline
  passed while the proof to the contrary is still under way. A module that finds that it has not
  run for a while (`Absence`) becomes active a little later, if there is still a reason.
* A respawned module does not know yet whether the fault is there. Had it reported idle from its
  first moment, the manager would let go of a robot whose fault persists. So from its second
  incarnation on it is silent until it knows, and the manager takes silence for activity.
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
"""A timer that is so late, simulated seconds, shows a lack of processor time."""

EXCUSE_S = 0.1
"""How long one that was late reads its mail before it judges: a period of the slowest input."""

NEXT_EXCUSE_S = 1.0
"""Not sooner does another absence count: a module that is always late is not always excused."""

_SHORTEST_SLEEP_S = 1e-4
"""Rounding must not make a timer that is due now come again now, without end."""


class Monitor(Protocol):
    """The pure part of a detection module. Times are simulated seconds.

    Attributes:
        active: whether the fault is there.
        reason: why; constant while nothing changes.
        nodes: the failed nodes, where nodes are the subject.
        known: False until the monitor has received enough to decide.
        due_s: when `expire` is to be called next; infinite if only an event can change anything.
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
        """Draw the conclusions from the time that has passed without an event."""


M = TypeVar("M", bound=Monitor)


class DetectionModule(Actor):
    """Base of every detection module.

    A subclass either calls `activate` and `know_idle` itself, or has a `Monitor` (`judged_by`),
    hands it each event, and calls `follow` afterwards. A module that calls them itself calls
    `know_idle` whenever an event proves that the fault is not there, idle or not: from its
    second incarnation on it is silent, and counts as active, until it has called one of the two.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.DETECTION,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._report = DetectionReport(DetectionState.IDLE, "", (), self.clock.now())
        self.first_life = context.incarnation == 1
        self._told = False
        self._monitor: Monitor | None = None
        self._wake_s = math.inf
        self._alarm: Timer | None = None
        self._senders: dict[str, int] = Remembered(MANY)
        self._absence = Absence(self.clock.now(), self.clock.rate)
        self._judges_from_s = context.run.plan.begins_s  # before, the system is starting

    def grace_s(self, timeout_s: float) -> float:
        """Return how long the first input may take, s: the timeout, or more while a system starts.

        A respawned module joins a running system: for it the timeout itself is the grace.
        """
        startup_s = self.context.run.system.timing.startup_grace_s
        return max(timeout_s, startup_s) if self.first_life else timeout_s

    # -- the state machine ----------------------------------------------------------------------

    @property
    def state(self) -> DetectionState:
        """Idle or active."""
        return self._report.state

    def activate(self, reason: str, nodes: tuple[str, ...] = ()) -> None:
        """Go from idle to active; when active already, renew reason and nodes. Report changes."""
        reason = clip(reason)
        nodes = tuple(clip(name, NAME_CHARS) for name in nodes)
        since_s = self.clock.now()
        if self.state is DetectionState.ACTIVE:
            since_s = self._report.since_s
            if (reason, nodes) == (self._report.reason, self._report.nodes):
                return
        self._tell(DetectionReport(DetectionState.ACTIVE, reason, nodes, since_s))

    def know_idle(self) -> None:
        """Say that the fault is known not to be there: go to idle, or stay. Report what is new."""
        if self.state is DetectionState.ACTIVE:
            self._tell(DetectionReport(DetectionState.IDLE, "", (), self.clock.now()))
        elif not self._told:
            self._tell(self._report)

    def _tell(self, report: DetectionReport) -> None:
        self._report = report
        self._told = True
        self.publish(topics.DETECTION, report)

    @every(0.2, with_heartbeat=True)
    def repeat(self) -> None:
        """Say it again, for nodes that have joined since."""
        self.note_absence()
        self._note_move()
        if self._told or self.first_life:
            self.publish(topics.DETECTION, self._report)

    def accused(self, suspects: tuple[str, ...], header: Header) -> tuple[str, ...]:
        """Return the suspects; those that have sent a message by the incarnation that did last.

        A later incarnation has done nothing yet, and a recovery leaves it alone.

        Args:
            suspects: names of nodes.
            header: of the message that came last.
        """
        self._senders[header.source] = header.incarnation
        return tuple(f"{name}#{self._senders[name]}" if name in self._senders else name
                     for name in suspects)

    # -- the monitor ----------------------------------------------------------------------------

    def judged_by(self, monitor: M) -> M:
        """Have a monitor judge from the start on; return it."""
        self._monitor = monitor
        return monitor

    def known_after_s(self, wait_s: float) -> float:
        """Return when to claim idle though nothing was heard: at once in a system that starts."""
        return -math.inf if self.first_life else self.clock.now() + wait_s

    def on_start(self) -> None:
        """Start waiting for the first input."""
        self.follow()

    def follow(self) -> None:
        """Bring the state in line with the monitor, and see to it that its deadline is kept."""
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
        # A deadline that has moved on does not cancel the timer: that one wakes, finds nothing
        # due, and sleeps again. One timer per timeout, instead of one per message.
        if due_s < self._wake_s:
            now_s = self.clock.now()
            self._wake_s = max(due_s, now_s + _SHORTEST_SLEEP_S)  # it may be over already
            if self._alarm is not None:
                self._alarm.cancel()  # or it would wake and sleep again without end
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
        if now_s < self._judges_from_s:
            self._sleep_until(self._judges_from_s)
        else:
            monitor.expire(now_s)
            self.follow()

    def missed(self) -> None:
        """React to having been stopped: of the messages since then only the newest are there."""

    def note_absence(self) -> None:
        """Note that it runs, and whether it did not for a while; before what counts is judged."""
        if self._absence.note(self.clock.now()):
            self._judges_from_s = max(self._judges_from_s, self._absence.until_s)
            self.missed()

    def _is_withheld(self) -> bool:
        """Whether its monitor has found what may only be missing because it was absent itself."""
        return self.state is DetectionState.IDLE and self._monitor is not None and (
            self._monitor.active and self._absence.excuses(self.clock.now()))

    def _note_move(self) -> None:
        if self._bus.moved():
            self._read_mail_until(self.clock.now() + FAILOVER_S * self.clock.rate)

    def _read_mail_until(self, until_s: float) -> None:
        if self.clock.now() > self._judges_from_s + NEXT_EXCUSE_S:
            self._judges_from_s = until_s
