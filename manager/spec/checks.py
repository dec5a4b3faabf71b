"""Whether a system spec makes sense: names, nodes, processes, modules, and what others check.

One small validator per concern; each yields what it finds wrong as a `Finding`. They run in
sequence and the first finding is the one reported, so a validator may rely on those before it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import chain

from rampart.manager.model.gates import WORDS, GateError, detection_gate, recovery_gate
from rampart.manager.model.order import find_cycle
from rampart.manager.spec import arbitration_checks, time_checks
from rampart.manager.spec.schema import NODE_KINDS, Kind, SystemSpec
from rampart.manager.spec.tables import Finding, unknown

Validator = Callable[[SystemSpec], Iterator[Finding]]

SUPERVISOR = "supervisor"
MANAGER_CLASS = "rampart.manager.actor:FtmManager"
RESERVED = frozenset({
    SUPERVISOR, "spawner", "spawner_a", "spawner_b", "launch", "observer", "injector"})


def find_nonsense(spec: SystemSpec) -> Finding | None:
    """Return the first thing wrong with a spec that is well-typed, or None."""
    return _first(spec, VALIDATORS)


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
    return _first(spec, (
        arbitration_checks.find_wrong_tree, arbitration_checks.find_contradictions,
        arbitration_checks.find_wrong_precedence, time_checks.find_wrong_budget))


def _first(spec: SystemSpec, validators: Iterable[Validator]) -> Finding | None:
    return next(chain.from_iterable(validator(spec) for validator in validators), None)


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
            yield unknown(f"{path}.kind", node.kind.value, "kind", NODE_KINDS)
        if node.actor == MANAGER_CLASS and node.kind is not Kind.MANAGER:
            yield Finding(f"{path}.kind", f"{node.actor} has to be of kind 'manager'",
                          (node.kind.value,))
        if node.respawn not in respawners:
            yield unknown(f"{path}.respawn", node.respawn, "recovery module", respawners)
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
            yield unknown(f"{path}[{place}]", name, "node", nodes)
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
                    yield unknown(f"{path}.{field}", name, what, known)
        if mechanism.event not in events:
            yield unknown(f"{path}.event", mechanism.event, "event", events)
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
            yield unknown(f"$.recovery[{index}].escalate_to", recovery.escalate_to,
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


VALIDATORS: tuple[Validator, ...] = (
    time_checks.find_wrong_times, _names, _nodes, _detections, _recoveries, _disabling, _processes,
    _mechanisms, _reachability, arbitration_checks.find_wrong_tree,
    arbitration_checks.find_wrong_policy, arbitration_checks.find_wrong_orders,
    arbitration_checks.find_contradictions, arbitration_checks.find_wrong_compounds,
    arbitration_checks.find_wrong_precedence, time_checks.find_wrong_budget)
