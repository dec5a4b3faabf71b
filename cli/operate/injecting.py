"""Ordering a fault in a run, and hearing from the nodes what came of it."""

from __future__ import annotations

import asyncio
import contextlib
import math
import uuid

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import MANY
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.messages import Injection, InjectionReport
from rampart.actors.ftm import topics
from rampart.actors.layout.system_topics import find_topic
from rampart.cli.output import NoEffectError, print_json, say, unknown
from rampart.cli.session import Session, connect
from rampart.sim.faults.disturbance import Fault

_TAKE_HOLD_S = 1.5
"""Real seconds within which a publisher answers, even when it is just being respawned."""

_FIRST_EFFECT_S = 10.0
"""Simulated seconds within which a permanent fault must affect a message."""


class _Watch:
    """What the nodes have reported about one injection."""

    def __init__(self, order: Injection) -> None:
        self.order = order
        self.reports: dict[str, InjectionReport] = Remembered(MANY)

    def hear(self, report: InjectionReport) -> None:
        if report.injection == self.order.injection:
            self.reports[report.node] = report

    @property
    def taken(self) -> bool:
        return bool(self.reports)

    @property
    def refused(self) -> str:
        return next((f"{r.node}: {r.reason}" for r in self.reports.values() if r.reason), "")

    @property
    def finished(self) -> bool:
        return self.taken and all(r.finished for r in self.reports.values())

    @property
    def affected(self) -> int:
        return sum(r.affected for r in self.reports.values())

    @property
    def permanent(self) -> bool:
        return math.isinf(self.order.duration_s)

    @property
    def settled(self) -> bool:
        """Whether there is nothing left to wait for."""
        return self.finished or (self.permanent and self.affected > 0)

    @property
    def waits_s(self) -> float:
        """How long that may take, simulated seconds."""
        return _FIRST_EFFECT_S if self.permanent else self.order.duration_s


async def run_fault(fault: Fault, duration_s: float | None, port: int | None, *,
                    at_once: bool, as_json: bool) -> int:
    """Inject a fault into the run and say what came of it; return the exit code.

    Args:
        fault: what to inject.
        duration_s: simulated seconds, infinity for permanent; the fault's own if None.
        port: base port of the run, if there are several.
        at_once: do not wait for the end of the fault (or the first effect of a permanent one).
        as_json: print JSON instead of sentences.

    Raises:
        NoEffectError: the fault had no effect, or it is unknown whether it had.
        UsageError: there is no run, or no such node in it.
    """
    name = fault.name.replace(" ", "-").replace("/", "-")
    watches = [_Watch(order)
               for order in fault.orders(f"{name}-{uuid.uuid4().hex[:6]}", duration_s)]
    async with connect(port) as session:
        for watch in watches:
            _check_publisher(session, watch.order.topic)
        settled = asyncio.Event()

        def hear(_key: str, _header: Header, report: InjectionReport) -> None:
            for watch in watches:
                watch.hear(report)
            if all(watch.settled for watch in watches):
                settled.set()

        session.listen(bus_topics.INJECTION_REPORT, bus_topics.INJECTION_REPORT.at(), hear)
        try:
            for watch in watches:
                await _take_hold(session, watch)
                if not as_json:
                    say(f"{fault.name}: {watch.order.mode} {watch.order.topic} in force at "
                        f"{', '.join(watch.reports)} {_how_long(watch)}")
            if not at_once:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(
                        settled.wait(), session.real_s(max(w.waits_s for w in watches)) + 1.0)
                if not settled.is_set():
                    await _end(session, [w for w in watches if w.permanent])
        except asyncio.CancelledError:
            await _end(session, watches)
            raise
    if as_json:
        _print_result(fault, watches, at_once=at_once)
    if not at_once:
        for watch in watches:
            _judge(watch)
            if not as_json:
                say(f"{fault.name}: {_outcome(watch)}")
    return 0


async def _take_hold(session: Session, watch: _Watch) -> None:
    if not await session.command(bus_topics.INJECT, watch.order, lambda: watch.taken, _TAKE_HOLD_S):
        raise NoEffectError(f"no effect: no node publishes {watch.order.topic} in this run")
    if watch.refused and watch.affected == 0:
        raise NoEffectError(f"no effect: refused by {watch.refused}")


async def _end(session: Session, watches: list[_Watch]) -> None:
    """End the injections now: an order of the same id with no duration."""
    for watch in watches:
        over = msgspec.structs.replace(watch.order, duration_s=0.0)
        await session.command(bus_topics.INJECT, over, lambda w=watch: w.finished, 0.5)  # type: ignore[misc]


def _judge(watch: _Watch) -> None:
    where, topic = ", ".join(watch.reports), watch.order.topic
    if watch.refused:
        before = (f"ended early, after {watch.affected} messages" if watch.affected
                  else "no effect")
        raise NoEffectError(f"{before}: refused by {watch.refused}")
    if not watch.settled:
        raise NoEffectError(f"effect unknown: {where} did not report the end of "
                            f"{watch.order.injection}; it was probably restarted")
    if watch.affected == 0:
        raise NoEffectError(f"no effect: {where} published nothing on {topic} within "
                            f"{watch.waits_s:g} s, or nothing that it changed")


def _how_long(watch: _Watch) -> str:
    return "until its process ends" if watch.permanent else f"for {watch.order.duration_s:g} s"


def _outcome(watch: _Watch) -> str:
    if not watch.finished:
        return f"affects {watch.order.topic}, and goes on"
    return f"over, {watch.affected} messages on {watch.order.topic} affected"


def _print_result(fault: Fault, watches: list[_Watch], *, at_once: bool) -> None:
    """Print the result as JSON; the duration of a permanent fault is null."""
    print_json({
        "fault": fault.name,
        "effective": None if at_once else all(w.affected > 0 for w in watches),
        "injections": [
            {"id": w.order.injection, "topic": w.order.topic, "mode": w.order.mode,
             "nodes": list(w.reports), "duration_s": w.order.duration_s,
             "affected": w.affected, "finished": w.finished, "reason": w.refused}
            for w in watches]})


def _check_publisher(session: Session, key: str) -> None:
    topic = find_topic(key, topics.ALL)
    if topic is not None and topic.is_family:
        head, tail = topic.key.split("{name}")
        member = key[len(head):len(key) - len(tail)]
        if member not in session.run.nodes:
            raise unknown("node", member, session.run.nodes)
