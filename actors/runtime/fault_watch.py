"""A fault as ordered, and what the nodes report of it until it is over or had no effect. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rampart.actors.bus.bounds import MANY
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.topic import Topic

FIRST_EFFECT_S = 10.0
"""Simulated seconds within which a permanent fault must change a message."""


@dataclass(frozen=True, slots=True)
class Order:
    """A message to send, and where: an injection, or a fault of another kind.

    The message has the fields `injection`, by which it is reported on, and `duration_s`.
    """

    topic: Topic[Any]
    message: Any

    def with_(self, **changed: Any) -> Order:
        """Return the order with other fields."""
        return Order(self.topic, msgspec.structs.replace(self.message, **changed))

    @property
    def injection(self) -> str:
        """Its id."""
        return str(self.message.injection)

    @property
    def place(self) -> str:
        """What is disturbed: a topic's key, or that on which another fault is ordered."""
        return str(getattr(self.message, "topic", self.topic.key))


@dataclass(slots=True)
class FaultWatch:
    """The orders that make up a fault, and the reports on them.

    Attributes:
        orders: all of one fault, with the same duration.
        reports: the last report on an injection of each incarnation of a node; counts never fall.
    """

    orders: Sequence[Order]
    reports: dict[tuple[str, str, int], InjectionReport] = field(
        default_factory=lambda: Remembered(MANY))

    def hear(self, report: InjectionReport, incarnation: int = 0) -> bool:
        """Take a report and return whether it is on this fault.

        Args:
            report: of a node.
            incarnation: of that node; a restarted one counts anew.
        """
        if report.injection not in {order.injection for order in self.orders}:
            return False
        slot = report.injection, report.node, incarnation
        before = self.reports.get(slot)
        if before is not None:
            report = msgspec.structs.replace(
                report, affected=max(before.affected, report.affected),
                reason=before.reason or report.reason)
        self.reports[slot] = report
        return True

    @property
    def is_permanent(self) -> bool:
        """Whether it lasts as long as what it hits."""
        return math.isinf(self.orders[0].message.duration_s)

    @property
    def affected(self) -> int:
        """How many messages (or ticks of an actuator) it has changed, as far as reported."""
        return sum(report.affected for report in self.reports.values())

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes that have reported."""
        return tuple(dict.fromkeys(report.node for report in self.reports.values()))

    @property
    def refused(self) -> Mapping[str, str]:
        """Why nodes did not do as ordered, or not to the end."""
        return {report.node: report.reason for report in self.reports.values() if report.reason}

    @property
    def unanswered(self) -> tuple[Order, ...]:
        """The orders on which no node has reported."""
        answered = {injection for injection, _, _ in self.reports}
        return tuple(order for order in self.orders if order.injection not in answered)

    @property
    def unfinished(self) -> tuple[Order, ...]:
        """The orders whose end not all nodes that answered have reported."""
        going_on = {r.injection for r in self.reports.values() if not r.finished}
        return tuple(order for order in self.orders
                     if order.injection in going_on or order in self.unanswered)

    @property
    def is_settled(self) -> bool:
        """Whether there is nothing left to wait for: it is over, or permanent and has an effect."""
        return not self.unfinished or (self.is_permanent and self.affected > 0)

    @property
    def waits_s(self) -> float:
        """How long that may take, simulated seconds."""
        return FIRST_EFFECT_S if self.is_permanent else self.orders[0].message.duration_s
