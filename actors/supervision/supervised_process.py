"""A process under supervision: its states, what moves it between them, what is then to be done.

`TRANSITIONS` is the whole of it; what is not in the table changes nothing. Time is an argument, and
the actions are carried out by `rampart.actors.supervision.supervisor`.

How often it may be restarted is OTP's restart intensity, with backoff; the numbers are those of
`[supervision]` in the system spec. Up to half of `intensity` restarts within `period_s` happen at
once; beyond that each waits longer, doubling from `backoff_s`; one more than `intensity` and the
policy gives up. What has crashed so often may yet be well again later, when a disk has room or a
device is plugged in. So giving up is no end: single attempts follow, further and further apart, and
only if one of them lasts for a whole period is the process as good as any other again. Until then
it is not hidden: a silent detection module counts as active, a silent manager stops the Safety
Pilot, a silent Safety Pilot trips the dead man.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

from rampart.actors.bus.run_folder import restarts_of
from rampart.actors.ftm.messages import NodeInfo, NodeState
from rampart.actors.machine.patience import Patience, Usage
from rampart.actors.runtime.timer import Timer
from rampart.actors.supervision.processes import ProcessHandle
from rampart.actors.system.layout import Unit
from rampart.manager.spec.tables import Supervision

START_TIMEOUT_S = 3.0
"""Wall seconds in which a new process must have sent its first heartbeat."""

MANY, MANY_SHARE = 2, 1 / 8
"""When the heartbeats of so many processes are missing it is the machine, or the bus."""

MOST_EXCUSED_S = 3.0
"""Wall seconds that a process could have run after which it is blamed though many are silent."""

STATUS = "fresh status of the manager"
"""Stands among the names of a process' nodes for what the Safety Pilot depends on."""

_USUAL = Supervision()
_MOST_DOUBLINGS = 60
"""Beyond which no wait doubles; far longer than any is allowed to be."""


class State(Enum):
    """What a process is doing; all but `RESTARTING` are told to others, as `NodeState`."""

    STARTING = "starting"
    """It was forked and was not heard yet."""
    RUNNING = "running"
    STOPPED = "stopped"
    WEDGED = "wedged"
    CRASHED = "crashed"
    """It has ended, or there was none yet, and no other one was asked for."""
    RESTARTING = "restarting"
    """It was killed if it was there, and another one is forked as soon as it is gone."""
    GIVEN_UP = "given up"
    """Like `RESTARTING`, much later."""


class Event(Enum):
    """What happens to a process."""

    HEARD = auto()
    SILENT = auto()
    """It is not heard although it could be."""
    SILENT_STOPPED = auto()
    """Likewise, and the kernel says that it is stopped."""
    ENDED = auto()
    START = auto()
    """The run begins, or the supervisor does and finds no process."""
    RESTART = auto()
    """Another process is wanted in its place, and may be had."""
    TOO_OFTEN = auto()
    """Likewise, but there were too many already."""
    STARTED = auto()
    """Its first process was forked."""
    FORKED = auto()
    """Another process was forked."""
    ADOPTED = auto()
    """A process was found when the supervisor began."""
    ADAPTED = auto()
    """It is to run by other parameters from now on."""


class Action(Enum):
    """What is to be done about it."""

    TELL = auto()
    """Publish the transition's word."""
    PUBLISH = auto()
    """Publish the table of all nodes."""
    RECOVER = auto()
    """Ask for a restart, if it is the supervisor's to ask."""
    KILL = auto()
    """End what is left of the process."""
    FORK = auto()
    """Fork another one now."""
    FORK_WHEN_GONE = auto()
    """Likewise after `delay_s`, and not before the old process is gone."""
    HOLD = auto()
    """Watch for its end."""


class Transition(NamedTuple):
    """Where an event leads, the word for it, and what is to be done, in this sequence.

    An action may cause a transition itself; then those after it are left out.
    """

    state: State
    word: str = ""
    actions: tuple[Action, ...] = ()


_A, _E, _S = Action, Event, State
_PRESENT = (_S.STARTING, _S.RUNNING, _S.STOPPED, _S.WEDGED)
_WAITING = (_S.RESTARTING, _S.GIVEN_UP)
_SAID = (_A.TELL, _A.PUBLISH)
_LOST = (_A.TELL, _A.PUBLISH, _A.RECOVER)
_NEW = (_A.TELL, _A.PUBLISH, _A.HOLD)
_OVER = (_A.KILL, _A.TELL, _A.PUBLISH, _A.FORK_WHEN_GONE)

_ROWS: tuple[tuple[Iterable[State], Event, Transition], ...] = (
    ((_S.STARTING,), _E.HEARD, Transition(_S.RUNNING, "running", _SAID)),
    ((_S.STOPPED, _S.WEDGED), _E.HEARD, Transition(_S.RUNNING, "resumed", _SAID)),
    ((_S.STARTING, _S.RUNNING), _E.SILENT, Transition(_S.WEDGED, "wedged", _LOST)),
    ((_S.RUNNING,), _E.SILENT_STOPPED, Transition(_S.STOPPED, "stopped", _LOST)),
    (_PRESENT, _E.ENDED, Transition(_S.CRASHED, "crashed", _LOST)),
    ((_S.CRASHED,), _E.START, Transition(_S.RESTARTING, "", (_A.FORK,))),
    ((*_PRESENT, _S.CRASHED), _E.RESTART, Transition(
        _S.RESTARTING, "", (_A.KILL, _A.FORK_WHEN_GONE))),
    ((_S.GIVEN_UP,), _E.RESTART, Transition(_S.GIVEN_UP, "given up", (_A.TELL,))),
    ((*_PRESENT, _S.CRASHED), _E.TOO_OFTEN, Transition(_S.GIVEN_UP, "given up", _OVER)),
    ((_S.RESTARTING,), _E.STARTED, Transition(_S.STARTING, "started", _NEW)),
    (_WAITING, _E.FORKED, Transition(_S.STARTING, "respawned", _NEW)),
    ((_S.CRASHED,), _E.ADOPTED, Transition(_S.RUNNING, "adopted", (_A.TELL, _A.HOLD))),
    ((_S.GIVEN_UP,), _E.ADAPTED, Transition(_S.CRASHED)))

TRANSITIONS = {(state, event): then for states, event, then in _ROWS for state in states}


@dataclass(slots=True)
class RestartPolicy:
    """Sliding window of restarts of one process. Times are in seconds of the caller's clock.

    Attributes:
        limits: Of the system spec.
        attempts: Single ones since it gave up; 0 while it has not.
    """

    limits: Supervision = _USUAL
    attempts: int = 0
    _restarts: deque[float] = field(default_factory=deque)

    @property
    def spent(self) -> str:
        """What it allows, in words."""
        return f"{self.limits.intensity} restarts in {self.limits.period_s:.0f} s"

    def delay_s(self, now_s: float) -> float | None:
        """Return how long to wait before the next restart, or None to give up."""
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
        """Return how long to wait before the next attempt of what was given up.

        Until the window has room for it, and longer after each that failed.
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
"""So many processes of a node in a row, none of which worked for so many wall seconds, are no
accident, and no single fault."""


class Lives:
    """How long the last processes of a node worked. Pure; times are seconds of the caller's clock.

    A process works from its first heartbeat on; one that is never heard does not.
    """

    def __init__(self) -> None:
        self._began_s: float | None = None
        self._worked_s: deque[float] = deque(maxlen=max(count for count, _ in FAILING))

    def forked(self) -> None:
        """Note that there is a process."""
        self._began_s = math.inf

    def heard(self, now_s: float) -> None:
        """Note a heartbeat of it."""
        if self._began_s == math.inf:
            self._began_s = now_s

    def ended(self, now_s: float) -> None:
        """Note that it ended, or is ended; harmless when repeated."""
        if self._began_s is not None:
            self._worked_s.append(max(0.0, now_s - self._began_s))
            self._began_s = None

    def failing(self, now_s: float) -> bool:
        """Whether the last ones worked too short a time, and the present one has not for longer."""
        present_s = 0.0 if self._began_s is None else now_s - self._began_s
        worked_s = [*self._worked_s, present_s]
        return any(len(worked_s) > count and max(worked_s[-count - 1:]) < least_s
                   for count, least_s in FAILING)


def _doubled(first_s: float, times: int, most_s: float) -> float:
    return min(first_s * 2.0 ** min(times, _MOST_DOUBLINGS), most_s)


@dataclass(slots=True)
class SupervisedProcess:
    """One process of the run. Times are wall seconds of the caller's clock.

    Attributes:
        unit: What runs in it.
        state: What it is doing.
        shown: What others are told of that: of a `RESTARTING` one, what it was before.
        incarnation: Of the present process.
        highest: The highest incarnation that there was.
        requested_by: The module that asked for it, until it was heard.
        asks: Whether a process was asked for and there is no answer yet.
        stays: Whether it is there and starts its program again, which has ended.
        delay_s: How long to wait before the fork that was granted last.
        heard_s: When each of its nodes was last heard, and the manager's status.
        handle: On the process that is there.
        next_step: Towards its fork, while that is under way; there is never more than one.
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
    asks: bool = False
    stays: bool = False
    delay_s: float = 0.0
    started_s: float = 0.0
    heard_s: dict[str, float] = field(default_factory=dict)
    lives: Lives = field(default_factory=Lives)
    handle: ProcessHandle = field(default_factory=ProcessHandle)
    next_step: Timer | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The actors in it."""
        return tuple(n.name for n in self.unit.nodes)

    @property
    def waits(self) -> bool:
        """Whether a fork is under way."""
        return self.state in _WAITING

    @property
    def is_dead(self) -> bool:
        """Whether others are told that there is none."""
        return self.shown in (NodeState.CRASHED, NodeState.GIVEN_UP)

    def step(self, event: Event) -> Transition | None:
        """Change the state as an event demands; None if there is no transition for it."""
        found = TRANSITIONS.get((self.state, event))
        if found is not None:
            self.state = found.state
            if self.state is not State.RESTARTING:
                self.shown = NodeState(self.state.value)
            elif self.shown in (NodeState.STARTING, NodeState.RUNNING):
                self.shown = NodeState.CRASHED
        return found

    def ask(self, now_s: float) -> tuple[Event, str]:
        """Ask for a restart: return what comes of it, and in words why nothing does so far."""
        if self.waits:
            return Event.RESTART, "an attempt will follow by itself"
        policy, failed = self.policy, self.policy.attempts
        delay_s = policy.delay_s(now_s)
        if delay_s is not None:
            self.delay_s = delay_s
            return Event.RESTART, ""
        self.delay_s = policy.attempt_in_s(now_s)
        why = f"attempt {failed} failed" if failed else policy.spent
        return Event.TOO_OFTEN, f"{why}, the next attempt is in {self.delay_s:.0f} s"

    def take(self, pid: int, incarnation: int) -> None:
        """Note that another process is the present one, and let go of the one before."""
        self.forget_step()
        self.let_go()
        self.pid, self.incarnation, self.heard_s, self.stays = pid, incarnation, {}, False
        self.lives.forked()
        self.highest = max(self.highest, incarnation)

    def let_go(self) -> None:
        """Hold nothing."""
        self.handle.close()
        self.handle = ProcessHandle()

    def kill(self) -> None:
        """End it at once, and do not report that; not if only its program has to be replaced."""
        if not self.stays:
            self.handle.ignore()
            self.handle.kill()

    def forget_step(self) -> None:
        """Have the next step towards a fork not taken."""
        if self.next_step is not None:
            self.next_step.cancel()

    def rows(self, late_s: Callable[[str], float], now_s: float) -> Iterator[NodeInfo]:
        """Return the rows of its nodes in the table of all; `late_s` says how late one was."""
        failing = self.lives.failing(now_s)
        for node in self.unit.nodes:
            yield NodeInfo(node.name, node.kind.value, self.pid, self.shown, self.incarnation,
                           restarts_of(self.incarnation), late_s(node.name), failing=failing)

    def is_late(self, now_s: float, timeout_s: float) -> bool:
        """Whether a heartbeat of it is missing."""
        return self.state is State.RUNNING and (
            now_s - min(self.heard_s.values(), default=now_s) > timeout_s / 2)

    def silence(self, now_s: float, timeout_s: float, used: Callable[[], Usage], *,
                many: bool = False) -> str:
        """Return in words what was not heard of it for too long although it could; "" if nothing.

        Args:
            now_s: Now.
            timeout_s: Of a heartbeat.
            used: Returns what the process has used; asked only if that matters.
            many: Whether many are late.
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
        """Do not count as silence what the supervisor could not have heard."""
        self.started_s = min(now_s, self.started_s + stall_s)
        self.heard_s = {n: min(now_s, at_s + stall_s) for n, at_s in self.heard_s.items()}
