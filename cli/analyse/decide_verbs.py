"""`rampart decide` and `rampart verify`: the arbitration of a system, without a run."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Collection, Iterable
from itertools import combinations
from typing import Any

from rampart.cli import systems
from rampart.cli.output import UsageError, print_json, print_rows, print_table, progress, say
from rampart.cli.verbs import JSON, add_verb, flag, option, several, word
from rampart.manager.analysis.verification import MEANING, Report, verify
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
    add_verb(verbs, "verify", "verify the arbitration exhaustively", run_verification,
             systems.choice(),
             several("--strategy", "NAME", "verify only this strategy; repeatable (default: all)"),
             flag("--strict", "exit with 1 if a property fails"), JSON)


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


def run_verification(options: argparse.Namespace) -> int:
    """Verify, and print the result.

    Check a system as `rampart check` does. Then explore its arbitration
    exhaustively: the decision of each strategy for every set of active mechanisms,
    and every state of the arbiter after it has received a report of each module.
    Each property holds, or the shortest counterexample is shown: of the system's
    strategy, or of those given by --strategy.
    docs/explanation/arbitration.md explains the properties and the limits.

    Examples:
      rampart verify
      rampart verify my_system.toml --strategy safety-first
      rampart verify paper --json
      rampart verify --strict && rampart run     # run only if all properties hold

    exit code: 0 verified, whether properties hold or not; 1 with --strict, if a
    property of the system's strategy (or of one given by --strategy) fails; 2 bad
    usage or unsound system
    """
    spec = systems.check(options.system).spec
    wanted = set(options.strategy or [spec.strategy]) | {""}
    start = time.monotonic()
    with progress() as show:
        report = verify(spec, options.strategy, progress=show)
    if options.json:
        print_json(report)
    else:
        _show(spec, report, time.monotonic() - start, wanted)
    failed = any(not p.holds and p.strategy in wanted for p in report.properties)
    return 1 if options.strict and failed else 0


def _show(spec: SystemSpec, report: Report, seconds: float, wanted: Collection[str]) -> None:
    """Print the table of all strategies, and a counterexample of each wanted one."""
    strategies = list(report.permissiveness)
    say(f"{spec.title} ({report.system}): {report.active_sets} active sets, "
        f"{report.states} states of the arbiter, in {seconds:.1f} s")
    say()
    found = {(p.name, p.strategy): p for p in report.properties}
    rows = []
    for name, meaning in MEANING.items():
        cells = []
        for strategy in strategies:
            checked = found.get((name, strategy)) or found.get((name, ""))
            cells.append("" if checked is None else
                         "holds" if checked.holds else f"FAILS in {checked.count}")
        rows.append((name, *cells, meaning))
    print_table(("property", *strategies, ""), rows)
    for words, counts in (
            ("in which the robot must stop until an operator resets it", report.permissiveness),
            ("in which a necessary repair never runs while the last resort keeps the robot stopped;"
             "\na reset needs a repair by hand, and repairs-run exempts them",
             report.stuck_behind_last_resort)):
        say()
        for line in f"active sets {words}:".splitlines():
            say(line)
        for strategy, count in counts.items():
            say(f"  {strategy:<16} {count:>5} of {report.active_sets}")
    say()
    say("not explored: the start of a manager, until each module has reported or its grace period "
        "is over")
    if others := {p.strategy: None for p in report.properties
                  if not p.holds and p.strategy not in wanted}:
        say(f"counterexamples of {' and '.join(others)}: --strategy NAME")
    for checked in report.properties:
        if checked.strategy not in wanted:
            continue
        for trace in checked.counterexamples[:1]:
            say()
            say(f"{checked.name} fails{f' under {checked.strategy}' if checked.strategy else ''},"
                f" in {checked.count} of {checked.cases} cases; the shortest:")
            for number, step in enumerate(trace, 1):
                say(f"  {number}. {step}")
