"""`rampart decide`: the decisions of a system's strategy, without a run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from itertools import combinations
from typing import Any

from rampart.cli import systems
from rampart.cli.output import UsageError, print_json, print_rows, say
from rampart.cli.verbs import JSON, add_verb, flag, option, several, word
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.decision import Decision
from rampart.manager.strategies.registry import decide, decision_in_words


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    of_table = (
        several("--strategy", "NAME",
                "strategy (default: the system's); without FTM, repeat it to compare strategies"),
        flag("--differing", "without FTM: show only sets in which the strategies choose different "
             "recoveries"), JSON)
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
    explained. Without FTM, show the decision for every set, for several strategies
    side by side.

    Examples:
      rampart decide FTM3 FTM4
      rampart decide FTM1 FTM6 --json
      rampart decide FTM2 FTM5 --system my_system.toml
      rampart decide --system paper
      rampart decide --strategy safety-first --strategy guarded-repair --differing
    """
    if not options.ftm:
        return show_table(options)
    spec = systems.load(options.system)
    if len(options.strategy) > 1 or options.differing:
        raise UsageError("several --strategy, --differing: only without FTM, for the table")
    strategy = (options.strategy or [spec.strategy])[0]
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

    Show the decision for every non-empty set of active mechanisms; with several
    strategies, the recoveries that each of them chooses, side by side.

    Examples:
      rampart decide --json
      rampart decide --strategy safety-first --strategy guarded-repair --differing
    """
    spec = systems.load(options.system)
    strategies = tuple(dict.fromkeys(options.strategy or [spec.strategy]))
    if options.differing and len(strategies) < 2:
        raise UsageError("--differing: expected two or more --strategy")
    arbiters = [_arbiter(spec, strategy) for strategy in strategies]
    names = [m.name for m in spec.mechanisms]
    if len(names) > 14:
        raise UsageError(f"{spec.name}: {len(names)} mechanisms have {2 ** len(names) - 1} sets; "
                         "expected at most 14 mechanisms: name those of interest")
    rows = [[arbiter(chosen) for arbiter in arbiters]
            for size in range(1, len(names) + 1) for chosen in combinations(names, size)]
    differing = [row for row in rows if len({frozenset(d.recoveries) for d in row}) > 1]
    head: tuple[str, ...] = ("active", *strategies)
    if len(strategies) == 1:
        alone = [decision for (decision,) in rows]
        head = ("active", "block", "executed")
        cells: list[tuple[Any, ...]] = [
            (" ".join(d.active), d.rule, " ".join(d.recoveries)) for d in alone]
        data = [_row(d) for d in alone]
    else:
        shown = differing if options.differing else rows
        cells = [(" ".join(row[0].active), *(" ".join(d.recoveries) for d in row))
                 for row in shown]
        data = [{"active": row[0].active,
                 "decisions": {strategy: {"block": d.rule, "rm": d.recoveries}
                               for strategy, d in zip(strategies, row, strict=True)}}
                for row in shown]
    print_rows(head, cells, data, as_json=options.json)
    if len(strategies) > 1 and not options.json:
        say(f"{len(differing)} of {len(rows)} sets differ")
    return 0


def _arbiter(spec: SystemSpec, strategy: str) -> Callable[[Iterable[str]], Decision]:
    """Return the decision as a function of the set of active mechanisms."""
    mechanisms, tree, order = spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order()

    return lambda active: decide(active, mechanisms, tree, order, strategy)


def _row(decision: Decision) -> dict[str, Any]:
    return {"active": decision.active, "block": decision.rule, "rm": decision.recoveries}
