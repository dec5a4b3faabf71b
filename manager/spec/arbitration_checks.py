"""Whether fault tree, orders, strategy and recoveries of a spec make sense together."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from itertools import chain, permutations, product
from operator import or_

from rampart.manager.model.fault_tree import FaultTreeError
from rampart.manager.model.gates import recovery_gate
from rampart.manager.model.order import CycleError, PartialOrder
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Finding, unknown
from rampart.manager.strategies.registry import STRATEGIES


def find_wrong_tree(spec: SystemSpec) -> Iterator[Finding]:
    """Events, gates, and where the mechanisms sit."""
    names = [event.name for event in spec.events]
    known = set(names)
    for index, event in enumerate(spec.events):
        path = f"$.event[{index}]"
        if event.of and event.gate is None:
            yield Finding(f"{path}.of", "inputs without a gate; add gate = 'or'", (event.of,))
        for place, name in enumerate(event.of):
            if name not in known:
                yield unknown(f"{path}.of[{place}]", name, "event", names)
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
            listed: set[str] = set()
            for place, lower in enumerate(lowers):
                if lower not in recoveries:
                    yield unknown(f"{path}[{place}]", lower, "recovery module", recoveries)
                if lower in listed:
                    yield Finding(f"{path}[{place}]", "duplicate", (lower,))
                listed.add(lower)
        try:
            spec.build_order(name)
        except CycleError as error:
            yield Finding(f"$.orders.{name}.{error.cycle[0]}",
                          f"{error}; no recovery can be above itself",
                          (list(relation[error.cycle[0]]),))


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
    for index, mechanism in enumerate(spec.mechanisms):
        ways = recovery_gate(mechanism.recover).alternatives()
        together = dict.fromkeys(chain.from_iterable(permutations(way, 2) for way in ways))
        for one, other in together:
            shared = recoveries[one].claims & recoveries[other].claims
            harmed = recoveries[one].disables & recoveries[other].needs
            if shared or harmed:
                yield Finding(f"$.mechanism[{index}].recover", (
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
    recoveries = {r.name: (index, r.claims) for index, r in enumerate(spec.recoveries)}
    for name in order.names:
        index, claims = recoveries[name]
        shared = claims & recoveries[last_resort][1]
        if name != last_resort and shared:
            yield Finding(f"$.recovery[{index}].claims",
                          f"{last_resort}, the last resort, would have to wait for {name}, which "
                          f"claims {', '.join(sorted(shared))} as well",
                          (sorted(claims),))
