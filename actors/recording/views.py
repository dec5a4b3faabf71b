"""Translation of a run's messages for viewers, channel by channel.

The messages themselves are recorded even if their translation fails. A scene has one channel per
subject, and each message on it is complete: a viewer that jumps to a time receives the last message
of each channel before it.
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
from rampart.actors.ftm.narrator import Level, Narrator
from rampart.actors.recording import foxglove as fg
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.manager.spec.schema import SystemSpec

View = tuple[str, fg.Record]
"""Channel and message."""

LEVELS: Mapping[Level, fg.LogLevel] = {
    "fault": fg.LogLevel.WARNING, "clear": fg.LogLevel.INFO, "note": fg.LogLevel.ERROR}
"""A note is an error report of a node."""

_LOGGED = (
    ftm_topics.DECISION, ftm_topics.PROCESS_EVENT, bus_topics.DIAGNOSTIC, ftm_topics.DETECTION,
    ftm_topics.MANAGER_STATUS, bus_topics.INJECT, bus_topics.INJECTION_REPORT)
_ONCE = (fm.ProcessEvent, bm.Diagnostic)
"""Events of which a recording of several hosts may have copies."""

Translator = Callable[[str, Header, Any, int], list[View]]
"""Returns the views of a message from its key, header, body and time in the recording."""


class Views:
    """Translates the messages of a run; an application may name a derived class.

    Class attributes:
        channels: all channels, with the type of their messages.

    Args:
        application: of the run; None if it cannot be loaded.
        system: of the run.

    Attributes:
        translators: topic → function that translates its messages.
    """

    channels: ClassVar[Mapping[str, type[fg.Record]]] = {"view/log": fg.Log}

    def __init__(self, application: Application | None = None,
                 system: SystemSpec = NO_SYSTEM) -> None:
        del application
        self._narrator = Narrator(system.titles)
        self._seen: dict[str, Any] = Remembered(MANY)
        self.translators: dict[Topic[Any], Translator] = dict.fromkeys(_LOGGED, self._log)

    def start(self, at_ns: int) -> list[View]:
        """Return the views at the beginning of the recording."""
        del at_ns
        return []

    def of(self, topic: Topic[Any], key: str, header: Header, body: Any, at_ns: int) -> list[View]:
        """Return the views of a message.

        Args:
            topic: of the message.
            key: full key.
            header: of the message.
            body: of the message.
            at_ns: time in the recording.
        """
        translate = self.translators.get(topic)
        return translate(key, header, body, at_ns) if translate else []

    # -- the log --------------------------------------------------------------------------------

    def _log(self, key: str, header: Header, body: Any, at_ns: int) -> list[View]:
        """Return the lines of a message, once for all its copies."""
        if isinstance(body, _ONCE) and not self.is_new(
                key, (header.source, header.incarnation, header.sequence)):
            return []
        return [line(at_ns, LEVELS[found.level], header.source, found.text)
                for found in self._narrator.describe(body, header)]

    def is_new(self, what: str, value: Any) -> bool:
        """Keep the latest value under a name; return whether it has changed."""
        if what in self._seen and self._seen[what] == value:
            return False
        self._seen[what] = value
        return True


def line(at_ns: int, level: fg.LogLevel, name: str, text: str) -> View:
    """Return a line of the log."""
    return "view/log", fg.Log(fg.time_of(at_ns), level, text, name)


encode: Callable[[fg.Record], bytes] = msgspec.json.Encoder().encode
"""Returns a view as JSON."""
