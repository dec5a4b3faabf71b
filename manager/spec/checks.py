"""Checks of a system spec: names, nodes, modules, hosts, trees, orders.

Each validator yields what it finds wrong. They run in sequence and only the first finding is
reported, so a validator may rely on those before it.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import chain, combinations, permutations, product

from rampart.manager.model.fault_tree import FaultTreeError
from rampart.manager.model.gates import WORDS, GateError, detection_gate, recovery_gate
from rampart.manager.model.order import CycleError, contradictions, find_cycle
from rampart.manager.spec.budget import find_wrong_budget, find_wrong_times
from rampart.manager.spec.clearing import find_wrong_clearing
from rampart.manager.spec.hosts import PORTS
from rampart.manager.spec.nodes import NODE_KINDS, Kind, find_wrong_commands
from rampart.manager.spec.schema import MechanismSpec, SystemSpec
from rampart.manager.spec.tables import Finding, find_wrong_names, numbered, unknown
from rampart.manager.strategies.registry import STRATEGIES

Validator = Callable[[SystemSpec], Iterator[Finding]]

SUPERVISOR = "supervisor"
MANAGER_CLASS = "rampart.manager.actor:FtmManager"
RESERVED = frozenset({
    SUPERVISOR, "root", "run", "pool", "router_a", "router_b", "launch", "observer", "injector"})


def find_nonsense(spec: SystemSpec) -> Finding | None:
    """Return the first thing wrong with a spec that is well-typed, or None."""
    return _first(spec, VALIDATORS)


def find_nonsense_of_rest(spec: SystemSpec) -> Finding | None:
    """Return the first thing wrong with the enabled rest of a sound spec, or None."""
    if not spec.mechanisms:
        return Finding("$.mechanism", "all are disabled; expected at least one enabled mechanism")
    off = {recovery.name for recovery in spec.recoveries if not recovery.enabled}
    for path, recovery in numbered("recovery", spec.recoveries):
        if recovery.enabled and recovery.escalate_to in off:
            return Finding(f"{path}.escalate_to", "expected an enabled recovery module",
                           (recovery.escalate_to,))
    return _first(spec, (_wrong_tree, _contradictions, _wrong_precedence, find_wrong_budget))


def _first(spec: SystemSpec, validators: Iterable[Validator]) -> Finding | None:
    return next(chain.from_iterable(validator(spec) for validator in validators), None)


def modules(spec: SystemSpec) -> Iterator[tuple[str, str, str, str]]:
    """Yield path, name, process and respawner of all nodes, detection and recovery modules."""
    for path, row in spec.placed():
        yield path, row.name, row.process, getattr(row, "respawn", SUPERVISOR)


def _names(spec: SystemSpec) -> Iterator[Finding]:
    taken = dict.fromkeys(RESERVED, "reserved")
    taken |= {f"{name}_{host.name}": "reserved" for name in RESERVED for host in spec.hosts}
    named = [(path, name, process) for path, name, process, _ in modules(spec)]
    named += [(path, m.name, "") for path, m in numbered("mechanism", spec.mechanisms)]
    for path, name, process in named:
        if name in WORDS:
            yield Finding(f"{path}.name", "expected a name that is not a word of gates", (name,))
        if name in taken:
            yield Finding(f"{path}.name", f"duplicate name, {taken[name]}; nodes, detection and "
                          "recovery modules and mechanisms share one namespace", (name,))
        taken[name] = f"already at {path}.name"
        if process in RESERVED:
            yield Finding(f"{path}.process", "reserved; expected another name", (process,))
    events: dict[str, str] = {}
    for path, event in numbered("event", spec.events):
        first = events.setdefault(event.name, path)
        if first != path:
            yield Finding(f"{path}.name", f"duplicate name, already at {first}.name", (event.name,))


def _nodes(spec: SystemSpec) -> Iterator[Finding]:
    yield from find_wrong_commands(spec.nodes)
    respawners = [SUPERVISOR, *(r.name for r in spec.recoveries)]
    for path, node in numbered("node", spec.nodes):
        kind = node.kind.value
        if node.kind in {Kind.DETECTION, Kind.RECOVERY}:
            yield Finding(f"{path}.kind", f"expected in a table [[{kind}]]", (kind,))
        if node.kind not in NODE_KINDS:
            yield unknown(f"{path}.kind", kind, "kind", NODE_KINDS)
        if node.actor == MANAGER_CLASS and node.kind is not Kind.MANAGER:
            yield Finding(f"{path}.kind", f"expected 'manager', the kind of {node.actor}", (kind,))
        if node.respawn not in respawners:
            yield unknown(f"{path}.respawn", node.respawn, "recovery module", respawners)
        if node.kind is Kind.MANAGER and node.respawn != SUPERVISOR:
            yield Finding(f"{path}.respawn", f"expected {SUPERVISOR!r}: the manager cannot command "
                          "its own recovery", (node.respawn,))
    for sole in (Kind.MANAGER, Kind.PILOT):
        found = [(path, n.name) for path, n in numbered("node", spec.nodes) if n.kind is sole]
        if len(found) > 1:
            yield Finding(f"{found[1][0]}.kind", f"expected at most one {sole.value}, and "
                          f"{found[0][1]} is one", (sole.value,))
        if sole is Kind.MANAGER and not found and spec.mechanisms and spec.layers.ftm:
            yield Finding("$.node", "no node is of kind 'manager', so no mechanism would act; add "
                          f"one with actor = {MANAGER_CLASS!r}, or set ftm = false in [layers]")


def _processes(spec: SystemSpec) -> Iterator[Finding]:
    """Actors of one process restart together: one restarter for all, and it is not among them."""
    process_of = {name: process or name for _, name, process, _ in modules(spec)}
    first: dict[str, tuple[str, str]] = {}
    for path, name, _, respawn in modules(spec):
        other, by = first.setdefault(process_of[name], (name, respawn))
        if respawn != by:
            yield Finding(f"{path}.process", f"{by} restarts {other}, which shares it, but "
                          f"{respawn} restarts {name}; expected one restarter for a process",
                          (process_of[name],))
    managers = {process_of[node.name] for node in spec.nodes if node.kind is Kind.MANAGER}
    for path, recovery in numbered("recovery", spec.recoveries):
        for place, name in enumerate(recovery.parameters.get("nodes", ())):
            at = f"{path}.parameters.nodes[{place}]"
            if process_of[name] in managers:
                yield Finding(at, "it shares the process of the manager, which cannot command its "
                              "own recovery", (name,))
            if process_of[name] == process_of[recovery.name]:
                yield Finding(at, f"it shares the process of {recovery.name}, which would end "
                              "itself", (name,))


def _detections(spec: SystemSpec) -> Iterator[Finding]:
    nodes = dict.fromkeys(node.name for node in spec.nodes)  # in sequence, and quick to look into
    for path, detection in numbered("detection", spec.detections):
        parameters = detection.parameters
        if "watch" in parameters:
            yield from _node_names(f"{path}.parameters.watch", parameters["watch"], nodes)
        for key in ("timeout_s", "margin_m"):
            value = parameters.get(key, 1.0)
            if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
                yield Finding(f"{path}.parameters.{key}", "expected a number > 0", (value,))
                return
        if not detection.latency_s > 0:
            yield Finding(f"{path}.within_s", "missing; expected the seconds in which the module "
                                              "detects, here or as parameters.timeout_s")


def _node_names(path: str, value: object, nodes: Collection[str]) -> Iterator[Finding]:
    if not isinstance(value, list) or not value or not all(isinstance(n, str) for n in value):
        yield Finding(path, "expected a list of node names", (value,))
    else:
        yield from find_wrong_names(path, value, "node", nodes, "listed twice")


def _mechanisms(spec: SystemSpec) -> Iterator[Finding]:
    detections, recoveries, events = (dict.fromkeys(row.name for row in rows) for rows in (
        spec.detections, spec.recoveries, spec.events))
    for path, mechanism in numbered("mechanism", spec.mechanisms):
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
        yield from _explanations(spec, path, mechanism)
    if not spec.mechanisms and (spec.detections or spec.recoveries):
        yield Finding("$.mechanism", "missing; expected one that joins detection to recovery")


def _explanations(spec: SystemSpec, path: str, mechanism: MechanismSpec) -> Iterator[Finding]:
    """A mechanism may explain others that explain nothing themselves."""
    others = {other.name: other.explains for other in spec.mechanisms}
    explains = sorted(mechanism.explains)
    yield from find_wrong_names(f"{path}.explains", explains, "mechanism", others, "listed twice")
    for name in explains:
        if name == mechanism.name or others.get(name):
            yield Finding(f"{path}.explains", f"{name} itself explains others; remove it from one "
                          "of the two", (explains,))


def _recoveries(spec: SystemSpec) -> Iterator[Finding]:
    names = [recovery.name for recovery in spec.recoveries]
    nodes = dict.fromkeys(node.name for node in spec.nodes)
    needable = nodes.keys() | set().union(*(r.claims | r.disables for r in spec.recoveries))
    detections = [detection.name for detection in spec.detections]
    for path, recovery in numbered("recovery", spec.recoveries):
        for need in sorted(recovery.needs):
            if need not in needable:
                yield Finding(f"{path}.needs", f"{need!r} is neither a node nor a resource that a "
                              f"recovery claims or disables; known: {', '.join(sorted(needable))}",
                              (sorted(recovery.needs),))
            if need in recovery.disables:
                yield Finding(f"{path}.disables", f"{recovery.name} itself needs {need!r}; remove "
                              "it from one of the two", (sorted(recovery.disables),))
        yield from find_wrong_names(f"{path}.excused_by", sorted(recovery.excused_by),
                                    "detection module", detections, "listed twice")
        if recovery.excused_by and not recovery.latched:
            yield Finding(f"{path}.excused_by", "expected only with latched = true",
                          (sorted(recovery.excused_by),))
        if recovery.escalate_to and recovery.escalate_to not in names:
            yield unknown(f"{path}.escalate_to", recovery.escalate_to, "recovery module", names)
        if "nodes" in recovery.parameters:
            yield from _node_names(f"{path}.parameters.nodes", recovery.parameters["nodes"], nodes)
    cycle = find_cycle({r.name: [r.escalate_to] if r.escalate_to else [] for r in spec.recoveries})
    if cycle:
        yield Finding(f"$.recovery[{names.index(cycle[0])}].escalate_to",
                      f"cycle {' > '.join(cycle)}; escalation must end", (cycle[1],))
    used = nodes.keys() | set().union(*(r.claims | r.needs for r in spec.recoveries))
    for path, recovery in numbered("recovery", spec.recoveries):
        for name in sorted(recovery.disables - used):
            yield Finding(f"{path}.disables", f"{name!r} is neither a node nor a resource that a "
                          "recovery claims or needs, so nothing is disabled; known: "
                          f"{', '.join(sorted(used))}", (sorted(recovery.disables),))


def _reachability(spec: SystemSpec) -> Iterator[Finding]:
    answers: dict[str, set[str]] = {}  # detection module → recoveries
    recovering = {recovery.escalate_to for recovery in spec.recoveries}
    for mechanism in spec.mechanisms:
        recovering.update(mechanism.recoveries)
        for name in mechanism.detections:
            answers.setdefault(name, set()).update(mechanism.recoveries)
    for path, detection in numbered("detection", spec.detections):
        if detection.name not in answers:
            yield Finding(path, "unreachable: no mechanism uses this detection module")
    for path, recovery in numbered("recovery", spec.recoveries):
        if recovery.name not in recovering:
            yield Finding(path, "unreachable: no mechanism and no escalation leads to this "
                                "recovery")
    watched = {pair for detection in spec.detections
               for pair in product(detection.watch, answers.get(detection.name, ()))}
    for path, node in numbered("node", spec.nodes):
        if node.respawn != SUPERVISOR and (node.name, node.respawn) not in watched:
            yield Finding(f"{path}.respawn", f"node {node.name!r} is unreachable for "
                          f"{node.respawn}: no detection module that {node.respawn} answers to "
                          "watches it", (node.respawn,))


def _faults(spec: SystemSpec) -> Iterator[Finding]:
    detections = dict.fromkeys(row.name for row in spec.detections)
    first: dict[str, str] = {}
    for path, fault in numbered("fault", spec.faults):
        if (other := first.setdefault(fault.name, path)) != path:
            yield Finding(f"{path}.name", f"duplicate name, already at {other}.name", (fault.name,))
        yield from find_wrong_names(f"{path}.detected_by", fault.detected_by, "detection module",
                                    detections, "listed twice")


# -- hosts ----------------------------------------------------------------------------------------


def _hosts(spec: SystemSpec) -> Iterator[Finding]:
    """Check the hosts, and where nodes run."""
    yield from _wrong_table(spec)
    known = [host.name for host in spec.hosts]
    for path, row in spec.placed():
        if row.host and row.host not in known:
            yield unknown(f"{path}.host", row.host, "host", known)
    if not known:
        return
    at: dict[str, tuple[str, str]] = {}
    for path, row in spec.placed():
        host = row.host or known[0]
        first, other = at.setdefault(row.process or row.name, (host, row.name))
        if host != first:
            yield Finding(f"{path}.host", f"expected {first!r}, the host of {other}, which shares "
                          "the process", (host,))
    for path, node in numbered("node", spec.nodes):
        if node.kind is Kind.PILOT and node.host not in ("", known[0]):
            yield Finding(f"{path}.host", f"expected {known[0]!r}, the first host, so that no link "
                          f"is between {node.name} and the robot that it moves", (node.host,))
    yield from _too_short(spec)


def _wrong_table(spec: SystemSpec) -> Iterator[Finding]:
    if len(spec.hosts) == 1:
        yield Finding("$.host", "one machine needs no [[host]]; remove it, or add another one")
    for path, host in numbered("host", spec.hosts):
        try:
            ipaddress.ip_address(host.address)
        except ValueError:
            yield Finding(f"{path}.address", "expected an IP address such as '192.168.7.1'",
                          (host.address,))
    for (_, first), (path, host) in combinations(numbered("host", spec.hosts), 2):
        if first.name == host.name:
            yield Finding(f"{path}.name", "duplicate name", (host.name,))
        if first.address == host.address and abs(first.port - host.port) < PORTS:
            yield Finding(f"{path}.port", f"each host uses {PORTS} ports, and {first.name} has the "
                          f"same address and uses those from {first.port}", (host.port,))


def _too_short(spec: SystemSpec) -> Iterator[Finding]:
    """Find detection modules that would take the link's delay for silence."""
    needed_s = spec.link.delay_s + 2 * spec.timing.heartbeat_period_s
    host_of = spec.host_of
    for path, detection in numbered("detection", spec.detections):
        far = [name for name in detection.watch if host_of[name] != host_of[detection.name]]
        timeout_s = detection.parameters.get("timeout_s", needed_s)
        if far and isinstance(timeout_s, int | float) and timeout_s < needed_s:
            yield Finding(f"{path}.parameters.timeout_s", f"expected at least {needed_s:.2f} s, "
                          f"two heartbeats and [link] delay_s: {detection.name} watches {far[0]} "
                          "over the link", (timeout_s,))


# -- arbitration --------------------------------------------------------------------------------


def _wrong_tree(spec: SystemSpec) -> Iterator[Finding]:
    """Check events, gates, and the places of mechanisms in the tree."""
    paths = {event.name: path for path, event in numbered("event", spec.events)}
    for path, event in numbered("event", spec.events):
        if event.of and event.gate is None:
            yield Finding(f"{path}.of", "inputs without a gate; add gate = 'or'", (event.of,))
        for place, name in enumerate(event.of):
            if name not in paths:
                yield unknown(f"{path}.of[{place}]", name, "event", paths)
    try:
        tree = spec.build_fault_tree()
    except FaultTreeError as error:
        yield Finding(paths.get(error.subject, "$.event"), str(error),
                      (error.subject,) if error.subject else ())
        return
    mechanisms = {m.name: (path, m.event) for path, m in numbered("mechanism", spec.mechanisms)}
    if not mechanisms:
        return
    try:
        tree.derive_ftm_tree({name: event for name, (_, event) in mechanisms.items()})
    except FaultTreeError as error:
        if error.subject:
            path, event_name = mechanisms[error.subject]
            yield Finding(f"{path}.event", f"{error.subject}: {error}", (event_name,))
        else:
            yield Finding("$.mechanism", str(error))


def _wrong_policy(spec: SystemSpec) -> Iterator[Finding]:
    """Check the names of strategies and of orders."""
    for field in ("strategy", "shadow"):
        name = getattr(spec, field)
        if name not in STRATEGIES and (name or field == "strategy"):
            yield unknown(f"$.{field}", name, "strategy", sorted(STRATEGIES))
    if not spec.criteria:
        yield Finding("$.order", "expected the name of an order, or a list of names", ([],))
    for name in spec.criteria:
        if name not in spec.orders:
            yield unknown("$.order", name, "order", list(spec.orders))
        if spec.criteria.count(name) > 1:
            yield Finding("$.order", f"{name!r} is listed twice", (list(spec.criteria),))


def _wrong_orders(spec: SystemSpec) -> Iterator[Finding]:
    """Check that each order relates recoveries and has no cycle."""
    recoveries = dict.fromkeys(recovery.name for recovery in spec.recoveries)
    for name, relation in spec.orders.items():
        for upper, lowers in relation.items():
            path = f"$.orders.{name}.{upper}"
            if upper not in recoveries:
                yield unknown(path, upper, "recovery module", recoveries)
            yield from find_wrong_names(path, lowers, "recovery module", recoveries, "duplicate")
        try:
            spec.build_order(name)
        except CycleError as error:
            upper = error.cycle[0]
            yield Finding(f"$.orders.{name}.{upper}", f"{error}; no recovery can be above itself",
                          (list(relation[upper]),))


def _contradictions(spec: SystemSpec) -> Iterator[Finding]:
    """Check that the selected orders do not contradict each other."""
    try:
        spec.build_order()
    except CycleError as error:
        yield Finding("$.order", f"the criteria contradict each other, {error}; expected orders "
                                 "that agree", (list(spec.criteria),))


def _wrong_compounds(spec: SystemSpec) -> Iterator[Finding]:
    """Check that recoveries that one mechanism runs together can run together."""
    recoveries = {recovery.name: recovery for recovery in spec.recoveries}
    for path, mechanism in numbered("mechanism", spec.mechanisms):
        ways = recovery_gate(mechanism.recover).alternatives()
        together = dict.fromkeys(chain.from_iterable(permutations(way, 2) for way in ways))
        for name, other in together:
            shared = recoveries[name].claims & recoveries[other].claims
            harmed = recoveries[name].disables & recoveries[other].needs
            if shared or harmed:
                yield Finding(f"{path}.recover", (
                    f"{name} and {other} both claim {', '.join(sorted(shared))}" if shared else
                    f"{name} disables {', '.join(sorted(harmed))}, which {other} needs"
                    ) + "; they cannot run together", (mechanism.recover,))


def _wrong_precedence(spec: SystemSpec) -> Iterator[Finding]:
    """Check that recoveries get safer towards the root, and that the last resort never waits."""
    if not spec.mechanisms:
        return
    order, tree = spec.build_safety_order(), spec.build_ftm_tree()
    for path, mechanism in numbered("mechanism", spec.mechanisms):
        if tree.root in mechanism.explains:
            yield Finding(f"{path}.explains", f"{tree.root} is the root of the FTMTree; the last "
                          "barrier acts even if its cause is explained",
                          (sorted(mechanism.explains),))
    recover = {mechanism.name: mechanism.recoveries for mechanism in spec.mechanisms}
    safer = spec.criteria[0]
    for upper, lower, high, low in contradictions(tree, order, recover):
        yield Finding(f"$.orders.{safer}.{high}", f"contradicts the FTMTree: {high} of {lower} is "
                      f"above {low} of {upper}, but {upper} is above {lower}",
                      (list(spec.orders[safer].get(high, ())),))
    for path, recovery in numbered("recovery", spec.recoveries):
        if recovery.escalate_to and order.is_above(recovery.name, recovery.escalate_to):
            yield Finding(f"{path}.escalate_to", f"{recovery.name} is above it in the order "
                          f"{safer!r}; expected a recovery that is not less safe",
                          (recovery.escalate_to,))
    last_resorts = [r for r in spec.recoveries if r.name in recover[tree.root]]
    for last_resort, (path, recovery) in product(
            last_resorts, numbered("recovery", spec.recoveries)):
        shared = recovery.claims & last_resort.claims
        if recovery is not last_resort and shared:
            yield Finding(f"{path}.claims", f"{last_resort.name}, the last resort, would have to "
                          f"wait for {recovery.name}, which also claims "
                          f"{', '.join(sorted(shared))}", (sorted(recovery.claims),))


VALIDATORS: tuple[Validator, ...] = (
    find_wrong_times, _names, _nodes, _detections, _recoveries, _processes, _hosts,
    _mechanisms, find_wrong_clearing, _reachability, _faults, _wrong_tree, _wrong_policy,
    _wrong_orders, _contradictions, _wrong_compounds, _wrong_precedence, find_wrong_budget)
