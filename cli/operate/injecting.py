"""Injecting a fault into a run, and collecting the reports of its effect."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
from collections.abc import Sequence

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.run_info import find_run
from rampart.actors.runtime.fault_watch import FaultWatch, Order
from rampart.actors.supervision.kill_node import SignalError
from rampart.cli.look.topic_catalogue import check_member
from rampart.cli.operate.kill_node import signal_anywhere
from rampart.cli.output import NoEffectError, UsageError, positive, print_json, say
from rampart.cli.session import Session, connect, pause

STOPPED_S = 5.0
"""Simulated seconds for which `stop:NODE` stops a process by default."""

_TAKE_HOLD_S = 1.5
"""Real seconds within which a publisher answers, also during its restart."""

_OF_TOPICS = ("share", "on", "off", "seed", "delay", "stamp", "set", "add", "ramp", "noise")
"""Options of a fault of a topic."""


def refuse_details(options: argparse.Namespace) -> None:
    """Refuse the options of a fault of a topic with any other fault."""
    for name in _OF_TOPICS:
        if getattr(options, name) not in (None, []):
            raise UsageError(f"--{name}: only with a fault of a topic, not with {options.fault}")


def _refused(watch: FaultWatch) -> str:
    return next((f"{node}: {reason}" for node, reason in watch.refused.items()), "")


async def run_fault(name: str, orders: Sequence[Order], options: argparse.Namespace) -> int:
    """Inject a fault into the run, and return the exit code.

    Args:
        name: name of the fault.
        orders: orders to the nodes that carry it out.
        options: options of `rampart inject`.

    Raises:
        NoEffectError: the fault had no effect, or its effect is unknown.
        UsageError: there is no run, or no such node in it.
    """
    watches = [FaultWatch((order,)) for order in orders]
    async with connect(options.port) as session:
        for watch in watches:
            check_member(watch.orders[0].place, session.run.nodes)
        settled = asyncio.Event()

        def hear(_key: str, _header: Header, report: InjectionReport) -> None:
            for watch in watches:
                watch.hear(report)
            if all(watch.is_settled for watch in watches):
                settled.set()

        session.listen(bus_topics.INJECTION_REPORT, hear)
        try:
            for watch in watches:
                await _take_hold(session, watch)
                if not options.json:
                    order = watch.orders[0].message
                    time = ("until its process ends" if watch.is_permanent
                            else f"for {watch.waits_s:g} s")
                    what = f"{order.mode} {order.topic} " if _is_of_topic(watch) else ""
                    say(f"{name}: {what}in force at {', '.join(watch.nodes)} {time}")
            if not options.at_once:
                await pause(settled, session.real_s(max(w.waits_s for w in watches)) + 1.0)
                if not settled.is_set():
                    await _end(session, [w for w in watches if w.is_permanent])
        except asyncio.CancelledError:
            await _end(session, watches)
            raise
    if options.json:
        _print_result(name, watches, at_once=options.at_once)
    if not options.at_once:
        for watch in watches:
            _judge(watch)
            if not options.json:
                where = watch.orders[0].place if _is_of_topic(watch) else ", ".join(watch.nodes)
                what = f"messages on {where} affected" if _is_of_topic(watch) else "ticks changed"
                if watch.is_settled:
                    say(f"{name}: affects {where}, continues" if watch.unfinished else
                        f"{name}: over, {watch.affected} {what}")
                else:  # a fault ends with the process that carries it out, and so does its count
                    say(f"{name}: at least {watch.affected} {what}, until "
                        f"{', '.join(watch.nodes)} was restarted")
    return 0


async def hit_process(options: argparse.Namespace) -> int:
    """Kill, stop or hang a process of the run: `kill:NODE`, `stop:NODE`, `wedge:NODE`.

    Raises:
        UsageError: there is no run or no such node, or an option does not go with it.
    """
    what, _, node = options.fault.partition(":")
    if "@" in node or "+" in node:
        raise UsageError(f"{options.fault}: the fault is injected now; expected --duration S "
                         "instead of @WHEN or +S")
    if what == "hang":
        raise UsageError(f"{options.fault}: only from the start of a run, by --fault "
                         f"{options.fault}; expected stop:{node} or wedge:{node}")
    if what == "slow":
        raise UsageError(f"{options.fault}: only in virtual time: --virtual --fault "
                         f"{options.fault}")
    if what != "stop" and options.duration is not None:
        raise UsageError(f"--duration {options.duration:g}: {what} ends when the node is restarted")
    refuse_details(options)
    positive("--duration", options.duration, "must be seconds above 0, or inf")
    lasts_s = math.inf if what != "stop" else options.duration or STOPPED_S
    if options.at_once and math.isfinite(lasts_s):
        raise UsageError("--at-once: this verb has to continue the stopped process; omit it, or "
                         "use --duration inf")
    run = find_run(options.port)
    victim = await signal_anywhere(node, what.upper(), run.base_port)
    if not options.json:
        say(f"{options.fault}: pid {victim.pid}, incarnation {victim.incarnation}"
            + (f", for {lasts_s:g} s" if math.isfinite(lasts_s) else ""))
    if math.isfinite(lasts_s):
        try:
            await asyncio.sleep(lasts_s / run.rate)
        finally:
            with contextlib.suppress(SignalError):  # it has been replaced
                await signal_anywhere(node, "CONT", run.base_port)
    if options.json:
        print_json({"fault": options.fault, "effective": True, "node": node, "pid": victim.pid,
                    "incarnation": victim.incarnation, "duration_s": lasts_s})
    return 0


async def _take_hold(session: Session, watch: FaultWatch) -> None:
    order = watch.orders[0]
    if not await session.command(order.topic, order.message, lambda: bool(watch.reports),
                                 _TAKE_HOLD_S):
        does = "publishes" if _is_of_topic(watch) else "obeys orders on"
        raise NoEffectError(f"no effect: no node {does} {order.place} in this run")
    if _refused(watch) and watch.affected == 0:
        raise NoEffectError(f"no effect: refused by {_refused(watch)}")


async def _end(session: Session, watches: list[FaultWatch]) -> None:
    """End the injections by orders of the same ids with no duration."""
    for watch in watches:
        over = watch.orders[0].with_(duration_s=0.0)
        await session.command(over.topic, over.message, lambda w=watch: not w.unfinished, 0.5)  # type: ignore[misc]


def _judge(watch: FaultWatch) -> None:
    where, order = ", ".join(watch.nodes), watch.orders[0]
    if _refused(watch):
        before = (f"ended early, after {watch.affected} messages" if watch.affected
                  else "no effect")
        raise NoEffectError(f"{before}: refused by {_refused(watch)}")
    if not watch.is_settled and watch.affected == 0:
        raise NoEffectError(f"effect unknown: {where} did not report the end of "
                            f"{order.injection}, probably after a restart")
    if watch.affected == 0:
        raise NoEffectError(
            f"no effect: {where} published no message on {order.place} that it changed within "
            f"{watch.waits_s:g} s" if _is_of_topic(watch) else
            f"no effect: {where} was not changed within {watch.waits_s:g} s")


def _is_of_topic(watch: FaultWatch) -> bool:
    """Whether a fault disturbs a topic; a node of the robot carries out other faults."""
    return watch.orders[0].topic == bus_topics.INJECT


def _print_result(name: str, watches: list[FaultWatch], *, at_once: bool) -> None:
    """Print the result as JSON, with null as the duration of a permanent fault."""
    print_json({
        "fault": name,
        "effective": None if at_once else all(w.affected > 0 for w in watches),
        "injections": [
            {"id": order.injection, "topic": w.orders[0].place,
             "mode": order.mode if _is_of_topic(w) else None,
             "nodes": list(w.nodes), "duration_s": order.duration_s,
             "affected": w.affected, "finished": not w.unfinished, "reason": _refused(w)}
            for w in watches for order in [w.orders[0].message]]})
