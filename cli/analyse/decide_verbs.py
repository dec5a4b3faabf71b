"""`rampart decide`: the decisions of a system's strategy, without a run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from itertools import combinations
from typing import Any

from rampart.cli import systems
from rampart.cli.output import UsageError, print_json, print_rows, say
from rampart.cli.verbs import JSON, add_verb, option, word
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.decision import Decision
from rampart.manager.strategies.registry import decide, decision_in_words


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    of_table = word("--strategy", "NAME", "strategy (default: the system's)"), JSON
    add_verb(verbs, "decide", "show what the manager decides", show_decision,
             option("ftm", nargs="*", metavar="FTM", help="active mechanisms, for example FTM3; "
                    "without one, the table of all sets"), *of_table,
             word("--system", "SPEC",
                  "system file, or name of a shipped system (default: osmosis)"))
    add_verb(verbs, "table", "", show_table, *of_table, systems.choice(), hidden=True)


def show_decision(options: argparse.Namespace) -> int:
    """Print one decision, or the table of all.

    Show the decision for a set of active mechanisms with its certificate: the rule
    that applies (block), the path of dominance, and each rejected recovery with the
    reason. A mechanism that another one explains does not act, and is listed as
    explained. Without FTM, show the decision for every set.

    Examples:
      rampart decide FTM3 FTM4
      rampart decide FTM1 FTM6 --json
      rampart decide FTM2 FTM5 --system my_system.toml
      rampart decide --system paper
      rampart decide --strategy safety-first
    """
    if not options.ftm:
        return show_table(options)
    spec = systems.load(options.system)
    strategy = options.strategy or spec.strategy
    arbiter, mechanisms = _arbiter(spec, strategy), spec.build_mechanisms()
    decision = arbiter(options.ftm)
    acting = mechanisms.unexplained(decision.active, frozenset(mechanisms.detections))
    explained = [name for name in decision.active if name not in acting]
    if explained:
        decision = arbiter(acting)
    if options.json:
        print_json({
            **_row(decision), "path": decision.path,
            "rejected": [{"name": name, "reason": why} for name, why in decision.rejected],
            "explained": explained, "strategy": strategy})
        return 0
    say(decision_in_words(decision.active, decision.rule, decision.recoveries, strategy,
                          spec.titles))
    if explained:
        say(f"  explained {', '.join(explained)}")
    for chain in decision.path:
        say(f"  path      {chain}")
    for name, why in decision.rejected:
        say(f"  rejected  {name}: {why}")
    return 0


def show_table(options: argparse.Namespace) -> int:
    """Print the decision for all non-empty sets.

    Show the decision for every non-empty set of active mechanisms.

    Examples:
      rampart decide --json
    """
    spec = systems.load(options.system)
    arbiter = _arbiter(spec, options.strategy or spec.strategy)
    names = [m.name for m in spec.mechanisms]
    if len(names) > 14:
        raise UsageError(f"{spec.name}: {len(names)} mechanisms have {2 ** len(names) - 1} sets; "
                         "expected at most 14 mechanisms: name those of interest")
    decisions = [arbiter(chosen) for size in range(1, len(names) + 1)
                 for chosen in combinations(names, size)]
    print_rows(("active", "block", "executed"),
               [(" ".join(d.active), d.rule, " ".join(d.recoveries)) for d in decisions],
               list(map(_row, decisions)), as_json=options.json)
    return 0


def _arbiter(spec: SystemSpec, strategy: str) -> Callable[[Iterable[str]], Decision]:
    """Return the decision as a function of the set of active mechanisms."""
    mechanisms, tree, order = spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order()

    return lambda active: decide(active, mechanisms, tree, order, strategy)


def _row(decision: Decision) -> dict[str, Any]:
    return {"active": decision.active, "block": decision.rule, "rm": decision.recoveries}
