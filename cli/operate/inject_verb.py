"""`rampart inject`: inject a fault of the catalogue, or disturb any topic."""

from __future__ import annotations

import argparse
import asyncio
import math
import uuid
from collections.abc import Coroutine, Sequence
from typing import Any

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.runtime.fault_watch import FaultWatch, Order
from rampart.actors.runtime.injection import MODES, flaw
from rampart.actors.system.layout import published_keys
from rampart.actors.system.topics import system_topics
from rampart.cli import completion, systems
from rampart.cli.look.topic_verbs import check_member, resolve, topics_for
from rampart.cli.operate.node_verbs import trigger
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    positive,
    print_json,
    print_table,
    say,
)
from rampart.cli.session import Session, connect, pause
from rampart.cli.verbs import JSON, PORT, add_verb, flag, number, option, several, whole, word
from rampart.manager.spec.specification import SystemSpec
from rampart.sim.faults.faults import PROCESS_FAULTS, faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.topic_faults import Disturbance, Fault, modes_of, systematic_faults

_DEFAULT_DURATION_S = 5.0
TRIGGER = "trigger:"
_OF_TOPICS = ("share", "on", "off", "seed", "set", "add", "ramp", "noise")
"""Options of a fault of a topic."""

_TAKE_HOLD_S = 1.5
"""Real seconds within which a publisher answers, also during its restart."""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(
        verbs, "inject", "inject a fault", inject, PORT,
        option("fault", nargs="?", metavar="FAULT", completer=completion.faults,
               help=f"a name from --list, MODE:TOPIC or trigger:MODULE; MODE is "
               f"{', '.join(MODES)}, or a nonsense reading of --list"),
        flag("--list", "list the faults of the system; needs no run"),
        word("--system", "FILE", "for --list: system file (default: that of the run, else "
             "osmosis)"),
        number("--duration", "S", "duration in simulated seconds, inf for permanent (default: that "
               f"of the fault, else {_DEFAULT_DURATION_S:g})"),
        number("--share", "P", "probability that a message is affected (default: 1)"),
        whole("--seed", "N", "seed of random choices: share, noise, and values of restamp:TOPIC "
              "and corrupt:TOPIC (default: 0)"),
        number("--on", "S", "with --off: in force for S, repeatedly"),
        number("--off", "S", "with --on: then absent for S"),
        several("--set", "FIELD=VALUE", "corrupt:TOPIC: overwrite a field; repeatable, as all "
                "below"),
        several("--add", "FIELD=BIAS", "corrupt:TOPIC: add BIAS to a number, or to each number of "
                "an array"),
        several("--ramp", "FIELD=RATE", "corrupt:TOPIC: add RATE per simulated second"),
        several("--noise", "FIELD=SIGMA", "corrupt:TOPIC: add Gaussian noise of this standard "
                "deviation"),
        JSON)


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
      rampart inject corrupt:TOPIC --seed 7           # odd seed: one number; even: all
      rampart inject corrupt:TOPIC --set pose.x_m=2.5
      rampart inject corrupt:TOPIC --ramp pose.x_m=0.5
      rampart inject trigger:MODULE                   # a stand-in detection module detects

    `kill-node` kills, stops and hangs processes. A [[fault]] of the specification is a
    fault with your own values.

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
        raise UsageError(f"{options.fault}: only from the start of a run, by --fault; now "
                         "`kill-node NODE --signal KILL`, STOP or WEDGE does it")
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
    faults = faults_of(systems.at_hand(None, options.port))
    own = faults.own(options.fault, f"{options.fault}-{unique}", options.duration)
    if own is not None:
        for name in _OF_TOPICS:
            if getattr(options, name) not in (None, []):
                raise UsageError(f"--{name}: only with a fault of a topic, not with "
                                 f"{options.fault}")
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
    for name, value in (("--on", options.on), ("--off", options.off)):
        positive(name, value, "must be seconds above 0", math.inf)
    mode, colon, key = options.fault.partition(":")
    known = topics_for(key, options.port) if colon else ()
    if options.set or options.add or options.ramp or options.noise:
        if mode != "corrupt":
            raise UsageError(f"--set, --add, --ramp, --noise: only with corrupt:TOPIC, not with "
                             f"{options.fault}")
        fault = _corruption(*resolve(key, known), options)
    else:
        faults = faults_of(systems.at_hand(None, options.port))
        fault = faults.find(options.fault, options.seed or 0, known)
    return fault.varied(share=options.share, on_s=options.on, off_s=options.off)


def _corruption(topic: Topic[Any], key: str, options: argparse.Namespace) -> Fault:
    change = Disturbance(
        key.removeprefix(f"{ROOT}/"), "corrupt", seed=options.seed or 0,
        set_fields=dict(_setting(text) for text in options.set),
        add_fields=_amounts("--add", options.add), ramp_fields=_amounts("--ramp", options.ramp),
        noise_fields=_amounts("--noise", options.noise))
    if reason := flaw(change.order("", _DEFAULT_DURATION_S), topic.type):
        raise UsageError(f"{options.fault}: {reason}")
    return Fault(f"corrupt:{change.topic}", "", (change,), (), _DEFAULT_DURATION_S)


def _setting(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise UsageError(f"--set {text}: expected FIELD=VALUE")
    try:
        return name, msgspec.json.decode(value)
    except msgspec.DecodeError:
        return name, value


def _amounts(option: str, texts: Sequence[str]) -> dict[str, float]:
    found = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            raise UsageError(f"{option} {text}: expected FIELD=NUMBER") from None
    return found


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
    print_table(("fault", "detected by", "s", "effect"), [
        (f.name, " ".join(faults.named[f.name].detected_by if f.name in faults.named else ()),
         "inf" if f.duration_s is None else f"{f.duration_s:g}", f.title)
        for f in faults.offered()])
    say()
    say("any topic, as MODE:TOPIC:")
    modes = {resolve(key, known)[0].key: " ".join(modes_of(key, known)) for key in keys}
    print_table(("topic", "modes"), [row for row in modes.items() if row[1]])
    say()
    others = [name for names in faults.others.values() for name in names]
    if others:
        say(f"of the robot, with details after a colon: {', '.join(others)}")
    say(f"any process, only from the start of a run by --fault: {', '.join(PROCESS_FAULTS)}, as "
        f"kill:NODE; NODE is one of {', '.join(can_be_hit(spec))}")


# -- the work -----------------------------------------------------------------------------------


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
                    time = ("until its process ends" if watch.is_permanent
                            else f"for {watch.waits_s:g} s")
                    say(f"{name}: in force at {', '.join(watch.nodes)} {time}")
            await pause(settled, session.real_s(max(w.waits_s for w in watches)) + 1.0)
            if not settled.is_set():
                await _end(session, [w for w in watches if w.is_permanent])
        except asyncio.CancelledError:
            await _end(session, watches)
            raise
    if options.json:
        _print_result(name, watches)
    for watch in watches:
        _judge(watch)
        if not options.json:
            say(f"{name}: {_outcome(watch)}")
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


def _outcome(watch: FaultWatch) -> str:
    """Return what a fault has changed, in words."""
    what = "messages" if _is_of_topic(watch) else "ticks"
    if not watch.is_settled:  # a fault ends with the process that carries it out, as its count does
        return (f"at least {watch.affected} {what} changed, until {', '.join(watch.nodes)} was "
                "restarted")
    return ("takes effect, and continues" if watch.unfinished else
            f"over, {watch.affected} {what} changed")


def _is_of_topic(watch: FaultWatch) -> bool:
    """Whether a fault disturbs a topic; a node of the robot carries out other faults."""
    return watch.orders[0].topic == bus_topics.INJECT


def _print_result(name: str, watches: list[FaultWatch]) -> None:
    """Print the result as JSON, with null as the duration of a permanent fault."""
    print_json({
        "fault": name,
        "effective": all(w.affected > 0 for w in watches),
        "injections": [
            {"id": order.injection, "topic": w.orders[0].place,
             "mode": order.mode if _is_of_topic(w) else None,
             "nodes": list(w.nodes), "duration_s": order.duration_s,
             "affected": w.affected, "finished": not w.unfinished, "reason": _refused(w)}
            for w in watches for order in [w.orders[0].message]]})
