"""Ordering a fault in a run, and hearing from the nodes what came of it."""

from __future__ import annotations

import asyncio
import uuid

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import Injection, InjectionReport
from rampart.actors.runtime.fault_watch import FaultWatch, Order
from rampart.cli.look.topic_catalogue import check_member
from rampart.cli.output import NoEffectError, print_json, say
from rampart.cli.session import Session, connect, pause
from rampart.sim.faults.disturbance import Fault

_TAKE_HOLD_S = 1.5
"""Real seconds within which a publisher answers, even when it is just being respawned."""


def _injection(watch: FaultWatch) -> Injection:
    """Return the one injection that is watched."""
    found: Injection = watch.orders[0].message
    return found


def _refused(watch: FaultWatch) -> str:
    return next((f"{node}: {reason}" for node, reason in watch.refused.items()), "")


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
    watches = [FaultWatch((Order(bus_topics.INJECT, order),))
               for order in fault.orders(f"{name}-{uuid.uuid4().hex[:6]}", duration_s)]
    async with connect(port) as session:
        for watch in watches:
            check_member(watch.orders[0].place, session.run.nodes)
        settled = asyncio.Event()

        def hear(_key: str, _header: Header, report: InjectionReport) -> None:
            for watch in watches:
                watch.hear(report)
            if all(watch.is_settled for watch in watches):
                settled.set()

        session.listen(bus_topics.INJECTION_REPORT, bus_topics.INJECTION_REPORT.at(), hear)
        try:
            for watch in watches:
                await _take_hold(session, watch)
                if not as_json:
                    order = _injection(watch)
                    time = ("until its process ends" if watch.is_permanent
                            else f"for {watch.waits_s:g} s")
                    say(f"{fault.name}: {order.mode} {order.topic} in force at "
                        f"{', '.join(watch.nodes)} {time}")
            if not at_once:
                await pause(settled, session.real_s(max(w.waits_s for w in watches)) + 1.0)
                if not settled.is_set():
                    await _end(session, [w for w in watches if w.is_permanent])
        except asyncio.CancelledError:
            await _end(session, watches)
            raise
    if as_json:
        _print_result(fault, watches, at_once=at_once)
    if not at_once:
        for watch in watches:
            _judge(watch)
            if not as_json:
                topic = watch.orders[0].place
                say(f"{fault.name}: affects {topic}, and goes on" if watch.unfinished else
                    f"{fault.name}: over, {watch.affected} messages on {topic} affected")
    return 0


async def _take_hold(session: Session, watch: FaultWatch) -> None:
    if not await session.command(bus_topics.INJECT, _injection(watch),
                                 lambda: bool(watch.reports), _TAKE_HOLD_S):
        raise NoEffectError(f"no effect: no node publishes {_injection(watch).topic} in this run")
    if _refused(watch) and watch.affected == 0:
        raise NoEffectError(f"no effect: refused by {_refused(watch)}")


async def _end(session: Session, watches: list[FaultWatch]) -> None:
    """End the injections now: an order of the same id with no duration."""
    for watch in watches:
        over = watch.orders[0].with_(duration_s=0.0)
        await session.command(over.topic, over.message, lambda w=watch: not w.unfinished, 0.5)  # type: ignore[misc]


def _judge(watch: FaultWatch) -> None:
    where, topic = ", ".join(watch.nodes), _injection(watch).topic
    if _refused(watch):
        before = (f"ended early, after {watch.affected} messages" if watch.affected
                  else "no effect")
        raise NoEffectError(f"{before}: refused by {_refused(watch)}")
    if not watch.is_settled:
        raise NoEffectError(f"effect unknown: {where} did not report the end of "
                            f"{_injection(watch).injection}; it was probably restarted")
    if watch.affected == 0:
        raise NoEffectError(f"no effect: {where} published nothing on {topic} within "
                            f"{watch.waits_s:g} s, or nothing that it changed")


def _print_result(fault: Fault, watches: list[FaultWatch], *, at_once: bool) -> None:
    """Print the result as JSON; the duration of a permanent fault is null."""
    print_json({
        "fault": fault.name,
        "effective": None if at_once else all(w.affected > 0 for w in watches),
        "injections": [
            {"id": order.injection, "topic": order.topic, "mode": order.mode,
             "nodes": list(w.nodes), "duration_s": order.duration_s,
             "affected": w.affected, "finished": not w.unfinished, "reason": _refused(w)}
            for w in watches for order in [_injection(w)]]})
