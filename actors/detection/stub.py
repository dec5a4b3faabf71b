"""Stand-in for a detection module, which is set from outside."""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Header, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.tables import Positive


class StubDetection(DetectionModule):
    """Active as ordered on `stub/trigger` (`rampart inject trigger:NAME`).

    Its next incarnation has no order, and is idle from the start.
    """

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Parameters of the module that it stands for; only the analyses use them.

        Attributes:
            watch: names of the nodes that it will watch.
            timeout_s: within how long it will detect, s.
            margin_m: distance at which it will warn.
        """

        watch: NodeNames = ()
        timeout_s: Positive | None = None
        margin_m: Positive | None = None

    def on_start(self) -> None:
        """From the second incarnation on, report idle at once."""
        if not self.first_life:
            self.know_idle()

    @on(topics.STUB_TRIGGER)
    def trigger(self, message: m.StubTrigger, _header: Header) -> None:
        """Take the ordered state."""
        if message.name != self.name:
            return
        if message.active:
            self.activate(message.reason or "triggered by hand")
        else:
            self.know_idle()
