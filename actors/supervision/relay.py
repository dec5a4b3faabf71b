"""Messages that the supervisor passes on: it has a link to every node, and others have not.

The operator's page, which shows error reports and orders faults, thus needs one link only.
"""

from __future__ import annotations

from typing import Any, ClassVar

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.messages import Diagnostic, Injection, InjectionReport, Message
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Actor, Context, Header, on

PASSED_ON_PER_S = 200
"""Error reports, orders and results of injections that are passed on in a simulated second."""


_TARGETS: dict[type[Message], Topic[Any]] = {
    Diagnostic: topics.ERROR_REPORT, Injection: bus_topics.INJECT,
    InjectionReport: bus_topics.INJECTION_RESULT}


class Relay(Actor):
    """Passes error reports, orders of faults and their results on, unless there are too many.

    Attributes:
        passed_on: Lets so many messages a second pass.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = tuple(_TARGETS.values())

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.passed_on = RateLimit(PASSED_ON_PER_S)

    @on(bus_topics.INJECTION_REPORT)
    @on(bus_topics.INJECTION_REQUEST)
    @on(bus_topics.DIAGNOSTIC)
    def pass_on(self, message: Message, _header: Header) -> None:
        """Pass on an error report, a fault that the operator's page orders, or what came of it."""
        if self.passed_on.allows(self.clock.now()):
            self.publish(_TARGETS[type(message)], message)

    def report_left_out(self) -> None:
        """Say how many messages were not passed on."""
        left_out = self.passed_on.left_out(self.clock.now())
        if left_out:
            self.report_diagnostic(
                "passing on", f"{left_out} more messages were not passed on", self.name)
