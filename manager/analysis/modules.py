"""Modules of a formula: gates whose events occur nowhere else.

A module is analysed by itself and counts as one event above (Dutuit and Rauzy 1996). Inputs of a
gate that no other gate uses are gathered into a gate of their own first, which is a module then.
"""

from __future__ import annotations

from collections import Counter

import msgspec

from rampart.manager.analysis.formula import GENERATED, Connective, Formula


def prepare(formula: Formula) -> tuple[dict[str, Connective], list[str]]:
    """Return the gates, with lone inputs gathered, and the modules, inner ones first."""
    gates = {name: formula.gates[name] for name in formula.sequence}
    if formula.top not in gates:
        return gates, []
    if not formula.is_monotone:
        return gates, [formula.top]  # below a negation a module's cut sets are not its own
    gates = _without_aliases(gates, formula.top)
    modules = _modules(gates, formula.top)
    users = Counter(entry for gate in gates.values() for entry in gate.inputs)
    for name in list(gates):
        gate = gates[name]
        uniform = gate.low in {1, len(gate.inputs)}
        lone = [e for e in gate.inputs if users[e] == 1 and e not in formula.house
                and (e not in gates or e in modules)]
        if uniform and 2 <= len(lone) < len(gate.inputs):
            gathered = f"{name}{GENERATED}lone"
            rest = [e for e in gate.inputs if e not in lone]
            for own, inputs in ((gathered, lone), (name, [gathered, *rest])):
                count = len(inputs)
                gates[own] = Connective(tuple(inputs), 1 if gate.low == 1 else count, count)
    return gates, _modules(gates, formula.top)


def _without_aliases(gates: dict[str, Connective], top: str) -> dict[str, Connective]:
    """Take out gates that only pass one input on; `gates` has inputs before what uses them."""
    stands_for: dict[str, str] = {}
    left: dict[str, Connective] = {}
    for name, gate in gates.items():
        inputs = tuple(stands_for.get(entry, entry) for entry in gate.inputs)
        gate = msgspec.structs.replace(gate, inputs=inputs)  # noqa: PLW2901
        if len(gate.inputs) == 1 and gate.low == 1 and name != top:
            stands_for[name] = gate.inputs[0]
        else:
            left[name] = gate
    return left


def _modules(gates: dict[str, Connective], top: str) -> list[str]:
    """Return the gates of which no descendant is used elsewhere, inner ones first.

    Dates of a depth-first search (Dutuit and Rauzy 1996): all descendants are met for the first
    time after the gate, and for the last time before the search leaves it.
    """
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    left: dict[str, int] = {}  # gates, inner ones first
    date = 0
    stack: list[tuple[str, bool]] = [(top, False)]
    while stack:
        name, leaving = stack.pop()
        date += 1
        last[name] = date
        if leaving:
            left[name] = date
        elif name not in first:
            first[name] = date
            if name in gates:
                stack.append((name, True))
                stack.extend((entry, False) for entry in reversed(gates[name].inputs))
    earliest, latest = dict(first), dict(last)  # of what is below, too
    modules = []
    for name, left_at in left.items():
        below = gates[name].inputs
        met_first, met_last = min(earliest[e] for e in below), max(latest[e] for e in below)
        if first[name] < met_first and met_last < left_at:
            modules.append(name)
        earliest[name] = min(first[name], met_first)
        latest[name] = max(last[name], met_last)
    return modules
