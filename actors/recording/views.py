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
from rampart.actors.ftm.narrator import Level, Narrator
from rampart.actors.recording import foxglove as fg
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.manager.spec.schema import SystemSpec

View = tuple[str, fg.Record]
"""Channel and what is to be seen on it."""

LEVELS: Mapping[Level, fg.LogLevel] = {
    "fault": fg.LogLevel.WARNING, "clear": fg.LogLevel.INFO, "note": fg.LogLevel.ERROR}
"""A note is an error report of a node."""

_TOLD = (ftm_topics.DECISION, ftm_topics.PROCESS_EVENT, bus_topics.DIAGNOSTIC, ftm_topics.DETECTION,
         ftm_topics.MANAGER_STATUS, bus_topics.INJECT, bus_topics.INJECTION_REPORT)
_ONCE = (fm.ProcessEvent, bm.Diagnostic)
"""Events, of which a recording of several hosts may have copies."""

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
        self._narrator = Narrator(system.titles)
        self._seen: dict[str, Any] = Remembered(MANY)
        self.translators: dict[Topic[Any], Translator] = dict.fromkeys(_TOLD, self._log)

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

    def _log(self, key: str, header: Header, body: Any, at_ns: int) -> list[View]:
        """Return the lines for a message, once for all its copies."""
        if isinstance(body, _ONCE) and not self.is_new(
                key, (header.source, header.incarnation, header.sequence)):
            return []
        return [line(at_ns, LEVELS[told.level], header.source, told.text)
                for told in self._narrator.describe(body, header)]

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
