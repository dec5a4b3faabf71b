"""`rampart inject`: disturb a topic where it is published, and say whether it had an effect."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import uuid
from typing import Any

import msgspec

from actors import topics
from actors.messages import Injection, InjectionReport
from actors.runtime.envelope import Header
from actors.runtime.injection import MODES
from actors.runtime.topic import ROOT, Topic
from sim.faults import CATALOGUE, Disturbance, Fault, UnknownFaultError, find_fault
from toolbox.output import NoEffectError, UsageError, print_json, print_table, say, unknown
from toolbox.session import Session, connect
from toolbox.topic_catalogue import resolve

_TAKE_HOLD_S = 1.5
"""Real seconds within which a publisher answers, even when it is just being respawned."""

_DEFAULT_DURATION_S = 5.0


def add(verbs: Any, formatter: Any, common: argparse.ArgumentParser) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser(
        "inject", parents=[common], formatter_class=formatter, help="inject a fault",
        description="Inject a fault of the catalogue, or disturb any topic, for a while. It\n"
                    "acts in the node that publishes the topic. The verb waits for its end and\n"
                    "says how many messages were affected; if none was, it says so and exits 1.\n"
                    "Ctrl-C ends the fault at once. Durations are simulated seconds.",
        epilog="examples:\n  rampart inject --list\n"
               "  rampart inject command-out-of-bounds --duration 3\n"
               "  rampart inject prohibited-area --at-once\n"
               "  rampart inject --topic localization/pose --mode delay --delay 0.8\n"
               "  rampart inject --topic localization/pose --mode corrupt --ramp x_m=0.25\n"
               "  rampart inject --topic control/command --mode corrupt --set angular_radps=2.5")
    parser.add_argument("fault", nargs="?", metavar="FAULT", help="a name from --list")
    parser.add_argument("--list", action="store_true", help="list the catalogue (needs no run)")
    parser.add_argument("--duration", type=float, metavar="S",
                        help="simulated seconds; default the fault's own, else 5")
    parser.add_argument("--at-once", action="store_true",
                        help="return as soon as the fault is in force; do not wait for its end")
    parser.add_argument("--json", action="store_true", help="print JSON")
    own = parser.add_argument_group("a fault of your own, instead of FAULT")
    own.add_argument("--topic", metavar="KEY", help="e.g. control/command or detection/DM2")
    own.add_argument("--mode", help=", ".join(MODES))
    own.add_argument("--delay", type=float, metavar="S", help="for delay: simulated seconds")
    own.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE",
                     help="for corrupt: overwrite a field; may be repeated")
    own.add_argument("--ramp", action="append", default=[], metavar="FIELD=RATE",
                     help="for corrupt: add RATE per simulated second; may be repeated")
    own.add_argument("--keep-ends", action="append", default=[], metavar="FIELD",
                     help="for corrupt: keep only first and last element of a list")
    parser.set_defaults(run=inject)


def inject(options: argparse.Namespace) -> int:
    """List the catalogue, or inject a fault."""
    if options.list:
        _print_catalogue(as_json=options.json)
        return 0
    fault = choose(options)
    if options.duration is not None and not (
            math.isfinite(options.duration) and options.duration > 0):
        raise UsageError(f"--duration {options.duration:g}: must be seconds above 0")
    return asyncio.run(_inject(options, fault))


def choose(options: argparse.Namespace) -> Fault:
    """Return the fault that the options describe.

    Raises:
        UsageError: neither or both of FAULT and --topic, or something in them is wrong.
    """
    if (options.fault is None) == (options.topic is None):
        raise UsageError("give either a FAULT of the catalogue (rampart inject --list) or --topic")
    if options.fault is not None:
        for name in ("mode", "delay", "set", "ramp", "keep_ends"):
            if getattr(options, name):
                raise UsageError(f"--{name.replace('_', '-')} goes with --topic, not with a "
                                 "FAULT of the catalogue")
        try:
            return find_fault(options.fault)
        except UnknownFaultError as error:
            raise UsageError(str(error)) from None
    topic, key = resolve(options.topic)
    if "*" in key:
        raise UsageError(f"--topic {options.topic}: name one member of the family, "
                         f"e.g. {topic.key.replace('{name}', 'DM1')}")
    if options.mode not in MODES:
        raise UsageError(f"--mode {options.mode}: must be one of {', '.join(MODES)}")
    corrupt = options.set or options.ramp or options.keep_ends
    if bool(corrupt) != (options.mode == "corrupt"):
        raise UsageError("--mode corrupt goes with --set, --ramp or --keep-ends, and no other "
                         "mode does")
    if (options.delay is not None) != (options.mode == "delay"):
        raise UsageError("--mode delay goes with --delay S, and no other mode does")
    if options.delay is not None and not (math.isfinite(options.delay) and options.delay > 0):
        raise UsageError(f"--delay {options.delay:g}: must be seconds above 0")
    disturbance = Disturbance(
        key.removeprefix(f"{ROOT}/"), options.mode, options.delay or 0.0,
        dict(_assignment("--set", text, topic) for text in options.set),
        dict(_ramp(text, topic) for text in options.ramp),
        tuple(_sequence(name, topic) for name in options.keep_ends))
    return Fault(f"{options.mode} {disturbance.topic}", "", (disturbance,), (),
                 _DEFAULT_DURATION_S)


def field_type(topic: Topic[Any], path: str) -> Any:
    """Return the type of a field given as `name` or `outer.inner`.

    Raises:
        UsageError: the message has no such field.
    """
    kind: Any = topic.type
    for name in path.split("."):
        known = ({f.name: f.type for f in msgspec.structs.fields(kind)}
                 if isinstance(kind, type) and issubclass(kind, msgspec.Struct) else {})
        if name not in known:
            listed = ", ".join(f.name for f in msgspec.structs.fields(topic.type))
            raise UsageError(f"field {path!r}: {topic.type.__name__} has no such field; "
                             f"known: {listed}")
        kind = known[name]
    return kind


def _assignment(option: str, text: str, topic: Topic[Any]) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise UsageError(f"{option} {text}: must be FIELD=VALUE")
    kind = field_type(topic, name)
    try:
        parsed = msgspec.json.decode(value)
    except msgspec.DecodeError:
        parsed = value
    try:
        msgspec.convert(parsed, kind)
    except msgspec.ValidationError as error:
        raise UsageError(f"{option} {text}: {error}") from None
    return name, parsed


def _ramp(text: str, topic: Topic[Any]) -> tuple[str, float]:
    name, value = _assignment("--ramp", text, topic)
    if field_type(topic, name) is not float:
        raise UsageError(f"--ramp {text}: must be FIELD=RATE with a field that is a float")
    return name, float(value)


def _sequence(name: str, topic: Topic[Any]) -> str:
    if getattr(field_type(topic, name), "__origin__", None) not in (tuple, list):
        raise UsageError(f"--keep-ends {name}: not a list")
    return name


class _Watch:
    """What the nodes have reported about one injection."""

    def __init__(self, order: Injection) -> None:
        self.order = order
        self.reports: dict[str, InjectionReport] = {}

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


async def _inject(options: argparse.Namespace, fault: Fault) -> int:
    name = fault.name.replace(" ", "-").replace("/", "-")
    orders = fault.orders(f"{name}-{uuid.uuid4().hex[:6]}", options.duration)
    watches = [_Watch(order) for order in orders]
    async with connect(options.port) as session:
        for order in orders:
            _check_publisher(session, order.topic)

        finished = asyncio.Event()

        def hear(_key: str, _header: Header, report: InjectionReport) -> None:
            for watch in watches:
                watch.hear(report)
            if all(watch.finished for watch in watches):
                finished.set()

        session.listen(topics.INJECTION_REPORT, topics.INJECTION_REPORT.at(), hear)
        try:
            for watch in watches:
                await _take_hold(session, watch)
                if not options.json:
                    say(f"{fault.name}: {watch.order.mode} {watch.order.topic} in force at "
                        f"{', '.join(watch.reports)} for {watch.order.duration_s:g} s")
            if not options.at_once:
                longest_s = max(w.order.duration_s for w in watches)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(finished.wait(), session.real_s(longest_s) + 1.0)
        except asyncio.CancelledError:
            await _end(session, watches)
            raise
    if options.json:
        print_json({
            "fault": fault.name,
            "effective": None if options.at_once else all(w.affected > 0 for w in watches),
            "injections": [
                {"id": w.order.injection, "topic": w.order.topic, "mode": w.order.mode,
                 "nodes": list(w.reports), "duration_s": w.order.duration_s,
                 "affected": w.affected, "finished": w.finished} for w in watches]})
    if options.at_once:
        return 0
    for watch in watches:
        _judge(watch)
        if not options.json:
            say(f"{fault.name}: over, {watch.affected} messages on {watch.order.topic} affected")
    return 0


async def _take_hold(session: Session, watch: _Watch) -> None:
    if not await session.command(topics.INJECT, watch.order, lambda: watch.taken, _TAKE_HOLD_S):
        raise NoEffectError(f"no effect: no node publishes {watch.order.topic} in this run")
    if watch.refused:
        raise NoEffectError(f"no effect: refused by {watch.refused}")


async def _end(session: Session, watches: list[_Watch]) -> None:
    """End the injections now: an order of the same id with no duration."""
    for watch in watches:
        over = msgspec.structs.replace(watch.order, duration_s=0.0)
        await session.command(topics.INJECT, over, lambda w=watch: w.finished, 0.5)  # type: ignore[misc]


def _judge(watch: _Watch) -> None:
    where = ", ".join(watch.reports)
    if not watch.finished:
        raise NoEffectError(f"effect unknown: {where} did not report the end of "
                            f"{watch.order.injection}; it was probably restarted")
    if watch.affected == 0:
        raise NoEffectError(f"no effect: {where} published nothing on {watch.order.topic} within "
                            f"{watch.order.duration_s:g} s")


def _check_publisher(session: Session, key: str) -> None:
    topic, _ = resolve(key)
    if topic.is_family:
        head, tail = topic.key.split("{name}")
        member = key[len(head):len(key) - len(tail)]
        if member not in session.run.nodes:
            raise unknown("node", member, session.run.nodes)


def _print_catalogue(*, as_json: bool) -> None:
    if as_json:
        print_json([{"name": f.name, "title": f.title, "detected_by": f.detected_by,
                     "duration_s": f.duration_s,
                     "topics": [d.topic for d in f.disturbances]} for f in CATALOGUE.values()])
    else:
        print_table(("fault", "seen by", "s", "what happens"),
                    [(f.name, " ".join(f.detected_by), f"{f.duration_s:g}", f.title)
                     for f in CATALOGUE.values()])
        say("crashes: kill-node NODE, or kill -9 PID")
