"""Hears, in the launcher's process of a host that is not the first, what its supervisor says."""

from __future__ import annotations

from collections.abc import Callable

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Actor, Context, Header, on


class HostObserver(Actor):
    """Passes on what the supervisor of its host says."""

    class Parameters(Actor.Parameters, frozen=True):
        """Whom it hears: the name of the supervisor."""

        supervisor: str = ""

    parameters: Parameters

    def __init__(self, context: Context,
                 event: Callable[[fm.ProcessEvent, float], None] = lambda _event, _stamp: None
                 ) -> None:
        super().__init__(context)
        self._event = event

    @on(topics.PROCESS_EVENT)
    def process_event(self, event: fm.ProcessEvent, header: Header) -> None:
        """Take what has happened to a process of this host."""
        if header.source == self.parameters.supervisor:
            self._event(event, header.stamp)
