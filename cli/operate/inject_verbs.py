"""`rampart inject`: inject a fault of the catalogue, or one that the options describe."""

from __future__ import annotations

import argparse
import math
import uuid
from collections.abc import Coroutine, Sequence
from typing import Any

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import bare
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.runtime.corruption import field_type, is_array
from rampart.actors.runtime.fault_watch import Order
from rampart.actors.runtime.injection import MODES, flaw
from rampart.actors.system.layout import published_keys
from rampart.actors.system.topics import system_topics
from rampart.cli import completion, systems
from rampart.cli.look.topic_catalogue import resolve, topics_for
from rampart.cli.operate.injecting import hit_process, refuse_details, run_fault
from rampart.cli.operate.operator_verbs import trigger
from rampart.cli.output import UsageError, positive, print_json, print_table, say
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
        return hit_process(options)
    if options.fault.startswith(TRIGGER):
        return trigger(argparse.Namespace(
            port=options.port, module=options.fault.removeprefix(TRIGGER),
            duration=options.duration or _DEFAULT_DURATION_S))
    positive("--duration", options.duration, "must be seconds above 0, or inf")
    name, orders = orders_of(options)
    return run_fault(name, orders, options)


def orders_of(options: argparse.Namespace) -> tuple[str, tuple[Order, ...]]:
    """Return the name of the fault, and the orders to the nodes that carry it out.

    Raises:
        UsageError: there is no such fault, or an option does not fit it.
    """
    unique = uuid.uuid4().hex[:6]
    own = faults_of(systems.at_hand(None, options.port)).own(
        options.fault, f"{options.fault}-{unique}", options.duration)
    if own is not None:
        refuse_details(options)
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
    say(f"any topic, as MODE:TOPIC; MODE is one of {', '.join(MODES)}:")
    print_table(("topic", "modes"), list(_modes_by_topic(keys, known).items()))
    say()
    say(f"nonsense readings, as MODE:TOPIC; MODE is one of {', '.join(NONSENSE)}:")
    print_table(("topic", "modes"), [
        (key, ", ".join(nonsense)) for key in keys
        if (nonsense := [mode for mode in modes_of(key, known) if mode in NONSENSE])])
    say()
    others = [name for names in faults.others.values() for name in names]
    if others:
        say("of the robot, with details after a colon:")
        for name in others:
            say(f"  {name}")
        say()
    say("any process: kill:NODE, stop:NODE, wedge:NODE; with --fault also hang:NODE and stop:all; "
        f"slow:NODE or slow:all in virtual time; NODE is one of {', '.join(can_be_hit(spec))}")


def _modes_by_topic(keys: tuple[str, ...], known: tuple[Topic[Any], ...]) -> dict[str, str]:
    """Return key → modes in words, with one row for each family."""
    rows: dict[str, str] = {}
    for key in keys:
        if modes := modes_of(key, known):
            missing = [mode for mode in MODES if mode not in modes]
            rows[resolve(key, known)[0].key] = f"all but {', '.join(missing)}" if missing else "all"
    return {topic.key: rows[topic.key] for topic in known if topic.key in rows}
