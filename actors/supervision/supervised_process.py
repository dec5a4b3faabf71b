"""A supervised process: its states, the events that change them, and the actions that follow.

`TRANSITIONS` is the whole state machine; any other event changes nothing. Time is an argument, and
`rampart.actors.supervision.supervisor` carries out the actions.

Restarts follow OTP's restart intensity, with backoff, by the numbers of `[supervision]` in the
system spec, or of the node's `restart`. Up to half of `intensity` restarts within `period_s` happen
at once. Each further one waits longer, doubling from `backoff_s`. After `intensity` restarts the
policy gives up. The process may work again later, when a disk has room or a device is plugged in.
So single attempts follow, at growing intervals. If one of them lasts for a whole period, the
process counts as healthy again. Until then its silence has its usual effect: a silent detection
module counts as active, a silent manager stops the Safety Pilot, and a silent Safety Pilot trips
the dead man.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any, NamedTuple

from rampart.actors.bus.run_folder import restarts_of
from rampart.actors.ftm.messages import NodeInfo, NodeState
from rampart.actors.machine.patience import Patience, Usage
from rampart.actors.runtime.timer import Timer
from rampart.actors.supervision.processes import ProcessHandle
from rampart.actors.system.layout import Unit
from rampart.manager.spec.tables import Supervision

START_TIMEOUT_S = 3.0
"""Wall seconds within which a new process has to send its first heartbeat."""

MANY, MANY_SHARE = 2, 1 / 8
"""If this number and share of processes is late at once, the cause is the machine or the bus."""

MOST_EXCUSED_S = 3.0
"""Wall seconds of silence after which a process is replaced though many are silent. Only time in
which it could have run counts."""

STATUS = "fresh status of the manager"
"""Stands among the names of the manager's process: the Safety Pilot depends on this status."""

_USUAL = Supervision()
_MOST_DOUBLINGS = 60
"""A bound on the exponent; the longest wait is reached long before."""


class State(Enum):
    """State of a process; each but `RESTARTING` is published as the `NodeState` of this value."""

    STARTING = "starting"
    """It is forked and has sent no heartbeat yet."""
    RUNNING = "running"
    STOPPED = "stopped"
    WEDGED = "wedged"
    CRASHED = "crashed"
    """It has ended, or never existed, and no restart is requested."""
    RESTARTING = "restarting"
    """It is killed, and the next one is forked as soon as it is gone."""
    GIVEN_UP = "given up"
    """As `RESTARTING`, but much later."""


class Event(Enum):
    """An event of a process."""

    HEARTBEAT = auto()
    SILENT = auto()
    """No heartbeat arrived in time, although the process could have run."""
    SILENT_STOPPED = auto()
    """As `SILENT`, and the kernel reports that it is stopped."""
    ENDED = auto()
    START = auto()
    """The run starts, or a new supervisor finds no process."""
    RESTART = auto()
    """A restart is requested and granted."""
    TOO_OFTEN = auto()
    """A restart is requested, but there were too many already."""
    STARTED = auto()
    """Its first process is forked."""
    FORKED = auto()
    """A later process is forked."""
    ADOPTED = auto()
    """A new supervisor finds a living process."""
    ADAPTED = auto()
    """It has new parameters."""


class Action(Enum):
    """An action of the supervisor."""

    REPORT = auto()
    """Publish the transition as a `ProcessEvent`."""
    PUBLISH = auto()
    """Publish the node table."""
    RECOVER = auto()
    """Restart the process, unless a recovery module has to request that."""
    KILL = auto()
    FORK = auto()
    """Fork the next process now."""
    FORK_WHEN_GONE = auto()
    """Fork the next process after `delay_s`, when the old one is gone."""
    HOLD = auto()
    """Watch for its end."""


class Transition(NamedTuple):
    """The next state, its name in a `ProcessEvent`, and the actions, in this order.

    An action may itself cause a transition; then the later actions are skipped.
    """

    state: State
    word: str = ""
    actions: tuple[Action, ...] = ()


_A, _E, _S = Action, Event, State
_PRESENT = (_S.STARTING, _S.RUNNING, _S.STOPPED, _S.WEDGED)
_WAITING = (_S.RESTARTING, _S.GIVEN_UP)
_WELL = (_A.REPORT, _A.PUBLISH)
_LOST = (_A.REPORT, _A.PUBLISH, _A.RECOVER)
_NEW = (_A.REPORT, _A.PUBLISH, _A.HOLD)
_OVER = (_A.KILL, _A.REPORT, _A.PUBLISH, _A.FORK_WHEN_GONE)

_ROWS: tuple[tuple[Iterable[State], Event, Transition], ...] = (
    ((_S.STARTING,), _E.HEARTBEAT, Transition(_S.RUNNING, "running", _WELL)),
    ((_S.STOPPED, _S.WEDGED), _E.HEARTBEAT, Transition(_S.RUNNING, "resumed", _WELL)),
    ((_S.STARTING, _S.RUNNING), _E.SILENT, Transition(_S.WEDGED, "wedged", _LOST)),
    ((_S.RUNNING,), _E.SILENT_STOPPED, Transition(_S.STOPPED, "stopped", _LOST)),
    (_PRESENT, _E.ENDED, Transition(_S.CRASHED, "crashed", _LOST)),
    ((_S.CRASHED,), _E.START, Transition(_S.RESTARTING, "", (_A.FORK,))),
    ((*_PRESENT, _S.CRASHED), _E.RESTART, Transition(
        _S.RESTARTING, "", (_A.KILL, _A.FORK_WHEN_GONE))),
    ((_S.GIVEN_UP,), _E.RESTART, Transition(_S.GIVEN_UP, "given up", (_A.REPORT,))),
    ((*_PRESENT, _S.CRASHED), _E.TOO_OFTEN, Transition(_S.GIVEN_UP, "given up", _OVER)),
    ((_S.RESTARTING,), _E.STARTED, Transition(_S.STARTING, "started", _NEW)),
    (_WAITING, _E.FORKED, Transition(_S.STARTING, "respawned", _NEW)),
    ((_S.CRASHED,), _E.ADOPTED, Transition(_S.RUNNING, "adopted", (_A.REPORT, _A.HOLD))),
    ((_S.GIVEN_UP,), _E.ADAPTED, Transition(_S.CRASHED)))

TRANSITIONS = {(state, event): then for states, event, then in _ROWS for state in states}


@dataclass(slots=True)
class RestartPolicy:
    """Sliding window of the restarts of one process. Times are seconds of the caller's clock.

    Attributes:
        limits: Of the system spec.
        attempts: Number of single attempts since it gave up; 0 if it has not.
    """

    limits: Supervision = _USUAL
    attempts: int = 0
    _restarts: deque[float] = field(default_factory=deque)

    def delay_s(self, now_s: float) -> float | None:
        """Return the wait before the next restart, None to give up."""
        limits = self.limits
        while self._restarts and now_s - self._restarts[0] > limits.period_s:
            self._restarts.popleft()
        count, free = len(self._restarts), limits.intensity // 2
        if count == 0:
            self.attempts = 0
        if count >= limits.intensity or self.attempts:
            return None
        return 0.0 if count < free else _doubled(
            limits.backoff_s, count - free, limits.backoff_max_s)

    def attempt_in_s(self, now_s: float) -> float:
        """Return the wait before the next single attempt, which grows with each that failed.

        The window has room for a restart when the wait is over.
        """
        limits = self.limits
        pause_s = _doubled(limits.attempt_s, self.attempts, limits.attempt_max_s)
        self.attempts += 1
        if len(self._restarts) < limits.intensity:
            return pause_s
        return max(pause_s, self._restarts[-limits.intensity] + limits.period_s - now_s)

    def restarted(self, now_s: float) -> None:
        """Note a restart."""
        self._restarts.append(now_s)


FAILING = ((3, 1.0), (20, 10.0))
"""A node is failing if this number of processes in a row each worked for less than this number of
wall seconds: that is neither an accident nor a single fault."""


WELL_PERIODS = 10
"""A process that works for this number of periods is well: what was before does not count."""


class Lives:
    """How long the last processes of a node worked. Pure; times are seconds of the caller's clock.

    A process works from its first heartbeat on. A node whose processes die more slowly than restart
    intensity notices fails too: after `intensity` restarts since a process was last well.
    """

    def __init__(self, limits: Supervision = _USUAL) -> None:
        self._intensity, self._well_s = limits.intensity, WELL_PERIODS * limits.period_s
        self._slow_deaths = 0
        self._began_s: float | None = None
        self._worked_s: deque[float] = deque(maxlen=max(count for count, _ in FAILING))

    def forked(self) -> None:
        """Note a new process."""
        self._began_s = math.inf

    def worked(self, now_s: float) -> None:
        """Note a heartbeat of it."""
        if self._began_s == math.inf:
            self._began_s = now_s

    def ended(self, now_s: float) -> bool:
        """Note the end of the process; return False for a repetition, which has no effect."""
        if self._began_s is None:
            return False
        worked_s, self._began_s = max(0.0, now_s - self._began_s), None
        self._worked_s.append(worked_s)
        if worked_s >= self._well_s:
            self._slow_deaths = 0
        elif worked_s >= FAILING[-1][1]:
            self._slow_deaths += 1
        return True

    def failing(self, now_s: float) -> bool:
        """Whether the last processes, and the present one so far, worked for too short a time."""
        present_s = 0.0 if self._began_s is None else now_s - self._began_s
        if self._slow_deaths >= self._intensity and present_s < self._well_s:
            return True
        worked_s = [*self._worked_s, present_s]
        return any(len(worked_s) > count and max(worked_s[-count - 1:]) < least_s
                   for count, least_s in FAILING)


def _doubled(first_s: float, times: int, most_s: float) -> float:
    return min(first_s * 2.0 ** min(times, _MOST_DOUBLINGS), most_s)


@dataclass(slots=True)
class SupervisedProcess:
    """One process of the run. Times are wall seconds of the caller's clock.

    Attributes:
        unit: The nodes that run in it.
        state: Its state.
        shown: The published state: while `RESTARTING`, the state before.
        incarnation: Of the present process.
        highest: The highest incarnation so far.
        requested_by: The module that requested the process, until its first heartbeat.
        is_requested: Whether a request to the root has no answer yet.
        stays: Whether the process lives and is to restart its program, which has ended.
        unstable: Whether it is published as failing.
        delay_s: The wait before the restart that was granted last.
        due_s: When that restart is due, simulated seconds; 0 for at once.
        heard_s: When the last heartbeat of each node, and the last status of the manager, came.
        handle: The hold on the present process.
        next_step: The timer of a restart under way; there is never more than one.
    """

    unit: Unit
    policy: RestartPolicy
    patience: Patience
    state: State = State.CRASHED
    shown: NodeState = NodeState.CRASHED
    pid: int = 0
    incarnation: int = 0
    highest: int = 0
    requested_by: str = ""
    is_requested: bool = False
    stays: bool = False
    unstable: bool = False
    delay_s: float = 0.0
    due_s: float = 0.0
    started_s: float = 0.0
    heard_s: dict[str, float] = field(default_factory=dict)
    lives: Lives = field(default_factory=Lives)
    handle: ProcessHandle = field(default_factory=ProcessHandle)
    next_step: Timer | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its nodes."""
        return tuple(n.name for n in self.unit.nodes)

    @property
    def waits(self) -> bool:
        """Whether a restart is under way."""
        return self.state in _WAITING

    @property
    def is_dead(self) -> bool:
        """Whether the published state is that of a dead process."""
        return self.shown in (NodeState.CRASHED, NodeState.GIVEN_UP)

    def step(self, event: Event) -> Transition | None:
        """Change the state by an event; None if the event has no transition."""
        found = TRANSITIONS.get((self.state, event))
        if found is not None:
            self.state = found.state
            if self.state is not State.RESTARTING:
                self.shown = NodeState(self.state.value)
            elif self.shown in (NodeState.STARTING, NodeState.RUNNING):
                self.shown = NodeState.CRASHED
        return found

    def ask(self, now_s: float) -> tuple[Event, str]:
        """Request a restart; return the event that follows, and why it is not immediate."""
        if self.waits:
            return Event.RESTART, "an attempt will follow by itself"
        policy, failed = self.policy, self.policy.attempts
        delay_s = policy.delay_s(now_s)
        if delay_s is not None:
            self.delay_s = delay_s
            return Event.RESTART, ""
        self.delay_s = policy.attempt_in_s(now_s)
        why = f"attempt {failed} failed" if failed else (
            f"{policy.limits.intensity} restarts in {policy.limits.period_s:.0f} s")
        return Event.TOO_OFTEN, f"{why}, the next attempt is in {self.delay_s:.0f} s"

    def take(self, pid: int, incarnation: int) -> None:
        """Make another process the present one, and release the one before."""
        self.forget_step()
        self.release()
        self.pid, self.incarnation, self.heard_s, self.stays = pid, incarnation, {}, False
        self.lives.forked()
        self.highest = max(self.highest, incarnation)

    def release(self) -> None:
        """Release the process."""
        self.handle.close()
        self.handle = ProcessHandle()

    def kill(self) -> None:
        """Kill the process without a report, unless it stays and only its program is replaced."""
        if not self.stays:
            self.handle.ignore()
            self.handle.kill()

    def forget_step(self) -> None:
        """Cancel the next step of a restart."""
        if self.next_step is not None:
            self.next_step.cancel()

    def rows(self, late_s: Callable[[str], float], now_s: float) -> Iterator[NodeInfo]:
        """Return the rows of its nodes in the node table; `late_s` returns a node's lateness."""
        failing = self.lives.failing(now_s)
        due: dict[str, Any] = (
            {"next_attempt_s": self.due_s} if self.waits and self.due_s else {})
        for node in self.unit.nodes:
            yield NodeInfo(node.name, node.kind.value, self.pid, self.shown, self.incarnation,
                           restarts_of(self.incarnation), late_s(node.name), failing=failing, **due)

    def is_late(self, now_s: float, timeout_s: float) -> bool:
        """Whether a heartbeat is overdue."""
        return self.state is State.RUNNING and (
            now_s - min(self.heard_s.values(), default=now_s) > timeout_s / 2)

    def silence(self, now_s: float, timeout_s: float, used: Callable[[], Usage], *,
                many: bool = False) -> str:
        """Return in words what is missing although the process could have run; "" if nothing is.

        Args:
            now_s: Now.
            timeout_s: Of a heartbeat.
            used: Returns the usage of the process; called only if it matters.
            many: Whether many processes are late.
        """
        if self.state is State.STARTING:
            could_s = self._could_answer_s(now_s, self.started_s, START_TIMEOUT_S, used)
            return "no heartbeat after its start" if could_s > START_TIMEOUT_S else ""
        if self.state is not State.RUNNING:
            return ""
        since_s = min(self.heard_s.values(), default=now_s)
        could_s = self._could_answer_s(now_s, since_s, timeout_s, used)
        if could_s <= (max(timeout_s, MOST_EXCUSED_S) if many else timeout_s):
            return ""
        late = [name for name, at_s in self.heard_s.items() if now_s - at_s > timeout_s]
        if not late:
            return ""
        nodes = ", ".join(name for name in late if name != STATUS)
        return f"no heartbeat from {nodes}" if nodes else f"no {STATUS}"

    def _could_answer_s(self, now_s: float, since_s: float, limit_s: float,
                        used: Callable[[], Usage]) -> float:
        if now_s - since_s <= limit_s / 2:  # not worth a look into /proc
            self.patience.answered()
            return 0.0
        return self.patience.look(now_s, self.pid, used(), since_s)

    def excuse(self, now_s: float, stall_s: float) -> None:
        """Do not count as silence a time in which the supervisor could not receive."""
        self.started_s = min(now_s, self.started_s + stall_s)
        self.heard_s = {n: min(now_s, at_s + stall_s) for n, at_s in self.heard_s.items()}
