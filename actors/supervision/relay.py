"""Messages that the supervisor passes on: it has a link to every node, and others have not.

The operator's page, which shows error reports and orders faults, thus needs one link only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Actor, Context, Header, on

PASSED_ON_PER_S = 200
"""Error reports, orders and results of injections that are passed on in a simulated second."""


def _passing_on(
        source: Topic[Any], target: Topic[Any]) -> Callable[[Relay, Message, Header], None]:
    @on(source)
    def pass_on(relay: Relay, message: Message, _header: Header) -> None:
        if relay.passed_on.allows(relay.clock.now()):
            relay.publish(target, message)

    return pass_on


class Relay(Actor):
    """Passes error reports, orders of faults and their results on, unless there are too many.

    Attributes:
        passed_on: Lets so many messages a second pass.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        topics.ERROR_REPORT, bus_topics.INJECT, bus_topics.INJECTION_RESULT)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.passed_on = RateLimit(PASSED_ON_PER_S)

    diagnostic = _passing_on(bus_topics.DIAGNOSTIC, topics.ERROR_REPORT)
    """A node's error report, to those who show it."""

    inject = _passing_on(bus_topics.INJECTION_REQUEST, bus_topics.INJECT)
    """A fault that the operator's page orders, to the nodes that publish the topic."""

    injected = _passing_on(bus_topics.INJECTION_REPORT, bus_topics.INJECTION_RESULT)
    """What came of a fault."""

    def report_left_out(self) -> None:
        """Say how many messages were not passed on."""
        left_out = self.passed_on.left_out(self.clock.now())
        if left_out:
            self.report_diagnostic(
                "passing on", f"{left_out} more messages were not passed on", self.name)
