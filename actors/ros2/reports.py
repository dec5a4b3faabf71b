"""`Diagnostics`, `ActionResult`, `LogMatch`: detections of errors that nodes of ROS 2 report.

A row `[[ros2]]` without `fields` passes the reports on. With `publishers = "any"` each message
counts. By default the newest message replaces a waiting one, as of a sensor.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import msgspec

from rampart.actors.bus.fields import NUMBER, TEXT, Field
from rampart.actors.bus.topic import Topic
from rampart.actors.detection.finding import Recurrent, Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ros2.links import ENDS
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import Suspects, TopicHeard
from rampart.files.plain_text import one_line
from rampart.manager.spec.tables import NonNegative, Positive

Pattern = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
"""A name with the wild cards of file names: `*`, `?`, `[abc]`."""

_LEVELS = ("ok", "warn", "error", "stale")
_SEVERITIES = {"debug": 10, "info": 20, "warn": 30, "error": 40, "fatal": 50}
"""Constants of DiagnosticStatus and Log."""

_MOST = 1000
"""Most statuses or goals whose state is remembered."""


def _check(topic: Topic[Any], kind: str, fields: Mapping[str, str]) -> None:
    """Raise ValueError for a topic whose messages lack a field of a type of ROS 2."""
    for path, wanted in fields.items():
        try:
            found = Field(topic.type, path).kind
        except ValueError as error:
            raise ValueError(f"parameters.topic: {topic.key}: expected {kind}: {error}") from None
        if found != wanted:
            raise ValueError(f"parameters.topic: {topic.key}: expected {kind}: {path} is a {found}")


class StatusMonitor(Sustained):
    """Active while a status is bad, too old or absent. Times are simulated seconds.

    A status that was there once must keep coming.

    Args:
        pattern: Of names of statuses.
        level: Least level that is bad.
        stale_s: Greatest age of a status.
        for_s: How long an error has to last.
        clear_s: How long its absence has to last.
        start_s: Present time.
        grace_s: How long the first status may take.
        known: Whether to report idle before any input.
    """

    def __init__(self, pattern: str, level: int, stale_s: float, *, for_s: float = 0.0,
                 clear_s: float = 0.0, start_s: float = 0.0, grace_s: float = 0.0,
                 known: bool = True) -> None:
        super().__init__(for_s, clear_s, -math.inf if known else start_s + grace_s)
        self._pattern, self._fits = pattern, re.compile(fnmatch.translate(pattern)).match
        self._level, self._stale_s = level, stale_s
        self._absent_s = self._next_s = start_s + grace_s
        self._statuses: dict[str, tuple[int, str, float]] = {}
        self._named: tuple[int, str] | None = None

    @property
    def due_s(self) -> float:
        """When a status is too old, or an error has lasted."""
        return min(super().due_s, self._next_s)

    def heard(self, statuses: Iterable[tuple[str, int, str]], stamp_s: float, now_s: float) -> None:
        """Note statuses: name, level and message of each, and the time at which they were true."""
        for name, level, message in statuses:
            if self._fits(name) and (name in self._statuses or len(self._statuses) <= _MOST):
                self._statuses[name] = level, message, min(stamp_s, now_s)
        self.expire(now_s)

    def expire(self, now_s: float) -> None:
        """Conclude from the newest statuses and the time."""
        ends_s = [self._absent_s, *(
            at_s + self._stale_s for _, _, at_s in self._statuses.values())]
        self._next_s = min((end_s for end_s in ends_s if end_s > now_s), default=math.inf)
        level, name, why = max((self._finding(name, now_s) for name in self._statuses),
                           key=lambda found: found[0], default=(0, "", ""))
        why = one_line(why)
        if len(self._statuses) > _MOST:
            why = f"more than {_MOST} statuses match {self._pattern!r}"
        elif not self._statuses and now_s >= self._absent_s:
            why = f"no status matches {self._pattern!r}"
        # A restarted module has not received all publishers' statuses before `_absent_s`.
        if why or self.known or now_s >= self._absent_s:
            self.note(why, now_s)
        if why and self.active and (level, name) != self._named:  # its text may change each time
            self.reason = why
        self._named = (level, name) if self.active else None

    def _finding(self, name: str, now_s: float) -> tuple[int, str, str]:
        """Return how bad a status is, its name, and what is wrong with it, or ""."""
        level, message, at_s = self._statuses[name]
        if now_s >= at_s + self._stale_s:
            return len(_LEVELS), name, f"{name}: no status for {self._stale_s:g} s"
        word = _LEVELS[level] if level < len(_LEVELS) else f"level {level}"
        return level, name, f"{name}: {word}: {message}" if level >= self._level else ""


class Diagnostics(DetectionModule):
    """Active while a status of a DiagnosticArray is bad, too old or absent."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Statuses, and what is wrong with them.

        Attributes:
            topic: key of the topic that a table fills from `/diagnostics`.
            status: names of the statuses, with the wild cards of file names.
            level: least level that is an error.
            stale_s: greatest age of each status, s; also how long the first may take.
            for_s: how long an error has to last, s.
            clear_s: how long there has to be no error before the module is idle again, s.
            suspects: nodes to be respawned while it is active; none by default.
        """

        topic: TopicHeard
        status: Pattern
        level: Literal["warn", "error", "stale"] = "error"
        stale_s: Positive = 5.0
        for_s: NonNegative = 0.0
        clear_s: NonNegative = 0.2
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self.monitor = self.judged_by(StatusMonitor(
            given.status, _LEVELS.index(given.level), given.stale_s, for_s=given.for_s,
            clear_s=given.clear_s, start_s=self.clock.now(), grace_s=self.grace_s(given.stale_s),
            known=self.first_life))
        self.monitor.accused = given.suspects
        self.hear_topic(given.topic, self.heard)

    @classmethod
    def check_topics(cls, parameters: Parameters, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse a topic of other messages."""
        _check(topics[parameters.topic], "diagnostic_msgs/msg/DiagnosticArray", {
            "status[0].name": TEXT, "status[0].level": NUMBER, "status[0].message": TEXT})

    def heard(self, message: Any, header: Header) -> None:
        """Note statuses."""
        self.note_absence()
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(((one.name, one.level, one.message) for one in message.status),
                           header.stamp, self.clock.now())
        self.follow()


class _Counting(DetectionModule):
    """Active when enough events have been reported within a time."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Topic and number of events.

        Attributes:
            topic: key of the topic.
            count: how many events make the module active.
            within_s: within how long, s.
            clear_s: how long without an event until it is idle again, s.
            suspects: nodes to be respawned while it is active; none by default.
        """

        topic: TopicHeard
        count: Annotated[int, msgspec.Meta(ge=1, le=_MOST)] = 1
        within_s: Positive = 10.0
        clear_s: Positive = 1.0
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self.monitor = self.judged_by(Recurrent(
            given.count, given.within_s, given.clear_s, self.known_after_s(given.clear_s)))
        self.hear_topic(given.topic, self.heard)

    def heard(self, message: Any, header: Header) -> None:
        """Count the events in a message."""
        self.note_absence()
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        for what in self._events(message):
            self.monitor.happened(one_line(what), self.clock.now())
        self.follow()

    def _events(self, message: Any) -> Iterable[str]:
        raise NotImplementedError


class ActionResult(_Counting):
    """Active when goals of an action have ended badly.

    Of the first GoalStatusArray only the newest goal counts, since servers keep results for
    minutes.
    """

    class Parameters(_Counting.Parameters, frozen=True, kw_only=True):
        """Bad results.

        Attributes:
            results: results that count.
        """

        results: Annotated[tuple[Literal[
            "aborted", "rejected", "unanswered", "cancelled", "succeeded"], ...], msgspec.Meta(
                min_length=1)] = ("aborted", "rejected", "unanswered")

    parameters: Parameters
    _counted: Counter[tuple[int, int]] | None = None

    @classmethod
    def check_topics(cls, parameters: Parameters, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse a topic of other messages."""
        topic = topics[parameters.topic]
        if "phase" in topic.type.__struct_fields__:
            _check(topic, "the state of a goal", {"phase": TEXT, "number": NUMBER, "why": TEXT})
        else:
            _check(topic, "the state of a goal, or action_msgs/msg/GoalStatusArray", {
                "status_list[0].status": NUMBER, "status_list[0].goal_info.stamp.sec": NUMBER})

    def _events(self, message: Any) -> Iterable[str]:
        results = self.parameters.results
        if hasattr(message, "phase"):
            why = message.why and f": {message.why}"
            return [f"goal {message.number} {message.phase}{why}"
                    ] if message.phase in results else []
        # The gateway passes no ids of goals, so a goal is the time of its acceptance.
        goals = [((one.goal_info.stamp.sec, one.goal_info.stamp.nanosec),
                  ENDS.get(one.status, "")) for one in message.status_list]
        bad = Counter(goal for goal, result in goals if result in results)
        before = self._counted
        if before is None:
            newest = max(goals, default=((0, 0), ""))[0]
            before = Counter({goal: count for goal, count in bad.items() if goal != newest})
        self._counted = Counter(bad | before) if len(before) <= _MOST else bad
        result_of = dict(goals)
        return [f"a goal {result_of[goal]}" for goal in (bad - before).elements()]


class LogMatch(_Counting):
    """Active when nodes have logged certain texts."""

    class Parameters(_Counting.Parameters, frozen=True, kw_only=True):
        """Which messages count.

        Attributes:
            logger: names of loggers, as a rule of nodes, with the wild cards of file names.
            level: least severity.
            matches: regular expression that is found in the text.
        """

        logger: Pattern = "*"
        level: Literal["debug", "info", "warn", "error", "fatal"] = "error"
        matches: Annotated[str, msgspec.Meta(max_length=500)] = ""

        def __post_init__(self) -> None:
            """Refuse what is not a regular expression."""
            try:
                re.compile(self.matches)
            except (re.error, RecursionError, OverflowError) as error:
                raise ValueError(f"matches: not a regular expression: {error}") from None

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self._fits = re.compile(fnmatch.translate(given.logger)).match
        self._found_in = re.compile(given.matches).search

    @classmethod
    def check_topics(cls, parameters: Parameters, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse a topic of other messages."""
        _check(topics[parameters.topic], "rcl_interfaces/msg/Log",
               {"name": TEXT, "level": NUMBER, "msg": TEXT})

    def _events(self, message: Any) -> Iterable[str]:
        if (message.level >= _SEVERITIES[self.parameters.level] and self._fits(message.name)
                and self._found_in(message.msg)):
            return [f"{message.name}: {message.msg}"]
        return []
