"""`rampart inject`: inject a fault of the catalogue, or one that the options describe."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import uuid
from collections.abc import Coroutine, Sequence
from typing import Any

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import bare
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.run_info import find_run
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.runtime.corruption import field_type, is_array
from rampart.actors.runtime.fault_watch import FaultWatch, Order
from rampart.actors.runtime.injection import MODES, flaw
from rampart.actors.supervision.kill_node import SignalError
from rampart.actors.system.layout import published_keys
from rampart.actors.system.topics import system_topics
from rampart.cli import completion, systems
from rampart.cli.look.topic_catalogue import check_member, resolve, topics_for
from rampart.cli.operate.kill_node import signal_anywhere
from rampart.cli.operate.operator_verbs import trigger
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    positive,
    print_json,
    print_table,
    say,
)
from rampart.cli.session import Session, connect, pause
from rampart.cli.verbs import JSON, PORT, add_verb, flag, group, number, option, several, word
from rampart.manager.spec.specification import SystemSpec
from rampart.sim.faults.disturbance import Disturbance, Fault
from rampart.sim.faults.faults import PROCESS_FAULTS, faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.topic_faults import NONSENSE, modes_of, systematic_faults

_DEFAULT_DURATION_S = 5.0
TRIGGER = "trigger:"
_SECONDS = "must be seconds above 0"
_DETAILS = {"delay": "delay", "stamp": "restamp", "set": "corrupt", "add": "corrupt",
            "ramp": "corrupt", "noise": "corrupt"}
"""Option → the mode that it details."""

STOPPED_S = 5.0
"""Simulated seconds for which `stop:NODE` stops a process by default."""

_TAKE_HOLD_S = 1.5
"""Real seconds within which a publisher answers, also during its restart."""

_OF_TOPICS = ("share", "on", "off", "seed", *_DETAILS)
"""Options of a fault of a topic."""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(
        verbs, "inject", "inject a fault", inject, PORT,
        option("fault", nargs="?", metavar="FAULT", completer=completion.faults,
               help="a name from --list, MODE:TOPIC, kill:NODE, stop:NODE, wedge:NODE or "
               f"trigger:MODULE; MODE is {', '.join(MODES)}, or a nonsense reading of --list"),
        flag("--list", "list the faults of the system; needs no run"),
        word("--system", "FILE", "for --list: system file (default: that of the run, else "
             "osmosis)"),
        number("--duration", "S", "duration in simulated seconds, inf for permanent (default: that "
               f"of the fault, else {_DEFAULT_DURATION_S:g})"),
        flag("--at-once", "return when the fault is in force, instead of at its end"),
        JSON,
        group("which messages",
              number("--share", "P", "probability that a message is affected (default: 1)"),
              number("--on", "S", "with --off: in force for S, repeatedly"),
              number("--off", "S", "with --on: then absent for S"),
              option("--seed", type=int, metavar="N", help="seed of random choices: share, "
                     "noise, and values of restamp:TOPIC and corrupt:TOPIC (default: 0)")),
        group("details of MODE:TOPIC",
              number("--delay", "S", "delay: simulated seconds (default: 1.5)"),
              number("--stamp", "S", "restamp: simulated seconds that are added to each stamp "
                     "(default: random)"),
              several("--set", "FIELD=VALUE",
                      "corrupt: overwrite a field; repeatable, as all below"),
              several("--add", "FIELD=BIAS",
                      "corrupt: add BIAS to a number, or to each number of an array"),
              several("--ramp", "FIELD=RATE", "corrupt: add RATE per simulated second"),
              several("--noise", "FIELD=SIGMA",
                      "corrupt: add Gaussian noise of this standard deviation")))


def inject(options: argparse.Namespace) -> int | Coroutine[Any, Any, int]:
    """List the catalogue, or inject a fault.

    Inject a fault by name, or disturb any topic, for some time. The node that
    publishes the topic carries the fault out; the world carries out faults of the
    robot, such as a weak rotor. The verb waits for the end of the fault, or for the
    first effect of a permanent one, and prints how many messages were affected.
    Ctrl-C ends the fault at once.

    Examples:
      rampart inject --list                           # the faults of the system
      rampart inject FAULT --duration 3
      rampart inject stuck:TOPIC --duration inf       # until the node's process ends
      rampart inject drop:TOPIC --share 0.3           # lose three messages in ten
      rampart inject corrupt:TOPIC --seed 7           # odd seed: one number; even: all
      rampart inject corrupt:TOPIC --set pose.x_m=2.5
      rampart inject restamp:TOPIC --stamp=-0.2       # stamps 0.2 s too early
      rampart inject stop:NODE --duration 2           # freeze a process for 2 s
      rampart inject trigger:MODULE                   # a stand-in detection module detects

    `rampart topic info TOPIC` lists the fields.

    exit code: 0 it had an effect, 1 it had none, 2 bad usage
    """
    if options.list:
        _print_catalogue(systems.at_hand(options.system, options.port), as_json=options.json)
        return 0
    if options.system is not None:
        raise UsageError(f"--system {options.system}: only with --list; a fault is injected into "
                         "the run")
    if not options.fault:
        raise UsageError("expected FAULT; `rampart inject --list` lists the faults")
    if options.fault.partition(":")[0] in PROCESS_FAULTS:
        return _hit_process(options)
    if options.fault.startswith(TRIGGER):
        return trigger(argparse.Namespace(
            port=options.port, module=options.fault.removeprefix(TRIGGER),
            duration=options.duration or _DEFAULT_DURATION_S))
    positive("--duration", options.duration, "must be seconds above 0, or inf")
    name, orders = orders_of(options)
    return _run_fault(name, orders, options)


def orders_of(options: argparse.Namespace) -> tuple[str, tuple[Order, ...]]:
    """Return the name of the fault, and the orders to the nodes that carry it out.

    Raises:
        UsageError: there is no such fault, or an option does not fit it.
    """
    unique = uuid.uuid4().hex[:6]
    own = faults_of(systems.at_hand(None, options.port)).own(
        options.fault, f"{options.fault}-{unique}", options.duration)
    if own is not None:
        _refuse_details(options)
        if not isinstance(own, tuple):
            raise UsageError(f"{options.fault}: can only be injected from the start of a run: "
                             f"--fault {options.fault}@SECONDS")
        return options.fault, own
    fault = choose(options)
    name = fault.name.replace(" ", "-").replace("/", "-")
    return fault.name, tuple(Order(bus_topics.INJECT, order) for order in fault.orders(
        f"{name}-{unique}", options.duration))


def choose(options: argparse.Namespace) -> Fault:
    """Return the fault of topics that the options describe.

    Raises:
        UsageError: there is no such fault, or an option does not fit it.
    """
    if options.share is not None and not 0 < options.share <= 1:
        raise UsageError(f"--share {options.share:g}: must be above 0, and at most 1")
    if (options.on is None) != (options.off is None):
        raise UsageError("--on S and --off S: expected both or none")
    positive("--on", options.on, _SECONDS, math.inf)
    positive("--off", options.off, _SECONDS, math.inf)
    mode, colon, key = options.fault.partition(":")
    detailed = [name for name in _DETAILS if getattr(options, name) not in (None, [])]
    for name in detailed:
        if not colon or mode != _DETAILS[name]:
            raise UsageError(f"--{name}: only with {_DETAILS[name]}:TOPIC, not with "
                             f"{options.fault}")
    known = topics_for(key, options.port) if colon else ()
    if detailed:
        fault = _detailed(mode, key, known, options)
    else:
        fault = faults_of(systems.at_hand(None, options.port)).find(
            options.fault, options.seed or 0, known)
    return fault.varied(share=options.share, on_s=options.on, off_s=options.off)


def _detailed(mode: str, name: str, known: Sequence[Topic[Any]], options: argparse.Namespace
              ) -> Fault:
    topic, key = resolve(name, known)
    positive("--delay", options.delay, _SECONDS, math.inf)
    disturbance = Disturbance(
        key.removeprefix(f"{ROOT}/"), mode, options.delay or 0.0,
        set_fields=dict(_setting(text, topic) for text in options.set),
        add_fields=dict(_amount("--add", text, topic) for text in options.add),
        ramp_fields=dict(_amount("--ramp", text, topic) for text in options.ramp),
        noise_fields=dict(_amount("--noise", text, topic) for text in options.noise),
        seed=options.seed or 0, stamp_s=options.stamp or 0.0)
    if reason := flaw(disturbance.order("", _DEFAULT_DURATION_S), topic.type):
        raise UsageError(f"{options.fault}: {reason}")
    return Fault(f"{mode}:{disturbance.topic}", "", (disturbance,), (), _DEFAULT_DURATION_S)


def _split(option: str, text: str, topic: Topic[Any]) -> tuple[str, str, Any]:
    """Return field, value as text, and type of the field."""
    name, equals, value = text.partition("=")
    if not equals:
        raise UsageError(f"{option} {text}: expected FIELD=VALUE")
    return name, value, field_type(topic.type, name).declared


def _setting(text: str, topic: Topic[Any]) -> tuple[str, Any]:
    name, value, kind = _split("--set", text, topic)
    if is_array(name, kind):
        kind = float  # it fills the array
    if bare(kind) is str:
        return name, value
    try:
        found = msgspec.convert(msgspec.json.decode(value), kind)
    except (msgspec.DecodeError, msgspec.ValidationError):
        try:
            found = msgspec.convert(value, kind, strict=False)
        except msgspec.ValidationError as error:
            raise UsageError(f"--set {text}: {error}") from None
    return name, msgspec.to_builtins(found)


def _amount(option: str, text: str, topic: Topic[Any]) -> tuple[str, float]:
    name, value, _ = _split(option, text, topic)
    try:
        return name, float(value)
    except ValueError:
        raise UsageError(f"{option} {text}: expected FIELD=NUMBER") from None


def _print_catalogue(spec: SystemSpec, *, as_json: bool) -> None:
    known = system_topics(spec)
    keys, faults = published_keys(spec), faults_of(spec)
    if as_json:
        everything = (*faults.named.values(), *systematic_faults(keys, known))
        print_json([*({"name": f.name, "title": f.title, "group": f.group,
                       "detected_by": f.detected_by, "duration_s": f.duration_s,
                       "topics": [d.topic for d in f.disturbances]} for f in everything),
                    *({"name": f.name, "title": f.title, "group": f.group, "detected_by": (),
                       "duration_s": f.duration_s, "topics": [o.topic for o in f.orders]}
                      for f in faults.offered() if f.orders)])
        return
    for kind, title in faults.kinds.items():
        rows = [(f.name, " ".join(faults.named[f.name].detected_by if f.name in faults.named
                                  else ()),
                 "inf" if f.duration_s is None else f"{f.duration_s:g}", f.title)
                for f in faults.offered() if f.group == kind]
        if rows:
            say(f"{title}:")
            print_table(("fault", "detected by", "s", "effect"), rows)
            say()
    say(f"any topic, as MODE:TOPIC; MODE is one of {', '.join(MODES)}, or a nonsense reading:")
    print_table(("topic", "modes", "nonsense"), _modes_by_topic(keys, known))
    say()
    others = [name for names in faults.others.values() for name in names]
    if others:
        say("of the robot, with details after a colon:")
        for name in others:
            say(f"  {name}")
        say()
    say("any process: kill:NODE, stop:NODE, wedge:NODE; with --fault also hang:NODE and stop:all; "
        f"slow:NODE or slow:all in virtual time; NODE is one of {', '.join(can_be_hit(spec))}")


def _modes_by_topic(keys: tuple[str, ...], known: tuple[Topic[Any], ...]
                    ) -> list[tuple[str, str, str]]:
    """Return topic, modes and nonsense readings in words, with one row for each family."""
    rows: dict[str, tuple[str, str, str]] = {}
    for key in keys:
        modes, topic = modes_of(key, known), resolve(key, known)[0].key
        missing = [mode for mode in MODES if mode not in modes]
        if modes:
            rows[topic] = (topic, f"all but {', '.join(missing)}" if missing else "all",
                           ", ".join(mode for mode in NONSENSE if mode in modes))
    return list(rows.values())


# -- the work -----------------------------------------------------------------------------------


def _refuse_details(options: argparse.Namespace) -> None:
    """Refuse the options of a fault of a topic with any other fault."""
    for name in _OF_TOPICS:
        if getattr(options, name) not in (None, []):
            raise UsageError(f"--{name}: only with a fault of a topic, not with {options.fault}")


def _refused(watch: FaultWatch) -> str:
    return next((f"{node}: {reason}" for node, reason in watch.refused.items()), "")


async def _run_fault(name: str, orders: Sequence[Order], options: argparse.Namespace) -> int:
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


async def _hit_process(options: argparse.Namespace) -> int:
    """Kill, stop or hang a process of the run: `kill:NODE`, `stop:NODE`, `wedge:NODE`.

    Raises:
        UsageError: there is no run or no such node, or an option does not go with it.
    """
    what, _, node = options.fault.partition(":")
    if what in {"hang", "slow"} or "@" in node or "+" in node:
        raise UsageError(f"{options.fault}: only from the start of a run, by --fault (slow: in "
                         "virtual time); here kill:NODE, stop:NODE or wedge:NODE, and --duration")
    if what != "stop" and options.duration is not None:
        raise UsageError(f"--duration {options.duration:g}: {what} ends when the node is restarted")
    _refuse_details(options)
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
