"""Kills in a whole system: how long until a node's death is known, and until it works again.

What counts as a node's output is found out by listening: of the topics that it publishes regularly
(its class says which) the fastest that it was heard on; of a node that says nothing of its own, its
heartbeat. Detected is whatever comes first: a detection module turns active, or the supervisor
finds the process dead.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rampart.actors.bus.topic import Topic
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import DetectionState
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import Member, load_application
from rampart.cli.bench.figures import Killed, killed
from rampart.cli.bench.killing import Show, Victim, crashed, heard, in_rounds
from rampart.cli.bench.processes.observer import Heard
from rampart.cli.bench.programs import BenchError, Line
from rampart.cli.bench.systems import System
from rampart.manager.spec.nodes import Kind

WARM_S = 4.0
"""Before the first kill: the system has come to work, and what its nodes say is known."""

CALM_S = 1.0
"""Between two kills: detection modules turn idle again."""

_ALIKE = (Kind.DETECTION, Kind.RECOVERY)


def members_of(file: Path) -> dict[str, Member]:
    """Return the nodes and modules of a system that can be killed, by name: all but its world.

    Raises:
        ValueError: The system is unsound.
    """
    plan = RunPlan(system_file=str(file))
    spec = load_system(plan)
    layout = Layout(plan, spec, load_application(plan, spec))
    return {name: layout.members[name] for name in layout.unit_of
            if layout.members[name].kind is not Kind.WORLD}


def usual(members: Mapping[str, Member]) -> list[str]:
    """Return the names of those that are killed unless told otherwise.

    These are all nodes, and of the detection and the recovery modules one each: they are alike.
    """
    first = {kind: next((m.name for m in members.values() if m.kind is kind), "")
             for kind in _ALIKE}
    return [name for name, member in members.items()
            if member.kind not in _ALIKE or first[member.kind] == name]


def regular_topics(member: Member) -> list[Topic[Any]]:
    """Return what a node publishes regularly, the fastest first, and its heartbeat at last."""
    own = sorted((t for t in member.actor.outputs if t.rate_hz > 0), key=lambda t: -t.rate_hz)
    return [*own, HEARTBEAT]


def output_of(member: Member, said: Sequence[Heard]) -> str:
    """Return the key of a node's output, by what was heard; that of its heartbeat if nothing was.

    A heartbeat is sent at the start of each process, and seldom afterwards.
    """
    keys = [one.key for one in said if one.source == member.name]
    return next((key for topic in regular_topics(member) for key in keys
                 if topic.member(key) is not None), HEARTBEAT.key.replace("{name}", member.name))


def measure_restart(file: Path, names: Sequence[str], kills: int, folder: Path,
                    show: Show, *, keys: str = "") -> tuple[Killed, ...]:
    """Kill nodes of a system that runs, in rounds.

    Args:
        file: The system.
        names: Of nodes and modules.
        kills: Of each.
        folder: For checkpoints.
        show: Shows what is being done.
        keys: Folder of keys; "" for none.

    Raises:
        BenchError: The system cannot be started.
    """
    members = members_of(file)
    patterns = {topic.key.replace("{name}", "*") for name in names
                for topic in regular_topics(members[name])}
    show(f"starting {file.stem}")
    with System(file, folder, sorted(patterns), [
            topics.PROCESS_EVENT.key, topics.DECISION.key,
            topics.DETECTION.key.replace("{name}", "*")], keys) as system:
        show(f"{file.stem} comes to work")
        time.sleep(WARM_S)
        said = [one for line in list(system.ear.lines) if (one := heard(line))]
        victims = [_victim(system, name, output_of(members[name], said)) for name in names]
        for victim in victims:
            victim.wait()
        in_rounds(victims, kills, show, CALM_S)
    return tuple(killed(each.name, each.title, each.kills, each.note) for each in victims)


def _decides(line: Line) -> bool:
    found = heard(line)
    return (found is not None and found.key == topics.DECISION.key
            and bool(found.body["recoveries"]))


def _victim(system: System, name: str, key: str) -> Victim:
    def process(_found: Heard) -> int:
        running = [one for one in find_processes(system.port) if name in one.names]
        if not running:
            raise BenchError(f"{name} has no process")
        return max(running, key=lambda one: one.incarnation).pid

    is_dead = crashed(name)

    def detected(line: Line) -> bool:
        found = heard(line)
        return is_dead(line) or (
            found is not None and topics.DETECTION.member(found.key) is not None
            and found.body["state"] == DetectionState.ACTIVE.value
            and name in found.body["nodes"])

    return Victim(
        name, key, ear=system.ear, keeper=system.program,
        teller=system.ear, ended=detected, decided=_decides,
        finds=lambda found: found.source == name and found.key == key, pid_of=process)
