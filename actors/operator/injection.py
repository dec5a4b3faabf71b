"""Faults that the operator injects from the page: orders, progress and results. Pure.

A fault has a name in the launcher's catalogue, or is `MODE:TOPIC`. The node that publishes the
topic injects it. It reports the begin, the first effect, and the end with the number of changed
messages. A fault that changes no message is shown as *no effect*.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm.messages import NamedFault
from rampart.actors.operator.requests import RefusedError
from rampart.actors.runtime.fault_watch import FIRST_EFFECT_S, FaultWatch, Order
from rampart.actors.runtime.injection import UNTOUCHED, flaw
from rampart.actors.system.layout import published_keys
from rampart.manager.spec.schema import SystemSpec

TAKE_HOLD_S = 3.0
"""Simulated seconds within which a publisher reports, even one that is being restarted."""

LATE_END_S = 2.0
"""Simulated seconds after the end of a fault within which its publisher reports the end."""

DELAY_S = 1.5
"""Delay of `delay:TOPIC`: longer than any freshness timeout of the shipped system."""

OWN_DURATION_S = 10.0
STAMP_S = 0.5
"""Error of `restamp:TOPIC`: further ahead than any reader accepts."""

MODES = ("drop", "freeze", "stuck", "delay", "duplicate", "restamp")
"""Modes that fit any topic; corruption of fields needs the catalogue."""

_KEPT = 20


@dataclass(slots=True, kw_only=True)
class Ordered(FaultWatch):
    """An ordered fault and its progress."""

    injection: str
    fault: str
    begun_s: float
    duration_s: float
    reason: str = ""
    ending: bool = False
    outcome: str = ""
    effective: bool | None = None

    def state(self) -> str:
        """Return its progress in a few words."""
        if self.outcome:
            return self.outcome
        if not self.reports:
            return "requested"
        if self.affected:
            return f"in force, {self.affected} changed"
        return "in force, no effect so far"


class Injections:
    """The faults that were ordered from the page.

    Args:
        prefix: of the ids, unique to each incarnation of the node.
        catalogue: faults with a name.
        places: keys of topics that can be disturbed.
        robots: topics for orders of faults of the catalogue.
        overhead_s: added for delays in real time, in simulated seconds.
    """

    def __init__(self, prefix: str, catalogue: Iterable[NamedFault], places: Iterable[str],
                 robots: Iterable[Topic[Any]] = (), overhead_s: float = 0.0) -> None:
        self._prefix = prefix
        self._robots = {topic.key: topic for topic in robots}
        self._overhead_s = overhead_s
        self._catalogue = {f.name: f for f in catalogue}
        self._places = tuple(places)
        self._count = 0
        self._ordered: list[Ordered] = []

    def choice(self) -> dict[str, Any]:
        """Return the available faults, for the page."""
        return {"faults": [{"name": f.name, "title": f.title, "group": f.group,
                            "duration_s": f.duration_s} for f in self._catalogue.values()],
                "modes": MODES, "topics": self._places, "duration_s": OWN_DURATION_S}

    def view(self) -> list[dict[str, Any]]:
        """Return the ordered faults, newest first, for the page."""
        return [{"injection": o.injection, "fault": o.fault, "state": o.state(),
                 "ended": bool(o.outcome), "effective": o.effective}
                for o in reversed(self._ordered)]

    # -- the operator ---------------------------------------------------------------------------

    def order(self, fault: str, duration_s: float | None, now_s: float) -> Ordered:
        """Take an order of the operator.

        Args:
            fault: name in the catalogue, or `MODE:TOPIC`.
            duration_s: its duration, infinity for permanent, None for the fault's default.
            now_s: simulated seconds.

        Raises:
            RefusedError: there is no such fault.
        """
        self._count += 1
        name = f"{self._prefix}.{self._count}"
        orders, own_s = self._find(fault, name)
        lasts_s = own_s if duration_s is None else duration_s
        ordered = Ordered([o.with_(duration_s=lasts_s) for o in orders], injection=name,
                          fault=fault, begun_s=now_s, duration_s=lasts_s)
        self._ordered.append(ordered)
        ended = [o for o in self._ordered if o.outcome]
        for old in ended[:max(0, len(self._ordered) - _KEPT)]:
            self._ordered.remove(old)
        return ordered

    def end(self, injection: str, now_s: float) -> Sequence[Order]:
        """End a fault now, and return the orders for that.

        Raises:
            RefusedError: no such fault is active.
        """
        for ordered in self._ordered:
            if ordered.injection == injection and not ordered.outcome:
                ordered.ending = True
                ordered.duration_s = max(now_s - ordered.begun_s, 0.0)
                ordered.orders = [o.with_(duration_s=0.0) for o in ordered.orders]
                return ordered.orders
        raise RefusedError(f"no fault {injection[:60]!r} is active")

    def _find(self, fault: str, injection: str) -> tuple[list[Order], float]:
        if named := self._catalogue.get(fault):
            return [o.with_(injection=f"{injection}.{i}")
                    for i, o in enumerate(self._orders(named), start=1)], (
                        math.inf if named.duration_s is None else named.duration_s)
        mode, colon, key = fault.partition(":")
        if not colon:
            raise RefusedError(f"no fault {fault[:60]!r}; expected a fault of the list, or "
                               "MODE:TOPIC")
        if mode not in MODES:
            raise RefusedError(f"mode {mode[:40]!r}: expected one of {', '.join(MODES)}")
        if key not in self._places:
            raise RefusedError(f"topic {key[:60]!r}: this system has no such topic that can be "
                               "disturbed")
        order = bm.Injection(f"{injection}.1", key, mode, OWN_DURATION_S,
                             delay_s=DELAY_S if mode == "delay" else 0.0,
                             stamp_s=STAMP_S if mode == "restamp" else 0.0)
        if reason := flaw(order):
            raise RefusedError(reason)
        return [Order(bus_topics.INJECT, order)], OWN_DURATION_S

    def _orders(self, named: NamedFault) -> Iterator[Order]:
        for injection in named.injections:
            yield Order(bus_topics.INJECT, injection)
        for order in named.orders:
            topic = self._robots[order.topic]
            yield Order(topic, msgspec.json.decode(order.document, type=topic.type))

    # -- the run --------------------------------------------------------------------------------

    def due(self) -> list[Order]:
        """Return the orders to send now: new ones and unanswered ones."""
        return [order for o in self._ordered if not o.outcome
                for order in (o.unfinished if o.ending else o.unanswered)]

    def take(self, report: bm.InjectionReport) -> str:
        """Take a report; return a line for the operator, "" for none."""
        for o in self._ordered:
            if o.outcome or not o.hear(report):
                continue
            if not o.unfinished:
                return self._conclude(o)
            if report.affected and o.effective is None:
                o.effective = True
                return f"fault {o.fault} takes effect"
        return ""

    def expire(self, now_s: float) -> list[str]:
        """Return lines about faults whose expected reports have not come."""
        lines = []
        now_s -= self._overhead_s
        for o in self._ordered:
            if o.outcome:
                continue
            if o.unanswered and now_s > o.begun_s + TAKE_HOLD_S:
                where = ", ".join(x.place for x in o.unanswered)
                o.reason = f"no publisher of {where} answers"
                lines.append(self._conclude(o))
            elif now_s > o.begun_s + o.duration_s + LATE_END_S:  # never true of a permanent one
                o.reason = "its publisher was restarted and did not report the end"
                lines.append(self._conclude(o))
            elif (math.isinf(o.duration_s) and o.effective is None
                  and now_s > o.begun_s + FIRST_EFFECT_S):
                o.effective = False
                lines.append(f"fault {o.fault}: no effect for {FIRST_EFFECT_S:g} s; it goes on")
        return lines

    def _conclude(self, o: Ordered) -> str:
        o.effective = o.affected > 0
        reason = next(iter(o.refused.values()), o.reason)
        of_topics = all(x.topic is bus_topics.INJECT for x in o.orders)
        if o.effective:
            unit = "messages" if of_topics else "ticks"
            o.outcome = f"over, {o.affected} {unit} changed" + (f"; {reason}" if reason else "")
        else:
            o.outcome = f"no effect: {reason or 'no message was sent'}"
        return f"fault {o.fault}: {o.outcome}"


def places_of(system: SystemSpec) -> tuple[str, ...]:
    """Return the keys of topics that can be disturbed: those that a node publishes.

    The topics of the judge and of stand-ins, those of injections, and error reports are left out.
    """
    return tuple(key for key in published_keys(system) if key not in UNTOUCHED
                 and not key.startswith(("world/", "stub/", "diagnostic/")))
