"""A detection module that detects what it is told."""

from __future__ import annotations

from actors import messages as m
from actors import topics
from actors.detection.module import DetectionModule
from actors.messages import DetectionState
from actors.runtime.actor import Header, on


class StubDetection(DetectionModule):
    """Active while somebody says so on `stub/trigger` (`rampart trigger NAME`)."""

    @on(topics.STUB_TRIGGER)
    def trigger(self, message: m.StubTrigger, _header: Header) -> None:
        """Take the state that is asked for."""
        if message.name != self.name:
            return
        if message.active:
            self.activate(message.reason or "triggered by hand")
        elif self.state is DetectionState.ACTIVE:
            self.clear()
