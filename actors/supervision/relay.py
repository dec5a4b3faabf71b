"""Messages that the supervisor passes on: it has a link to everybody, and others have not.

Who shows error reports and orders faults, as the operator's page does, thus needs one link only.
"""

from __future__ import annotations

from typing import Any, ClassVar

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.messages import Diagnostic, Injection, InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Actor, Context, Header, on

PASSED_ON_PER_S = 200
"""Error reports, orders and results of injections that are passed on in a simulated second."""


class Relay(Actor):
    """Passes error reports, orders of faults and their results on, unless there are too many."""

    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        topics.ERROR_REPORT, bus_topics.INJECT, bus_topics.INJECTION_RESULT)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._passed_on = RateLimit(PASSED_ON_PER_S)

    @on(bus_topics.DIAGNOSTIC)
    def diagnostic(self, message: Diagnostic, _header: Header) -> None:
        """Pass a node's error report on to those who show it."""
        if self._passed_on.allows(self.clock.now()):
            self.publish(topics.ERROR_REPORT, message)

    @on(bus_topics.INJECTION_REQUEST)
    def inject(self, message: Injection, _header: Header) -> None:
        """Order a fault for the operator's page; the nodes that publish the topic hear it."""
        if self._passed_on.allows(self.clock.now()):
            self.publish(bus_topics.INJECT, message)

    @on(bus_topics.INJECTION_REPORT)
    def injected(self, message: InjectionReport, _header: Header) -> None:
        """Pass on what came of a fault."""
        if self._passed_on.allows(self.clock.now()):
            self.publish(bus_topics.INJECTION_RESULT, message)

    def report_left_out(self) -> None:
        """Say how many messages were not passed on."""
        left_out = self._passed_on.left_out(self.clock.now())
        if left_out:
            self.report_diagnostic(
                "passing on", f"{left_out} more messages were not passed on", self.name)
