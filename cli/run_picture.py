"""The messages of a run: the newest of each topic, counts and rates.

`rampart top` and `rampart live metrics` use it.
"""

from __future__ import annotations

from collections import Counter, deque
from enum import StrEnum
from typing import Any

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator.processes import ProcessObserver
from rampart.actors.system.topics import declared_topics, own_topics
from rampart.cli import systems
from rampart.cli.output import warn
from rampart.cli.robot_lines import SILENT, RobotLines
from rampart.cli.session import Session

DECODED: tuple[Topic[Any], ...] = (
    ftm_topics.MANAGER_STATUS, ftm_topics.DETECTION, ftm_topics.RECOVERY, ftm_topics.DECISION,
    ftm_topics.NODES)
"""Topics that are decoded besides those of the robot's lines; others are only counted."""

STALE_S = 2.0
"""Simulated seconds without a message after which a state is silent."""

_USAGE_EVERY = 4
"""Samples for each look at /proc, whose clock ticks 100 times per second."""

_KEPT = 50
_SAMPLES = 13
_NAMES = 1024
_OTHERS = "others"


def _count(counter: Counter[str], name: str) -> None:
    """Count for a name, or for `others` beyond the greatest number of names."""
    counter[name if name in counter or len(counter) < _NAMES else _OTHERS] += 1


def _report(module: str, report: Any, busy: StrEnum, newest: dict[str, Any],
            total: Counter[str]) -> None:
    """Keep a module's newest report, and count it if the module has become busy."""
    before = newest.get(module)
    if report.state is busy and (before is None or before.state is not busy):
        _count(total, module)
    newest[module] = report


class RunPicture:
    """The messages of one run.

    Attributes:
        lines: the lines of the robot.
        messages: number of messages by topic key, as declared.
        detections: newest report of each detection module.
        recoveries: newest report of each recovery module.
        decisions: the last decisions, each with its stamp, newest last.
        decisions_total: number of decisions by strategy.
        detections_total: number of times that each module became active.
        recoveries_total: number of times that each recovery became activated.
    """

    def __init__(self, lines: RobotLines | None = None) -> None:
        self.lines = lines or RobotLines()
        self.messages: Counter[str] = Counter()
        self.detections: dict[str, m.DetectionReport] = Remembered(_NAMES)
        self.recoveries: dict[str, m.RecoveryReport] = Remembered(_NAMES)
        self.decisions: deque[tuple[float, m.DecisionRecord]] = deque(maxlen=_KEPT)
        self.decisions_total: Counter[str] = Counter()
        self.detections_total: Counter[str] = Counter()
        self.recoveries_total: Counter[str] = Counter()
        self._latest: dict[str, tuple[Any, float]] = {}
        self._samples: deque[tuple[float, Counter[str]]] = deque(maxlen=_SAMPLES)

    def count(self, topic: Topic[Any]) -> None:
        """Count a message that is not decoded."""
        self.messages[topic.key] += 1

    def heard(self, topic: Topic[Any], header: Header, body: Any, now_s: float) -> None:
        """Take a decoded message that arrived at a simulated time."""
        self.messages[topic.key] += 1
        if topic is ftm_topics.DETECTION:
            _report(header.source, body, m.DetectionState.ACTIVE, self.detections,
                    self.detections_total)
        elif topic is ftm_topics.RECOVERY:
            _report(header.source, body, m.RecoveryState.ACTIVATED, self.recoveries,
                    self.recoveries_total)
        elif topic is ftm_topics.DECISION:
            self.decisions.append((header.stamp, body))
            _count(self.decisions_total, body.strategy)
        else:
            self._latest[topic.key] = (body, now_s)

    def latest(self, topic: Topic[Any]) -> Any:
        """Return the newest message of a topic, None without any."""
        found = self._latest.get(topic.key)
        return found[0] if found else None

    def silence_s(self, topic: Topic[Any], now_s: float) -> float:
        """Return for how many simulated seconds a state has been silent; 0 below `STALE_S`."""
        found = self._latest.get(topic.key)
        silent_s = now_s - found[1] if found else 0.0
        return silent_s if silent_s > STALE_S else 0.0

    def sample(self, now_s: float) -> None:
        """Note the counts of now; `rates` compares them."""
        self._samples.append((now_s, self.messages.copy()))

    def rates(self) -> dict[str, float]:
        """Return messages a simulated second by topic key, a family's members together."""
        if len(self._samples) < 2:
            return {}
        (first_s, first), (last_s, last) = self._samples[0], self._samples[-1]
        if last_s <= first_s:
            return {}
        return {key: (last[key] - first[key]) / (last_s - first_s) for key in sorted(last)}


def manager_in_words(status: m.ManagerStatus | None) -> str:
    """Return the state of the FTM Manager in words."""
    if status is None:
        return SILENT
    parts = [f"{status.strategy}, decision {status.decision}"]
    parts += [f"{word} {', '.join(names)}" for word, names in (
        ("ACTIVE", status.active), ("recovery", status.activated),
        ("latched", status.latched), ("silent", status.silent)) if names]
    if len(parts) == 1:
        parts.append("nothing active")
    return "; ".join(parts)


def draw(session: Session, picture: RunPicture) -> None:
    """Keep all messages of a session in a picture, with the lines of its robot."""
    clock = session.clock

    def subscribe(topic: Topic[Any]) -> None:
        if topic in (*DECODED, *picture.lines.read):
            session.listen(topic, lambda _key, header, body: picture.heard(
                topic, header, body, clock.now()))
        else:
            session.overhear(topic, lambda _key, _load: picture.count(topic))

    known: tuple[Topic[Any], ...] = topics.ALL
    try:
        spec = systems.load(session.run.system_file)
        picture.lines = systems.lines_of(spec)
        known = declared_topics(spec)
        known += own_topics(spec)
    except ValueError as error:  # for example a run from another folder
        warn(f"{error}; only topics of the engine are counted")
    for topic in known:
        subscribe(topic)


class Watch:
    """Messages and processor use of one run.

    Attributes:
        session: the connection to the run.
        picture: the messages.
        used: last result of `ProcessObserver.look`; empty for a replay, whose process numbers may
            belong to other processes today.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.picture = RunPicture()
        self.used: dict[str, Any] = {"nodes": {}, "guards": ()}
        self._processes = ProcessObserver(
            session.run.base_port, session.run.pid, session.run.host)
        self._looks = 0
        draw(session, self.picture)

    def look(self) -> float:
        """Take a sample, look at the processes if due, and return the simulated time."""
        now_s = self.session.clock.now()
        self.picture.sample(now_s)
        table = self.picture.latest(topics.NODES)
        if table is not None and not self.session.run.replay_of:
            if self._looks % _USAGE_EVERY == 0:
                self.used = self._processes.look(table)
            self._looks += 1
        return now_s
