"""A detection module that detects what it is told."""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Header, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.tables import Positive


class StubDetection(DetectionModule):
    """Active while it is told so on `stub/trigger` (`rampart inject trigger:NAME`).

    What it was told dies with its process: the next incarnation is idle from the start.
    """

    class Parameters(DetectionModule.Parameters, frozen=True):
        """For the analyses alone: it stands for a module that is not written yet.

        Attributes:
            watch: names of the nodes that it is to watch.
            timeout_s: within how long it is to detect, s.
            margin_m: distance at which it is to warn.
        """

        watch: NodeNames = ()
        timeout_s: Positive | None = None
        margin_m: Positive | None = None

    def on_start(self) -> None:
        """As a later incarnation, report at once that it has no order yet."""
        if not self.first_life:
            self.know_idle()

    @on(topics.STUB_TRIGGER)
    def trigger(self, message: m.StubTrigger, _header: Header) -> None:
        """Take the state that is asked for."""
        if message.name != self.name:
            return
        if message.active:
            self.activate(message.reason or "triggered by hand")
        else:
            self.know_idle()
