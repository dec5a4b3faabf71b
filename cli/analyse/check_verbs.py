"""`rampart check` and `rampart explain`: soundness of a system, and what its detections cause."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rampart.actors.foreign.program import wrong_programs
from rampart.cli import systems
from rampart.cli.output import print_json, print_table, say, warn
from rampart.cli.verbs import JSON, add_verb, flag
from rampart.manager.analysis.pairs import Pair, pairs
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.escalation import succession
from rampart.manager.strategies.registry import decide

_ROOT = "root"


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    add_verb(verbs, "check", "check a system without running it", check,
             systems.choice(), JSON)
    add_verb(verbs, "explain", "list the consequence of each detection", run,
             systems.choice(), flag("--pairs", "list what is decided for each ordered pair of "
                                    "mechanisms, and what stays when one of them clears"), JSON)


def run(options: argparse.Namespace) -> int:
    """Explain a system.

    Explain the consequence of each detection: its mechanisms, the recovery that is
    chosen if nothing else is active, and the next one if that fails. `rampart topic
    info` lists publishers and readers of a topic, `rampart node list` the processes of
    a run.

    Examples:
      rampart explain
      rampart explain my_system.toml
      rampart explain paper --json
      rampart explain --pairs

    exit code: 0 described, 2 `rampart check` refuses the system, or bad usage
    """
    spec = systems.check(options.system).spec
    if options.pairs:
        table = pairs(spec)
        if options.json:
            print_json(table)
        else:
            _show_pairs(spec, table)
        return 0
    found = list(_consequences(spec))
    if options.json:
        print_json({"system": spec.name, "title": spec.title, "strategy": spec.strategy,
                    "consequences": found})
    else:
        _show(spec, found)
    return 0


def _consequences(spec: SystemSpec) -> Iterator[dict[str, Any]]:
    """Yield the consequence of each detection, if no other module detects anything.

    `within_s` is its latency in simulated seconds. `mechanisms` use the module; `active` are those
    of them that are active, and `needs` has the gate of each other one. `decided` are the
    recoveries that the system's strategy chooses, and `escalation` has for each of them those that
    follow as one after the other fails.
    """
    if not spec.mechanisms:
        return
    mechanisms, tree, order = spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order()
    arrangement = Arrangement(mechanisms, tree, order)
    for detection in spec.detections:
        name = detection.name
        listening = tuple(m.name for m in spec.mechanisms if name in m.detections)
        active = mechanisms.detected_by([name])
        decision = decide(active, mechanisms, tree, order, spec.strategy)
        escalation = {}
        for recovery in decision.recoveries:
            sakes = [m for m in decision.mechanisms if recovery in mechanisms.recover[m]]
            escalation[recovery] = tuple(succession(
                recovery, sakes or decision.mechanisms, mechanisms.contracts, arrangement)[1:])
        needs = {m.name: m.detect for m in spec.mechanisms
                 if m.name in listening and m.name not in active}
        yield {"detection": name, "title": detection.title,
               "within_s": spec.latency_s(detection), "mechanisms": listening, "active": active,
               "needs": needs, "decided": decision.recoveries, "rule": str(decision.rule),
               "escalation": escalation}


def _show_pairs(spec: SystemSpec, table: Sequence[Pair]) -> None:
    """Print what runs for each pair, and the pairs in which more stays than one asks for alone."""
    found = {(pair.first, pair.second): pair for pair in table}
    names = [mechanism.name for mechanism in spec.mechanisms]
    own = spec.build_mechanisms().recover
    say(f"{spec.title} ({spec.name}), strategy {spec.strategy}")
    say()
    say("Recoveries in force while the mechanism of the row and then that of the column is active;")
    say("on the diagonal, that of one mechanism alone")
    print_table(("", *names), [(first, *(
        _joined(own[first] if first == second else found[first, second].both)
        for second in names)) for first in names])
    say()
    say("When one of two clears, the other's recovery stays alone, except here")
    head = "active first", "then", "in force", "first clears", "second clears", "both clear"
    print_table(head, [
        (pair.first, pair.second, *map(_joined, (
            pair.both, pair.first_clears, pair.second_clears, pair.both_clear)))
        for pair in table
        if (pair.first_clears, pair.second_clears) != (own[pair.second], own[pair.first])])


def _joined(recoveries: Sequence[str]) -> str:
    return " + ".join(recoveries) or "-"


def _show(spec: SystemSpec, found: Sequence[Mapping[str, Any]]) -> None:
    say(f"{spec.title} ({spec.name}), strategy {spec.strategy}")
    say()
    say("Consequence of each detection, if no other module detects anything")
    for each in found:
        say(f"  {each['detection']} ({each['title']}, within {each['within_s']:g} s) -> "
            f"{', '.join(each['mechanisms'])} -> {_decided(each)}")


def _decided(found: Mapping[str, Any]) -> str:
    if not found["active"]:
        return "none: " + "; ".join(
            f"{name} needs {gate}" for name, gate in found["needs"].items())
    return ", ".join(
        f"{name}; if it fails: {' > '.join(after)}" if (after := found["escalation"][name])
        else f"{name}, the last resort" for name in found["decided"]) or "no recovery"


def check(options: argparse.Namespace) -> int:
    """Check a system, and print its first problem, or its size.

    Check everything that can be checked before a run, as a start does:
    specification, time budgets, classes and parameters of all actors, application
    and judge, and that each topic with a reader has a publisher. The program of a
    command may be on another machine: one that is missing here is a warning.

    Examples:
      rampart check
      rampart check my_system.toml && rampart run --system my_system.toml
      rampart check paper --json

    exit code: 0 sound, 2 not sound (one line shows where) or bad usage
    """
    try:
        layout = systems.check(options.system)
    except ValueError as error:
        if not options.json:
            raise
        print_json({"sound": False, "problem": str(error)})
        return 2
    spec = layout.spec
    for missing in wrong_programs(layout.plan, spec):
        warn(f"{missing}; a run on this machine is refused")
    sizes = {"processes": len(layout.units), "nodes": len(spec.nodes),
             "detection modules": len(spec.detections), "recovery modules": len(spec.recoveries),
             "mechanisms": len(spec.mechanisms)}
    if options.json:
        print_json({"sound": True, "problem": None, "system": spec.name,
                    "file": layout.plan.system_file,
                    **{name.replace(" ", "_"): count for name, count in sizes.items()}})
    else:
        say(f"{layout.plan.system_file}: sound: "
            f"{', '.join(f'{count} {name}' for name, count in sizes.items())}")
    return 0
