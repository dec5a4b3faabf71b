"""Whether fault tree, orders, strategy and recoveries of a spec make sense together."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from itertools import chain, permutations, product
from operator import or_

from rampart.manager.model.fault_tree import FaultTreeError
from rampart.manager.model.gates import recovery_gate
from rampart.manager.model.order import CycleError
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Finding, find_wrong_names, numbered, unknown
from rampart.manager.strategies.registry import STRATEGIES


def find_wrong_tree(spec: SystemSpec) -> Iterator[Finding]:
    """Events, gates, and where the mechanisms sit."""
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
            path, sits_on = mechanisms[error.subject]
            yield Finding(f"{path}.event", f"{error.subject}: {error}", (sits_on,))
        else:
            yield Finding("$.mechanism", str(error))


def find_wrong_policy(spec: SystemSpec) -> Iterator[Finding]:
    """Names of strategies and of orders."""
    for field in ("strategy", "shadow"):
        name = getattr(spec, field)
        if name not in STRATEGIES and (name or field == "strategy"):
            yield unknown(f"$.{field}", name, "strategy", sorted(STRATEGIES))
    if not spec.criteria:
        yield Finding("$.order", "expected the name of an order, or a list of such", ([],))
    for name in spec.criteria:
        if name not in spec.orders:
            yield unknown("$.order", name, "order", list(spec.orders))
        if spec.criteria.count(name) > 1:
            yield Finding("$.order", f"{name!r} is listed twice", (list(spec.criteria),))


def find_wrong_orders(spec: SystemSpec) -> Iterator[Finding]:
    """What each order relates, and that it is one."""
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


def find_contradictions(spec: SystemSpec) -> Iterator[Finding]:
    """Orders that contradict each other."""
    try:
        spec.build_order()
    except CycleError as error:
        yield Finding("$.order", f"the criteria contradict each other, {error}; leave one out or "
                                 "let them agree", (list(spec.criteria),))


def find_wrong_compounds(spec: SystemSpec) -> Iterator[Finding]:
    """Recoveries that one mechanism runs together must be able to run together."""
    recoveries = {recovery.name: recovery for recovery in spec.recoveries}
    for path, mechanism in numbered("mechanism", spec.mechanisms):
        ways = recovery_gate(mechanism.recover).alternatives()
        together = dict.fromkeys(chain.from_iterable(permutations(way, 2) for way in ways))
        for one, other in together:
            shared = recoveries[one].claims & recoveries[other].claims
            harmed = recoveries[one].disables & recoveries[other].needs
            if shared or harmed:
                yield Finding(f"{path}.recover", (
                    f"{one} and {other} both claim {', '.join(sorted(shared))}" if shared else
                    f"{one} disables {', '.join(sorted(harmed))}, which {other} needs"
                    ) + "; they cannot run together", (mechanism.recover,))


def find_wrong_precedence(spec: SystemSpec) -> Iterator[Finding]:
    """Recoveries that are safer than what is above them, or keep the last resort waiting."""
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
                    yield Finding(f"$.orders.{safer}.{above}", f"contradicts the FTMTree: {above} "
                                  f"of {lower} is above {below} of {upper}, but {upper} is above "
                                  f"{lower}", (list(spec.orders[safer].get(above, ())),))
    for path, recovery in numbered("recovery", spec.recoveries):
        if recovery.escalate_to and order.is_above(recovery.name, recovery.escalate_to):
            yield Finding(f"{path}.escalate_to", f"{recovery.name} is above it in the order "
                          f"{safer!r}; escalation must not lead to less", (recovery.escalate_to,))
    # A recovery of the FTMTree's root is a last resort: nothing may make it wait.
    claims = {r.name: (f"{path}.claims", r.claims)
              for path, r in numbered("recovery", spec.recoveries)}
    for last_resort, name in product(recover[tree.root], order.names):
        shared = claims[name][1] & claims[last_resort][1]
        if name != last_resort and shared:
            yield Finding(claims[name][0], f"{last_resort}, the last resort, would have to wait "
                          f"for {name}, which claims {', '.join(sorted(shared))} as well",
                          (sorted(claims[name][1]),))
