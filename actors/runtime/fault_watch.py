"""An ordered fault, and the nodes' reports on it until it ends or proves ineffective. Pure."""

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
    """A message that orders an injection or another fault, and its topic.

    The message has the fields `injection`, the id that reports name, and `duration_s`.
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
        """Key of the disturbed topic, or of the topic on which another fault is ordered."""
        return str(getattr(self.message, "topic", self.topic.key))


@dataclass(slots=True)
class FaultWatch:
    """The orders that make up a fault, and the reports on them.

    Attributes:
        orders: all orders of one fault, with the same duration.
        reports: last report by injection, node and incarnation. Counts never decrease.
    """

    orders: Sequence[Order]
    reports: dict[tuple[str, str, int], InjectionReport] = field(
        default_factory=lambda: Remembered(MANY))

    def hear(self, report: InjectionReport, incarnation: int = 0) -> bool:
        """Take a report and return whether it is on this fault.

        Args:
            report: a node's report.
            incarnation: of the node; each incarnation counts from zero.
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
        """Whether it lasts as long as the process that it disturbs."""
        return math.isinf(self.orders[0].message.duration_s)

    @property
    def affected(self) -> int:
        """Number of messages (or ticks of an actuator) that it has changed, as reported."""
        return sum(report.affected for report in self.reports.values())

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes that have reported."""
        return tuple(dict.fromkeys(report.node for report in self.reports.values()))

    @property
    def refused(self) -> Mapping[str, str]:
        """Reason by node, if a node refused the fault or ended it early."""
        return {report.node: report.reason for report in self.reports.values() if report.reason}

    @property
    def unanswered(self) -> tuple[Order, ...]:
        """Orders without a report."""
        answered = {injection for injection, _, _ in self.reports}
        return tuple(order for order in self.orders if order.injection not in answered)

    @property
    def unfinished(self) -> tuple[Order, ...]:
        """Orders whose end some node has yet to report."""
        going_on = {r.injection for r in self.reports.values() if not r.finished}
        return tuple(order for order in self.orders
                     if order.injection in going_on or order in self.unanswered)

    @property
    def is_settled(self) -> bool:
        """Whether it is over, or permanent and effective."""
        return not self.unfinished or (self.is_permanent and self.affected > 0)

    @property
    def waits_s(self) -> float:
        """How long `is_settled` may take, simulated seconds."""
        return FIRST_EFFECT_S if self.is_permanent else self.orders[0].message.duration_s
