"""What follows a recovery that fails.

The recovery that its contract names; else that of the mechanism above, which is the next barrier
on the way to the top event. At the root there is nothing above: a last resort that fails stays in
force, for releasing it could only make things worse.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

import msgspec

from manager.decision import Decision
from manager.mechanisms import Mechanisms
from manager.order import Tree


def escalate(decision: Decision, failures: Mapping[str, str], mechanisms: Mechanisms,
             tree: Tree) -> Decision:
    """Replace failed recoveries in a decision.

    Args:
        decision: As the strategy took it.
        failures: Why a recovery counts as failed, by its name.
        mechanisms: Registry, with the contracts.
        tree: The FTMTree.

    Returns:
        The decision with other recoveries; each failed one is among the rejected, with the reason
        and what it escalated to.
    """
    recoveries: dict[str, None] = {}
    rejected: list[tuple[str, str]] = []
    for recovery in decision.recoveries:
        sakes = [name for name in decision.mechanisms if mechanisms.recover[name] == recovery]
        tried = _line_of_succession(recovery, sakes or decision.mechanisms, failures, mechanisms,
                                    tree)
        recoveries[tried[-1]] = None
        rejected.extend((failed, f"failed: {failures[failed]}; escalated to {following}")
                        for failed, following in pairwise(tried))
    return msgspec.structs.replace(
        decision, recoveries=tuple(recoveries), rejected=decision.rejected + tuple(rejected))


def _line_of_succession(recovery: str, sakes: Iterable[str], failures: Mapping[str, str],
                        mechanisms: Mechanisms, tree: Tree) -> list[str]:
    """Return a recovery and its successors up to the first that has not failed."""
    tried = [recovery]
    wanting = tuple(sakes)
    # Above a mechanism that wants the recovery is its parent; above several of them, none of which
    # is above the others, is their lowest common dominant itself.
    closest = tree.lowest_common_dominant(wanting)
    above = list(reversed(tree.chain(tree.root, closest)))
    if closest in wanting:
        above.pop(0)
    while tried[-1] in failures:
        named = mechanisms.contracts[tried[-1]].escalate_to
        candidates = [named] if named else []
        candidates += [mechanisms.recover[mechanism] for mechanism in above]
        following = next((name for name in candidates if name not in tried), None)
        if following is None:
            break
        tried.append(following)
    return tried
