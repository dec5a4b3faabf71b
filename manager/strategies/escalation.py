"""Escalation: the successor of a recovery that fails.

It is the next alternative of its mechanism; else the recovery that its contract names; else that of
the mechanism above, the next barrier on the path to the top event. A last resort that fails stays
in force, since its release could only make things worse.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from itertools import chain, pairwise

import msgspec

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision


def escalate(decision: Decision, failures: Mapping[str, str], arrangement: Arrangement) -> Decision:
    """Replace failed recoveries in a decision; `failures`: failed recovery → reason.

    Each failed recovery is among the rejected ones, with the reason and its successor.
    """
    recover = arrangement.mechanisms.recover
    recoveries: dict[str, None] = {}
    rejected: list[tuple[str, str]] = []
    for recovery in decision.recoveries:
        sakes = [name for name in decision.mechanisms if recovery in recover[name]]
        tried = succession(recovery, sakes or decision.mechanisms, failures, arrangement)
        recoveries[tried[-1]] = None
        if len(tried) > 1:
            recoveries.update(dict.fromkeys(_companions(tried[-1], sakes, failures, arrangement)))
        rejected.extend((failed, f"failed: {failures[failed]}; escalated to {following}")
                        for failed, following in pairwise(tried))
    # A successor may claim a resource of another recovery of the decision.
    compatible = arrangement.compatible(
        sorted(recoveries, key=arrangement.order.number.__getitem__))
    taken = tuple(name for name in recoveries if name in compatible)
    rejected.extend((name, "conflicts with the recovery that was escalated to")
                    for name in recoveries if name not in taken)
    return msgspec.structs.replace(
        decision, recoveries=taken, rejected=decision.rejected + tuple(rejected))


def succession(recovery: str, sakes: Iterable[str], failures: Container[str],
               arrangement: Arrangement) -> list[str]:
    """Return a recovery and its successors up to the first that has not failed."""
    tree, mechanisms = arrangement.tree, arrangement.mechanisms
    tried = [recovery]
    wanting = tuple(sakes)
    # Above a mechanism with its own recovery is its parent. Above several mechanisms, or above a
    # guard that is not the dominant's own recovery, is the lowest common dominant itself.
    closest = tree.lowest_common_dominant(wanting)
    above = list(reversed(tree.chain(tree.root, closest)))
    if closest in wanting and recovery in mechanisms.recover[closest]:
        above.pop(0)
    alternatives = list(chain.from_iterable(_ways_left(wanting, failures, arrangement)))
    higher = arrangement.demanded(above)
    while tried[-1] in failures:
        named = mechanisms.contracts[tried[-1]].escalate_to
        following = next((name for name in (*alternatives, named, *higher)
                          if name and name not in tried), None)
        if following is None:
            break
        tried.append(following)
    return tried


def _companions(recovery: str, sakes: Iterable[str], failures: Container[str],
                arrangement: Arrangement) -> tuple[str, ...]:
    """Return the alternative that a recovery is part of, () if there is none."""
    return next((way for way in _ways_left(sakes, failures, arrangement) if recovery in way), ())


def _ways_left(sakes: Iterable[str], failures: Container[str], arrangement: Arrangement
               ) -> list[tuple[str, ...]]:
    """Return the alternatives of some mechanisms in which no recovery has failed."""
    return [way for mechanism in sakes for way in arrangement.mechanisms.alternatives(mechanism)
            if not any(recovery in failures for recovery in way)]
