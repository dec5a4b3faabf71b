"""What viewers get to see: a run's own messages translated, channel by channel.

The messages are recorded as they are, whatever becomes of their translation here. A scene
has one channel per subject, and each message on it holds all of it: a viewer that jumps to a time
is given the last message of each channel before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import MANY
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.recording import foxglove as fg
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import decision_in_words

View = tuple[str, fg.Record]
"""Channel and what is to be seen on it."""

Shown = list[View]

Translator = Callable[[str, Header, Any, int], list[View]]
"""Makes views of key, header and body of a message, and the time of the recording."""


class Views:
    """Translates one run, message by message; an application may name a class derived from this.

    Class attributes:
        channels: all channels, with the type of their messages.

    Args:
        application: of the run; None if it cannot be had.
        system: of the run.

    Attributes:
        translators: what makes views of a topic's messages.
    """

    channels: ClassVar[Mapping[str, type[fg.Record]]] = {"view/log": fg.Log}

    def __init__(self, application: Application | None = None,
                 system: SystemSpec = NO_SYSTEM) -> None:
        del application
        self._titles = system.titles
        self._seen: dict[str, Any] = Remembered(MANY)
        self.translators: dict[Topic[Any], Translator] = {
            ftm_topics.DECISION: self._decision, ftm_topics.PROCESS_EVENT: self._process,
            bus_topics.DIAGNOSTIC: self._diagnostic, ftm_topics.DETECTION: self._detection,
            bus_topics.INJECTION_REPORT: self._injection}

    def start(self, at_ns: int) -> list[View]:
        """Return what does not depend on any message."""
        del at_ns
        return []

    def of(self, topic: Topic[Any], key: str, header: Header, body: Any, at_ns: int) -> list[View]:
        """Return what a message makes visible.

        Args:
            topic: which.
            key: full key.
            header: of the message.
            body: of the message.
            at_ns: time of the recording.
        """
        translate = self.translators.get(topic)
        return translate(key, header, body, at_ns) if translate else []

    # -- the log --------------------------------------------------------------------------------

    def _decision(self, key: str, header: Header, body: fm.DecisionRecord, at_ns: int) -> Shown:
        words = decision_in_words(body.active, body.rule, body.recoveries, body.strategy,
                                  self._titles)
        level = fg.LogLevel.WARNING if body.active else fg.LogLevel.INFO
        return self._event(key, header, at_ns, level, f"decision {body.decision}: {words}")

    def _process(self, key: str, header: Header, body: fm.ProcessEvent, at_ns: int) -> list[View]:
        if not body.news:
            return []
        level = fg.LogLevel.INFO if body.news == "clear" else fg.LogLevel.WARNING
        by = f" by {body.by}" if body.by else ""
        detail = f": {body.detail}" if body.detail else ""
        return self._event(key, header, at_ns, level, f"{body.node} {body.event}{by}{detail}")

    def _diagnostic(self, key: str, header: Header, body: bm.Diagnostic, at_ns: int) -> list[View]:
        return self._event(key, header, at_ns, fg.LogLevel.ERROR,
                           f"{body.context}: {body.reason} [{body.offender}]")

    def _detection(self, key: str, header: Header, body: fm.DetectionReport, at_ns: int) -> Shown:
        was = self._seen.get(key)
        if not self.is_new(key, body.state) or (
                was is None and body.state is fm.DetectionState.IDLE):
            return []
        active = body.state is fm.DetectionState.ACTIVE
        return [line(at_ns, fg.LogLevel.WARNING if active else fg.LogLevel.INFO, header.source,
                      f"detects: {body.reason}" if active else "is idle again")]

    def _injection(self, key: str, header: Header, body: bm.InjectionReport, at_ns: int) -> Shown:
        if not self.is_new(f"{key} {body.injection}", (body.affected > 0, body.finished)):
            return []
        what = "is over" if body.finished else "is in force"
        why = f": {body.reason}" if body.reason else ""
        return [line(at_ns, fg.LogLevel.WARNING, header.source,
                      f"injection {body.injection} {what}, {body.affected} affected{why}")]

    def _event(self, key: str, header: Header, at_ns: int, level: fg.LogLevel, text: str) -> Shown:
        """Return a line for a message that counts, once for all its copies."""
        if not self.is_new(key, (header.source, header.incarnation, header.sequence)):
            return []
        return [line(at_ns, level, header.source, text)]

    def is_new(self, what: str, value: Any) -> bool:
        """Take note of what was last said of something; tell whether it is another thing."""
        if what in self._seen and self._seen[what] == value:
            return False
        self._seen[what] = value
        return True


def line(at_ns: int, level: fg.LogLevel, name: str, text: str) -> View:
    """Return a line of the log."""
    return "view/log", fg.Log(fg.time_of(at_ns), level, text, name)


encode: Callable[[fg.Record], bytes] = msgspec.json.Encoder().encode
"""Returns what stands in the file."""
