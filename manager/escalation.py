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
    mechanism: str | None = tree.lowest_common_dominant(sakes)
    while tried[-1] in failures:
        following = mechanisms.contracts[tried[-1]].escalate_to
        while mechanism is not None and (not following or following in tried):
            mechanism = tree.parents[mechanism]
            following = mechanisms.recover[mechanism] if mechanism is not None else ""
        if not following or following in tried:
            break
        tried.append(following)
    return tried
