"""DM4, DM5 and DM7: crash of a control node, a non-control node, the localization node.

Three failures, two signs. A process that dies takes its liveliness token with it: seen at once.
A process that is stopped, or whose loop hangs, keeps the token: only its heartbeat is missing.

Processes of a node are told apart by their incarnation. The end of one may be reported when the
next is already at work, and a heartbeat of the old one may arrive after the news of its end;
neither may be believed of the new one. Being back is proved by a heartbeat, not by a token: a
process that exists does not work yet.

A heartbeat that is overdue is a failure if the process could have sent it: time in which it waited
for a processor does not count (`rampart.actors.machine.patience`). If others are late as well it is
the machine, or the bus, and a process is blamed only if it stands still. Both up to twice the
timeout.
What a node publishes often anyway is a sign of life as well, and much sooner missed: three periods
of it are enough to find a loop that hangs (`rampart.actors.detection.loop_watch`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any

from rampart.actors.bus import messages as m
from rampart.actors.bus import topics
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.detection.loop_watch import LoopWatch
from rampart.actors.detection.module import DetectionModule, Waiting
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.machine.patience import AT_LEISURE, Patience, Standstill, Usage
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import HeartbeatTimeout, NodeNames, SignsOfLife
from rampart.manager.spec.budget import PERIODS_TO_MISS

LEAST_PERIOD_S = 0.02
"""Real seconds; by what comes more often a loop is judged as by what comes 50 times a second."""

_MOST_EXCUSED = 2
"""After so many timeouts a heartbeat has failed to come, whatever the process waited for."""

_ROUNDING_S = 1e-6

@dataclass(slots=True)
class _Watched:
    """What is known of a watched node: its newest incarnation and how that one is."""

    due_s: float
    loop: LoopWatch
    patience: Patience
    standstill: Standstill
    incarnation: int = 0
    pid: int = -1
    heard: bool = False
    heard_s: float = -math.inf
    gone_s: float | None = None
    failure: str = ""
    hangs: str = ""


_failure = attrgetter("failure")


class WatchdogCore:
    """Active while one of the nodes has failed; `nodes` names those.

    Args:
        nodes: the watched nodes.
        timeout_s: a node without a heartbeat for so long has failed, s.
        start_s: now.
        grace_s: how long the first heartbeat of a node may take, s.
        known: whether idle may be claimed before all nodes were heard.
        used: returns what a process has used; its times are in seconds of the same clock.
        least_period_s: see `LoopWatch`.
    """

    def __init__(self, nodes: Iterable[str], timeout_s: float, start_s: float, grace_s: float,
                 *, known: bool = True, used: Callable[[int], Usage] = lambda _pid: AT_LEISURE,
                 least_period_s: float = LEAST_PERIOD_S) -> None:
        self.timeout_s = timeout_s
        self._known = known
        self._used = used
        self._watched = {node: _Watched(start_s + grace_s, LoopWatch(least_period_s),
                                        Patience(timeout_s), Standstill())
                         for node in nodes}

    @property
    def active(self) -> bool:
        """Whether a node has failed."""
        return any(map(_failure, self._watched.values()))  # asked with every heartbeat

    @property
    def nodes(self) -> tuple[str, ...]:
        """The failed nodes; one whose last heartbeat is young with the incarnation that hangs."""
        return tuple(node + one.hangs for node, one in self._watched.items() if one.failure)

    @property
    def reason(self) -> str:
        """What happened to each failed node."""
        return "; ".join(
            f"{node}: {one.failure}" for node, one in self._watched.items() if one.failure)

    @property
    def known(self) -> bool:
        """Whether each node was heard, or missed."""
        return self._known or all(one.heard or one.failure for one in self._watched.values())

    @property
    def due_s(self) -> float:
        """When a heartbeat is overdue, or a silent process is to be looked at."""
        due_s = math.inf
        for one in self._watched.values():
            if not one.failure:
                due_s = min(due_s, one.due_s, one.loop.look_s)
        return due_s

    def beat(self, node: str, incarnation: int, stamp_s: float, now_s: float, pid: int = -1
             ) -> None:
        """Take note of a heartbeat sent at `stamp_s`, by a pid of this machine or -1."""
        one = self._watched.get(node)
        if one is None or incarnation < one.incarnation:
            return
        if incarnation > one.incarnation:
            self._succeed(one, incarnation)
        elif one.gone_s is not None and (
                stamp_s <= one.gone_s or not is_possible(stamp_s, now_s)):
            return  # sent before it died, and under way since; or at an impossible time
        one.gone_s = None
        one.heard, one.heard_s, one.pid = True, now_s, pid
        one.failure, one.hangs = "", ""
        one.patience.answered()
        one.standstill.begin()
        one.due_s = now_s + self.timeout_s / 2  # it is not worth a look before

    def sign(self, node: str, incarnation: int, period_s: float, now_s: float) -> None:
        """Take note of what a node that works publishes with a period."""
        one = self._watched.get(node)
        if one is not None and one.heard and incarnation == one.incarnation and not one.failure:
            one.loop.sign(period_s, now_s)

    def peer(self, node: str, incarnation: int, alive: bool, now_s: float) -> None:
        """Take note of a liveliness token that appears or vanishes."""
        one = self._watched.get(node)
        if one is None or incarnation < one.incarnation:
            return
        if alive:
            if incarnation > one.incarnation:
                first = one.incarnation == 0
                self._succeed(one, incarnation)
                if not first:  # at the very start the grace is longer, and still runs
                    one.due_s = now_s + self.timeout_s
            else:
                one.gone_s = None
            return
        if one.hangs != f"#{incarnation}":
            one.hangs = ""
        one.incarnation = incarnation
        one.gone_s = now_s
        one.failure = f"process of incarnation {incarnation} is gone"

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed without a heartbeat or a sign of life."""
        for one in self._watched.values():
            if one.failure:
                continue
            if now_s >= one.loop.look_s:
                self._look(one, now_s)
            if now_s >= one.due_s and not one.failure:
                self._miss(one, now_s)

    def _look(self, one: _Watched, now_s: float) -> None:
        """Look whether the loop of a process turns that gives no sign of life."""
        silent_s = now_s - one.loop.sign_s
        if silent_s > self.timeout_s:  # then it is up to the heartbeats
            one.loop.give_up()
        elif how := one.loop.look(now_s, self._used(one.pid)):
            one.failure, one.hangs = f"its loop hangs, {how}", f"#{one.incarnation}"
            one.gone_s = one.loop.sign_s  # a heartbeat from before may still be under way

    def _miss(self, one: _Watched, now_s: float) -> None:
        """Look whether a process could have sent the heartbeat that has not come."""
        if not one.heard:
            one.failure = "never heard"
            return
        used, half_s = self._used(one.pid), self.timeout_s / 2
        left_s = self.timeout_s - one.patience.look(now_s, one.pid, used, one.heard_s)
        stands = one.standstill.look(now_s, used, self.timeout_s / PERIODS_TO_MISS)
        if left_s <= _ROUNDING_S and not stands and self._others_late(one, now_s):
            left_s = half_s
        left_s = min(left_s, half_s, one.heard_s + _MOST_EXCUSED * self.timeout_s - now_s)
        if left_s <= _ROUNDING_S:
            one.failure = f"no heartbeat for {self.timeout_s:g} s"
        one.due_s = now_s + left_s

    def _others_late(self, one: _Watched, now_s: float) -> bool:
        return any(other.heard and not other.failure and now_s - other.heard_s > self.timeout_s / 2
                   for other in self._watched.values() if other is not one)

    @staticmethod
    def _succeed(one: _Watched, incarnation: int) -> None:
        """Expect the next process; a failure stays until its first heartbeat."""
        one.incarnation = incarnation
        one.gone_s = None
        one.heard = False
        one.loop.forget()
        one.patience.answered()
        one.standstill.begin()


class Watchdog(DetectionModule):
    """Active while one of the nodes it watches is dead, stopped or wedged."""

    class Parameters(Waiting, frozen=True, kw_only=True):
        """Whom it watches.

        Attributes:
            watch: names of the nodes.
            timeout_s: a node without a heartbeat for so long has failed, s.
            signs: topics that they publish by a timer, ten times a second or more often, as long
                as their loops turn: three periods without show that one hangs. One for a node is
                enough.
        """

        watch: NodeNames
        timeout_s: HeartbeatTimeout = 0.5
        signs: SignsOfLife = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        timeout_s = self.parameters.timeout_s
        self.monitor = self.judged_by(WatchdogCore(
            self.parameters.watch, timeout_s, self.clock.now(),
            self.grace_s(timeout_s), known=self.first_life, used=self._used,
            least_period_s=LEAST_PERIOD_S * self.clock.rate))
        for key in self.parameters.signs:
            topic = self.chosen_topic(key)
            self.hear_topic(key, partial(self._sign, 1.0 / topic.rate_hz))

    def _used(self, pid: int) -> Usage:
        """Return what a process has used, in simulated seconds."""
        used, rate = self.context.scheduled(pid), self.clock.rate
        return Usage(used.state, used.ran_s * rate, used.waited_s * rate)

    def _sign(self, period_s: float, _message: Any, header: Header) -> None:
        # The timer that is pending finds out what is due then; it need not be asked for each.
        self.monitor.sign(header.source, header.incarnation, period_s, self.clock.now())

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:  # noqa: ARG003
        """Hear the heartbeats of the watched nodes."""
        return parameters.watch

    @classmethod
    def watches(cls, name: str, parameters: Parameters) -> tuple[str, ...]:  # noqa: ARG003
        """Hear when processes of the watched nodes appear and vanish."""
        return parameters.watch

    def on_peer(self, node: str, incarnation: int, alive: bool) -> None:
        """See a process come or go: the fast path to a crash."""
        self.monitor.peer(node, incarnation, alive, self.clock.now())
        self.follow()

    @on(topics.HEARTBEAT)
    def heartbeat(self, message: m.Heartbeat, header: Header) -> None:
        """Hear that a loop turns."""
        self.monitor.beat(header.source, header.incarnation, header.stamp, self.clock.now(),
                          self.context.local_pid(header.source, message.pid))
        self.follow()
