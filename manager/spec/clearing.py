"""How mechanisms clear: which need an operator, of which role, and which only a new run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from msgspec.structs import replace

from rampart.manager.model.gates import recovery_gate
from rampart.manager.model.mechanisms import Clears
from rampart.manager.spec.schema import MechanismSpec, SystemSpec
from rampart.manager.spec.tables import Finding, numbered


def clears(spec: SystemSpec, mechanism: MechanismSpec) -> Clears:
    """Return what ends a mechanism; without a word of its own, its recovery's `latched` decides."""
    latched = {recovery.name for recovery in spec.recoveries if recovery.latched}
    preferred = next(iter(recovery_gate(mechanism.recover).alternatives()))
    return mechanism.clears or (
        Clears.BY_OPERATOR if latched.intersection(preferred) else Clears.BY_ITSELF)


def reset_role(spec: SystemSpec, recovery: str) -> Literal["drive", "inject"]:
    """Return the least role that may reset a recovery: the highest that its mechanisms name."""
    return "inject" if any(m.cleared_by == "inject" and recovery in m.recoveries
                           for m in spec.mechanisms) else "drive"


def clearing_in_words(spec: SystemSpec) -> dict[str, str]:
    """Return how each mechanism and each latched recovery clears, by name."""
    def words(by: Clears, role: str, after_s: float) -> str:
        if by is Clears.NEVER:
            return "never clears; only a new run ends it"
        who = f"by operator (role {role})" if by is Clears.BY_OPERATOR else by.value
        wait = f" for {after_s:g} s" if after_s else ""
        return f"clears {who} once its error is gone{wait}"

    found = {r.name: words(Clears.BY_OPERATOR, reset_role(spec, r.name), 0.0)
             for r in spec.recoveries if r.latched}
    for m in spec.mechanisms:
        role = max((reset_role(spec, name) for name in m.recoveries), key=("drive", "inject").index)
        found[m.name] = words(clears(spec, m), role, m.clear_after_s)
    return found


def never_cleared(spec: SystemSpec) -> dict[str, list[str]]:
    """Return the mechanisms that never clear, by recovery; no reset ends them while active."""
    found: dict[str, list[str]] = {}
    for m in spec.mechanisms:
        for name in m.recoveries if clears(spec, m) is Clears.NEVER else ():
            found.setdefault(name, []).append(m.name)
    return found


def find_wrong_clearing(spec: SystemSpec) -> Iterator[Finding]:
    """Find fields about clearing that contradict each other or have no effect."""
    for path, m in numbered("mechanism", spec.mechanisms):
        by = clears(spec, m)
        if m.clears is Clears.BY_ITSELF and clears(
                spec, replace(m, clears=None)) is Clears.BY_OPERATOR:
            yield Finding(f"{path}.clears", f"{m.recover} is latched; expected 'by operator' or "
                          "'never'", (m.clears.value,))
        if m.cleared_by == "inject" and by is not Clears.BY_OPERATOR:
            yield Finding(f"{path}.cleared_by", "expected only if it clears by operator",
                          (m.cleared_by,))
        if m.clear_after_s and by is Clears.NEVER:
            yield Finding(f"{path}.clear_after_s", "expected only if it clears",
                          (m.clear_after_s,))
        if m.clears in {Clears.BY_OPERATOR, Clears.NEVER} and not spec.layers.checkpoints:
            yield Finding(f"{path}.clears", "expected checkpoints = true in [layers], else the "
                          "manager's restart would clear it", (m.clears.value,))
