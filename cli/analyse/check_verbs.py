"""`rampart check` and `explain`: is a system sound, and what is it, before it is started."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import msgspec

from rampart.actors.detection.watchdog import Watchdog
from rampart.actors.runtime.run_plan import OBSERVER, SUPERVISOR
from rampart.actors.supervision.process_title import POOL, RUN
from rampart.actors.system.layout import Layout, Unit
from rampart.cli import systems
from rampart.cli.look import topic_catalogue as catalogue
from rampart.cli.output import UsageError, print_json, print_table, say
from rampart.cli.verbs import JSON, add_verb
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.escalation import succession
from rampart.manager.strategies.registry import decide

_ROOT = "root"


class Process(msgspec.Struct, frozen=True):
    """A process that is started: its actors by name and class, and who brings it back, if any."""

    name: str
    nodes: dict[str, str]
    kind: str
    brought_back_by: str


class Talk(msgspec.Struct, frozen=True):
    """A topic of the system itself, and who talks on it."""

    topic: str
    message: str
    from_: tuple[str, ...] = msgspec.field(name="from")
    to: tuple[str, ...]


class Guard(msgspec.Struct, frozen=True):
    """Who notices that something is dead, stopped or hung, and what it is."""

    by: str
    of: tuple[str, ...]
    does: str


class Consequence(msgspec.Struct, frozen=True):
    """What a detection leads to when it alone is active.

    Attributes:
        detection: The module.
        title: What it detects.
        within_s: How soon.
        mechanisms: That listen to it.
        active: Those of them that are active when nothing else is detected.
        needs: For each of the others, what has to be detected.
        decided: What the manager runs then, by the system's strategy.
        rule: By which rule of the strategy.
        escalation: For each of these, what follows while one after the other fails.
    """

    detection: str
    title: str
    within_s: float
    mechanisms: tuple[str, ...]
    active: tuple[str, ...]
    needs: dict[str, str]
    decided: tuple[str, ...]
    rule: str
    escalation: dict[str, tuple[str, ...]]


class Explanation(msgspec.Struct, frozen=True):
    """What a system is."""

    system: str
    title: str
    strategy: str
    processes: tuple[Process, ...]
    talks: tuple[Talk, ...]
    guards: tuple[Guard, ...]
    consequences: tuple[Consequence, ...]


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    add_verb(verbs, "check", "check a system without running it", check,
             systems.choice(), JSON)
    add_verb(verbs, "explain", "list processes, topics and consequences of detections", run,
             systems.choice(), JSON)


def run(options: argparse.Namespace) -> int:
    """Explain a system.

    Describe a system: its processes and their actors, publishers and readers of
    each topic, which part watches and restarts which, and the consequence of each
    detection. That is: its mechanisms, the recovery that is chosen if nothing else
    is active, and the next one if that fails.

    Examples:
      rampart explain
      rampart explain my_system.toml
      rampart explain paper --json

    exit code: 0 described, 2 `rampart check` refuses the system, or bad usage
    """
    found = explain(systems.check(options.system))
    if options.json:
        print_json(found)
    else:
        _show(found)
    return 0


def explain(layout: Layout) -> Explanation:
    """Return what a system is."""
    spec = layout.spec
    return Explanation(
        spec.name, spec.title, spec.strategy, tuple(_processes(layout)),
        tuple(_talks(spec)), tuple(_guards(layout)), tuple(_consequences(spec)))


def _processes(layout: Layout) -> Iterator[Process]:
    for name, parent in ((_ROOT, ""), (RUN, ""), (SUPERVISOR, _ROOT), (POOL, _ROOT)):
        yield Process(name, {}, "supervision", parent)
    for name in layout.routers:
        yield Process(name, {}, "supervision", SUPERVISOR)
    for unit in layout.units.values():
        yield Process(unit.name, {node.name: node.actor for node in unit.nodes}, unit.kind,
                      _respawner(layout, unit))


def _respawner(layout: Layout, unit: Unit) -> str:
    """Return who brings a process back; without the world it would be another run."""
    ours = unit.kind != Kind.WORLD.value and layout.spec.layers.supervisor_respawn
    return unit.respawn if unit.respawn != SUPERVISOR or ours else ""


def _talks(spec: SystemSpec) -> Iterator[Talk]:
    for use in catalogue.uses(spec):
        readers = tuple(name for name in use.readers if name != OBSERVER)
        publishers = use.publishers
        if publishers == ("tools",) and not use.topic.outside:
            publishers = ()  # a node can do without
        if readers in {(), (SUPERVISOR,)} or "every node" in (*publishers, *readers):
            continue
        yield Talk(use.topic.key, use.topic.type.__name__, publishers, readers)


def _guards(layout: Layout) -> Iterator[Guard]:
    yield Guard(_ROOT, (SUPERVISOR, POOL), "restarts it")
    by: dict[str, list[str]] = {SUPERVISOR: list(layout.routers)}
    for unit in layout.units.values():
        by.setdefault(_respawner(layout, unit), []).append(unit.name)
    by.pop("", None)
    for name, units in by.items():
        yield Guard(name, tuple(units), "restarts it" if name == SUPERVISOR
                    else "has it restarted, when the manager decides so")
    for member in layout.members.values():
        if isinstance(member.parameters, Watchdog.Parameters):
            yield Guard(member.name, member.parameters.watch,
                        "notices that it is dead, stopped or hung")


def _consequences(spec: SystemSpec) -> Iterator[Consequence]:
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
        yield Consequence(name, detection.title, detection.latency_s, listening, active, needs,
                          decision.recoveries, str(decision.rule), escalation)


def _show(found: Explanation) -> None:
    count = sum(len(process.nodes) for process in found.processes)
    say(f"{found.title} ({found.system}), strategy {found.strategy}")
    say()
    say(f"What is started: {len(found.processes)} processes, {count} nodes")
    print_table(("process", "kind", "brought back by", "nodes"), [
        (p.name, p.kind, p.brought_back_by or "nobody", ", ".join(
            f"{name} ({actor.partition(':')[2]})" for name, actor in p.nodes.items()))
        for p in found.processes])
    say()
    say(f"Who talks to whom: {len(found.talks)} topics")
    print_table(("topic", "from", "to"), [
        (talk.topic, ", ".join(talk.from_) or "nobody", ", ".join(talk.to))
        for talk in found.talks])
    say()
    say("Who guards whom")
    for guard in found.guards:
        say(f"  {guard.by}: {', '.join(guard.of)}: {guard.does}")
    say()
    say("What a detection leads to, when nothing else is detected")
    for each in found.consequences:
        say(f"  {each.detection} ({each.title}, within {each.within_s:g} s) -> "
            f"{', '.join(each.mechanisms)} -> {_decided(each)}")


def _decided(found: Consequence) -> str:
    if not found.active:
        return "nothing by itself: " + "; ".join(
            f"{name} needs {gate}" for name, gate in found.needs.items())
    told = []
    for name in found.decided:
        after = found.escalation[name]
        told.append(f"{name}; if it fails: {' > '.join(after)}" if after
                    else f"{name}, the last resort")
    return ", ".join(told) or "no recovery"


def check(options: argparse.Namespace) -> int:
    """Check a system, and say what is wrong with it, or how large it is.

    Check everything that can be checked before a run, as a start does:
    specification, time budgets, classes and parameters of all actors, application
    and judge, and that each topic with a reader has a publisher.

    Examples:
      rampart check
      rampart check my_system.toml && rampart run --system my_system.toml
      rampart check paper --json

    exit code: 0 sound, 2 not sound (one line shows where) or bad usage
    """
    try:
        layout = systems.check(options.system)
    except UsageError as error:
        if not options.json:
            raise
        print_json({"sound": False, "problem": str(error)})
        return 2
    spec = layout.spec
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
