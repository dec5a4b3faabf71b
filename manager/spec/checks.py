"""Whether a system spec makes sense: names, cycles, the tree, the order, the time budget.

One small validator per concern; each yields what it finds wrong as a `Finding`. They run in
sequence and the first finding is the one reported, so a validator may rely on those before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from functools import reduce
from itertools import chain, permutations, product
from operator import or_
from typing import Any, NamedTuple

import msgspec

from rampart.manager.model.fault_tree import FaultTreeError
from rampart.manager.model.gates import WORDS, GateError, detection_gate, recovery_gate
from rampart.manager.model.order import CycleError, PartialOrder, find_cycle
from rampart.manager.spec.budget import braking_distance_m, check, find_false_alarms
from rampart.manager.spec.schema import NODE_KINDS, Hazard, Kind, Robot, SystemSpec
from rampart.manager.strategies.registry import STRATEGIES

SUPERVISOR = "supervisor"
MANAGER_CLASS = "rampart.manager.actor:FtmManager"
RESERVED = frozenset({
    SUPERVISOR, "spawner", "spawner_a", "spawner_b", "launch", "observer", "injector"})


class Finding(NamedTuple):
    """Something wrong: where, what, and the offending value if one value is to blame."""

    path: str
    problem: str
    value: tuple[Any, ...] = ()


def find_nonsense(spec: SystemSpec) -> Finding | None:
    """Return the first thing wrong with a spec that is well-typed, or None."""
    for validator in VALIDATORS:
        for finding in validator(spec):
            return finding
    return None


def find_nonsense_of_rest(spec: SystemSpec) -> Finding | None:
    """Return the first thing wrong with what is left of a sound spec when some is disabled."""
    if not spec.mechanisms:
        return Finding("$.mechanism", "no mechanism is left enabled; at least one must be")
    off = {recovery.name for recovery in spec.recoveries if not recovery.enabled}
    for index, recovery in enumerate(spec.recoveries):
        if recovery.enabled and recovery.escalate_to in off:
            return Finding(f"$.recovery[{index}].escalate_to",
                           f"{recovery.name} escalates to it, and it is disabled",
                           (recovery.escalate_to,))
    for validator in (_fault_tree, _criteria, _order_against_tree, _budget):
        for finding in validator(spec):
            return finding
    return None


def _unknown(path: str, value: str, what: str, known: Collection[str]) -> Finding:
    return Finding(path, f"unknown {what}; known: {', '.join(known) or 'none'}", (value,))


def modules(spec: SystemSpec) -> Iterator[tuple[str, str, str, str]]:
    """Yield path, name, process and respawner of all nodes, detection and recovery modules."""
    for i, node in enumerate(spec.nodes):
        yield f"$.node[{i}]", node.name, node.process, node.respawn
    for i, detection in enumerate(spec.detections):
        yield f"$.detection[{i}]", detection.name, detection.process, SUPERVISOR
    for i, recovery in enumerate(spec.recoveries):
        yield f"$.recovery[{i}]", recovery.name, recovery.process, SUPERVISOR


def _names(spec: SystemSpec) -> Iterator[Finding]:
    taken = dict.fromkeys(RESERVED, "reserved")
    named = [(path, name, process) for path, name, process, _ in modules(spec)]
    named += [(f"$.mechanism[{i}]", m.name, "") for i, m in enumerate(spec.mechanisms)]
    for path, name, process in named:
        if name in WORDS:
            yield Finding(f"{path}.name", "a word of gates, no name", (name,))
        if name in taken:
            yield Finding(f"{path}.name", f"duplicate name, {taken[name]}; nodes, detection and "
                          "recovery modules and mechanisms share one namespace", (name,))
        taken[name] = f"already at {path}.name"
        if process in RESERVED:
            yield Finding(f"{path}.process", "reserved; nothing else can live in it", (process,))
    events: dict[str, int] = {}
    for index, event in enumerate(spec.events):
        if event.name in events:
            yield Finding(f"$.event[{index}].name", "duplicate name, already at "
                          f"$.event[{events[event.name]}].name", (event.name,))
        events[event.name] = index


def _nodes(spec: SystemSpec) -> Iterator[Finding]:
    respawners = [SUPERVISOR, *(r.name for r in spec.recoveries)]
    for index, node in enumerate(spec.nodes):
        path = f"$.node[{index}]"
        if node.kind in {Kind.DETECTION, Kind.RECOVERY}:
            yield Finding(f"{path}.kind", f"belongs into [[{node.kind.value}]]", (node.kind.value,))
        if node.kind not in NODE_KINDS:
            yield _unknown(f"{path}.kind", node.kind.value, "kind", NODE_KINDS)
        if node.actor == MANAGER_CLASS and node.kind is not Kind.MANAGER:
            yield Finding(f"{path}.kind", f"{node.actor} has to be of kind 'manager'",
                          (node.kind.value,))
        if node.respawn not in respawners:
            yield _unknown(f"{path}.respawn", node.respawn, "recovery module", respawners)
        if node.kind is Kind.MANAGER and node.respawn != SUPERVISOR:
            yield Finding(f"{path}.respawn", "the manager cannot command its own recovery; only "
                                             f"{SUPERVISOR!r} is right", (node.respawn,))
    yield from _sole_nodes(spec)


def _sole_nodes(spec: SystemSpec) -> Iterator[Finding]:
    for kind in (Kind.MANAGER, Kind.PILOT):
        found = [(index, node.name) for index, node in enumerate(spec.nodes) if node.kind is kind]
        if len(found) > 1:
            yield Finding(f"$.node[{found[1][0]}].kind", f"{found[0][1]} is of this kind already; "
                          f"a system has one {kind.value} at most", (kind.value,))
        if kind is Kind.MANAGER and not found and spec.mechanisms and spec.layers.ftm:
            yield Finding("$.node", "no node is of kind 'manager', so no mechanism would act; add "
                          f"one with actor = {MANAGER_CLASS!r}, or say ftm = false in [layers]")


def _processes(spec: SystemSpec) -> Iterator[Finding]:
    """Actors of one process come back together: all by the same hand, and none by its own."""
    lives_in = {name: process or name for _, name, process, _ in modules(spec)}
    first: dict[str, tuple[str, str]] = {}
    for path, name, _, respawn in modules(spec):
        other, by = first.setdefault(lives_in[name], (name, respawn))
        if respawn != by:
            yield Finding(f"{path}.process", f"{other} lives there too and is brought back by {by},"
                          f" {name} by {respawn}; who shares a process is brought back by the same",
                          (lives_in[name],))
    managers = {lives_in[node.name] for node in spec.nodes if node.kind is Kind.MANAGER}
    for index, recovery in enumerate(spec.recoveries):
        for place, name in enumerate(recovery.parameters.get("nodes", ())):
            if lives_in[name] in managers:
                yield Finding(f"$.recovery[{index}].parameters.nodes[{place}]", "the manager lives "
                              "in its process, and cannot command its own recovery", (name,))
            if lives_in[name] == lives_in[recovery.name]:
                yield Finding(f"$.recovery[{index}].parameters.nodes[{place}]", f"{recovery.name} "
                              "lives in its process, and would end itself", (name,))


def _detections(spec: SystemSpec) -> Iterator[Finding]:
    nodes = dict.fromkeys(node.name for node in spec.nodes)  # in sequence, and quick to look into
    for index, detection in enumerate(spec.detections):
        path = f"$.detection[{index}]"
        parameters = detection.parameters
        if "watch" in parameters:
            yield from _node_names(f"{path}.parameters.watch", parameters["watch"], nodes)
        for key in ("timeout_s", "margin_m"):
            value = parameters.get(key, 1.0)
            if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
                yield Finding(f"{path}.parameters.{key}", "expected a number > 0", (value,))
                return
        if not detection.latency_s > 0:
            yield Finding(f"{path}.within_s", "missing; say within how many seconds the module "
                                              "detects, here or as parameters.timeout_s")


def _node_names(path: str, value: object, nodes: Collection[str]) -> Iterator[Finding]:
    if not isinstance(value, list) or not value or not all(isinstance(n, str) for n in value):
        yield Finding(path, "expected a list of node names", (value,))
        return
    listed: set[str] = set()
    for place, name in enumerate(value):
        if name not in nodes:
            yield _unknown(f"{path}[{place}]", name, "node", nodes)
        if name in listed:
            yield Finding(f"{path}[{place}]", "listed twice", (name,))
        listed.add(name)


def _mechanisms(spec: SystemSpec) -> Iterator[Finding]:
    detections = dict.fromkeys(detection.name for detection in spec.detections)
    recoveries = dict.fromkeys(recovery.name for recovery in spec.recoveries)
    events = dict.fromkeys(event.name for event in spec.events)
    for index, mechanism in enumerate(spec.mechanisms):
        path = f"$.mechanism[{index}]"
        for field, text, read, what, known in (
                ("detect", mechanism.detect, detection_gate, "detection module", detections),
                ("recover", mechanism.recover, recovery_gate, "recovery module", recoveries)):
            try:
                names = read(text).names
            except GateError as error:
                yield Finding(f"{path}.{field}", str(error), (text,))
                return
            for name in names:
                if name not in known:
                    yield _unknown(f"{path}.{field}", name, what, known)
        if mechanism.event not in events:
            yield _unknown(f"{path}.event", mechanism.event, "event", events)
    if not spec.mechanisms and (spec.detections or spec.recoveries):
        yield Finding("$.mechanism", "missing; no mechanism joins detection to recovery")


def _recoveries(spec: SystemSpec) -> Iterator[Finding]:
    names = [recovery.name for recovery in spec.recoveries]
    nodes = dict.fromkeys(node.name for node in spec.nodes)
    there = {node.name for node in spec.nodes}.union(
        *(recovery.claims | recovery.disables for recovery in spec.recoveries))
    for index, recovery in enumerate(spec.recoveries):
        for need in sorted(recovery.needs):
            if need not in there:
                yield Finding(f"$.recovery[{index}].needs", f"{need!r} is neither a node nor a "
                              "resource that a recovery claims or disables; known: "
                              f"{', '.join(sorted(there))}", (sorted(recovery.needs),))
            if need in recovery.disables:
                yield Finding(f"$.recovery[{index}].disables", f"{recovery.name} itself needs "
                              f"{need!r}; leave it out of one of the two",
                              (sorted(recovery.disables),))
        if recovery.escalate_to and recovery.escalate_to not in names:
            yield _unknown(f"$.recovery[{index}].escalate_to", recovery.escalate_to,
                           "recovery module", names)
        if "nodes" in recovery.parameters:
            yield from _node_names(f"$.recovery[{index}].parameters.nodes",
                                   recovery.parameters["nodes"], nodes)
    cycle = find_cycle({r.name: [r.escalate_to] if r.escalate_to else [] for r in spec.recoveries})
    if cycle:
        yield Finding(f"$.recovery[{names.index(cycle[0])}].escalate_to",
                      f"cycle {' > '.join(cycle)}; escalation must come to an end", (cycle[1],))


def _disabling(spec: SystemSpec) -> Iterator[Finding]:
    used = {node.name for node in spec.nodes}.union(
        *(recovery.claims | recovery.needs for recovery in spec.recoveries))
    for index, recovery in enumerate(spec.recoveries):
        for name in sorted(recovery.disables - used):
            yield Finding(f"$.recovery[{index}].disables", f"{name!r} is neither a node nor a "
                          "resource that a recovery claims or needs, so nothing is disabled; "
                          f"known: {', '.join(sorted(used))}", (sorted(recovery.disables),))


def _reachability(spec: SystemSpec) -> Iterator[Finding]:
    detecting = {name for mechanism in spec.mechanisms for name in mechanism.detections}
    recovering = {name for mechanism in spec.mechanisms for name in mechanism.recoveries} | {
        recovery.escalate_to for recovery in spec.recoveries}
    for index, detection in enumerate(spec.detections):
        if detection.name not in detecting:
            yield Finding(f"$.detection[{index}].name", "unreachable: no mechanism uses this "
                                                        "detection module", (detection.name,))
    for index, recovery in enumerate(spec.recoveries):
        if recovery.name not in recovering:
            yield Finding(f"$.recovery[{index}].name", "unreachable: no mechanism and no escalation"
                                                       " leads to this recovery", (recovery.name,))
    watch = {detection.name: detection.watch for detection in spec.detections}
    answers: dict[str, set[str]] = {}
    for mechanism in spec.mechanisms:
        for name in mechanism.detections:
            answers.setdefault(name, set()).update(mechanism.recoveries)
    watched = {(node, recovery) for name, recoveries in answers.items() for node in watch[name]
               for recovery in recoveries}
    for index, node in enumerate(spec.nodes):
        if node.respawn != SUPERVISOR and (node.name, node.respawn) not in watched:
            yield Finding(f"$.node[{index}].respawn", f"node {node.name!r} is unreachable for "
                          f"{node.respawn}: no detection module that {node.respawn} answers to "
                          "watches it", (node.respawn,))


def _fault_tree(spec: SystemSpec) -> Iterator[Finding]:
    names = [event.name for event in spec.events]
    known = set(names)
    for index, event in enumerate(spec.events):
        path = f"$.event[{index}]"
        if event.of and event.gate is None:
            yield Finding(f"{path}.of", "inputs without a gate; add gate = 'or'", (event.of,))
        for place, name in enumerate(event.of):
            if name not in known:
                yield _unknown(f"{path}.of[{place}]", name, "event", names)
    try:
        tree = spec.build_fault_tree()
    except FaultTreeError as error:
        index = len(names) - 1 - names[::-1].index(error.subject) if error.subject else -1
        path = f"$.event[{index}]" if error.subject else "$.event"
        yield Finding(path, str(error), (error.subject,) if error.subject else ())
        return
    mechanisms = [mechanism.name for mechanism in spec.mechanisms]
    if not mechanisms:
        return
    try:
        tree.derive_ftm_tree({m.name: m.event for m in spec.mechanisms})
    except FaultTreeError as error:
        if error.subject:
            index = mechanisms.index(error.subject)
            yield Finding(f"$.mechanism[{index}].event", f"{error.subject}: {error}",
                          (spec.mechanisms[index].event,))
        else:
            yield Finding("$.mechanism", str(error))


def _policy(spec: SystemSpec) -> Iterator[Finding]:
    for field in ("strategy", "shadow"):
        name = getattr(spec, field)
        if name not in STRATEGIES and (name or field == "strategy"):
            yield _unknown(f"$.{field}", name, "strategy", sorted(STRATEGIES))
    if not spec.criteria:
        yield Finding("$.order", "expected the name of an order, or a list of such", ([],))
    for name in spec.criteria:
        if name not in spec.orders:
            yield _unknown("$.order", name, "order", list(spec.orders))
        if spec.criteria.count(name) > 1:
            yield Finding("$.order", f"{name!r} is listed twice", (list(spec.criteria),))


def _orders(spec: SystemSpec) -> Iterator[Finding]:
    recoveries = dict.fromkeys(recovery.name for recovery in spec.recoveries)
    for name, relation in spec.orders.items():
        for upper, lowers in relation.items():
            path = f"$.orders.{name}.{upper}"
            if upper not in recoveries:
                yield _unknown(path, upper, "recovery module", recoveries)
            listed: set[str] = set()
            for place, lower in enumerate(lowers):
                if lower not in recoveries:
                    yield _unknown(f"{path}[{place}]", lower, "recovery module", recoveries)
                if lower in listed:
                    yield Finding(f"{path}[{place}]", "duplicate", (lower,))
                listed.add(lower)
        try:
            spec.build_order(name)
        except CycleError as error:
            yield Finding(f"$.orders.{name}.{error.cycle[0]}",
                          f"{error}; no recovery can be above itself",
                          (list(relation[error.cycle[0]]),))


def _criteria(spec: SystemSpec) -> Iterator[Finding]:
    try:
        spec.build_order()
    except CycleError as error:
        yield Finding("$.order", f"the criteria contradict each other, {error}; leave one out or "
                                 "let them agree", (list(spec.criteria),))


def _compounds(spec: SystemSpec) -> Iterator[Finding]:
    """Recoveries that one mechanism runs together must be able to run together."""
    contracts = spec.build_mechanisms().contracts
    for index, mechanism in enumerate(spec.mechanisms):
        ways = recovery_gate(mechanism.recover).alternatives()
        together = dict.fromkeys(chain.from_iterable(permutations(way, 2) for way in ways))
        for one, other in together:
            shared = contracts[one].claims & contracts[other].claims
            harmed = contracts[one].disables & contracts[other].needs
            if shared or harmed:
                yield Finding(f"$.mechanism[{index}].recover", (
                    f"{one} and {other} both claim {', '.join(sorted(shared))}" if shared else
                    f"{one} disables {', '.join(sorted(harmed))}, which {other} needs"
                    ) + "; they cannot run together", (mechanism.recover,))


def _order_against_tree(spec: SystemSpec) -> Iterator[Finding]:
    if not spec.mechanisms:
        return
    order, tree = spec.build_safety_order(), spec.build_ftm_tree()
    safer = spec.criteria[0]
    recover = {mechanism.name: mechanism.recoveries for mechanism in spec.mechanisms}
    own = {name: order.mask(names) for name, names in recover.items()}
    under = {name: reduce(or_, (order.below[order.number[r]] for r in names))
             for name, names in recover.items()}
    for upper in tree.names:
        for lower in tree.members(tree.below[tree.number[upper]]):
            if not under[lower] & own[upper]:
                continue
            for above, below in product(recover[lower], recover[upper]):
                if order.is_above(above, below):
                    yield Finding(
                        f"$.orders.{safer}.{above}",
                        f"contradicts the FTMTree: {above} of {lower} is above {below} of {upper}, "
                        f"but {upper} is above {lower}",
                        (list(spec.orders[safer].get(above, ())),))
    for index, recovery in enumerate(spec.recoveries):
        if recovery.escalate_to and order.is_above(recovery.name, recovery.escalate_to):
            yield Finding(f"$.recovery[{index}].escalate_to",
                          f"{recovery.name} is above it in the order {safer!r}; escalation "
                          "must not lead to less", (recovery.escalate_to,))
    for last_resort in recover[tree.root]:
        yield from _undelayed(spec, order, last_resort)


def _undelayed(spec: SystemSpec, order: PartialOrder, last_resort: str) -> Iterator[Finding]:
    """A recovery of the FTMTree's root is a last resort: nothing may make it wait."""
    contracts = spec.build_mechanisms().contracts
    names = [recovery.name for recovery in spec.recoveries]
    for name in order.names:
        shared = contracts[name].claims & contracts[last_resort].claims
        if name != last_resort and shared:
            yield Finding(f"$.recovery[{names.index(name)}].claims",
                          f"{last_resort}, the last resort, would have to wait for {name}, which "
                          f"claims {', '.join(sorted(shared))} as well",
                          (sorted(contracts[name].claims),))


def _timing(spec: SystemSpec) -> Iterator[Finding]:
    timing = spec.timing
    if spec.mobile is not None:
        yield from _room(spec.mobile)
    else:
        for field, value in msgspec.structs.asdict(timing).items():
            if math.isnan(value):
                yield Finding(f"$.timing.{field}", "missing; it is derived from [robot], and this "
                                                   "system has none")
    if timing.release_hold_max_s < timing.release_hold_s:
        yield Finding("$.timing.release_hold_max_s", "must be no less than release_hold_s = "
                      f"{timing.release_hold_s}", (timing.release_hold_max_s,))
    for path, value, problem in find_false_alarms(spec):
        yield Finding(path, problem, (value,))


def _room(robot: Robot) -> Iterator[Finding]:
    braking_m = braking_distance_m(robot, robot.top_speed_mps)
    for field in ("corridor_clearance_m", "stop_distance_m"):
        room_m = getattr(robot, field)
        if room_m <= braking_m:
            yield Finding(f"$.robot.{field}", f"too little to brake in; from top_speed_mps the "
                          f"robot takes {braking_m:.3f} m", (room_m,))
    if robot.hardware_speed_mps < robot.top_speed_mps:
        yield Finding("$.robot.hardware_speed_mps", "the drive cannot be slower than top_speed_mps "
                      f"= {robot.top_speed_mps}", (robot.hardware_speed_mps,))
    if robot.sensing_range_m <= robot.stop_distance_m:
        yield Finding("$.robot.sensing_range_m", "obstacles must be seen before they are nearer "
                      f"than stop_distance_m = {robot.stop_distance_m}", (robot.sensing_range_m,))


def _budget(spec: SystemSpec) -> Iterator[Finding]:
    root = spec.build_ftm_tree().root if spec.mechanisms else ""
    detections = {detection.name: detection for detection in spec.detections}
    for index, mechanism in enumerate(spec.mechanisms):
        if spec.mobile is None and mechanism.against is Hazard.DRIFT:
            yield Finding(f"$.mechanism[{index}].against", "'drift', which it is if left out, "
                          "needs a [robot]; 'parent' or { within_s = ..., hazard = '...' } is "
                          "right")
        if spec.mobile is None and mechanism.against in {Hazard.RUNAWAY, Hazard.INTRUSION}:
            yield Finding(f"$.mechanism[{index}].against", "needs a [robot]; 'parent' or "
                          "{ within_s = ..., hazard = '...' } is right", (mechanism.against.value,))
        if mechanism.against is Hazard.PARENT and mechanism.name == root:
            yield Finding(f"$.mechanism[{index}].against", f"{root} is the root of the FTMTree and "
                          "has no parent to be faster than", (mechanism.against.value,))
        if mechanism.against is Hazard.INTRUSION and \
                any("margin_m" not in detections[name].parameters
                    for name in mechanism.detections):
            yield Finding(f"$.mechanism[{index}].against", f"{mechanism.detect} needs "
                          "parameters.margin_m, the distance at which it warns",
                          (mechanism.against.value,))
    for index, detection in enumerate(spec.detections):
        margin_m = detection.parameters.get("margin_m", 0.0)
        if spec.mobile is not None and margin_m >= spec.robot.corridor_clearance_m:
            yield Finding(f"$.detection[{index}].parameters.margin_m", "would raise false alarms; "
                          "it must be below corridor_clearance_m = "
                          f"{spec.robot.corridor_clearance_m:g}", (margin_m,))
    for budget in check(spec):
        if not budget.fits:
            yield Finding("$.timing", f"the time budget does not fit: {budget}")


VALIDATORS: tuple[Callable[[SystemSpec], Iterator[Finding]], ...] = (
    _timing, _names, _nodes, _detections, _recoveries, _disabling, _processes, _mechanisms,
    _reachability, _fault_tree, _policy, _orders, _criteria, _compounds, _order_against_tree,
    _budget)
