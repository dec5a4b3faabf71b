"""`rampart verify`: exhaustive verification of a system's arbitration."""

from __future__ import annotations

import argparse
import time
from collections.abc import Collection
from typing import Any

from rampart.cli import systems
from rampart.cli.output import print_json, print_table, progress, say
from rampart.cli.verbs import JSON, add_verb, flag, several
from rampart.manager.analysis.verification import MEANING, Report, verify
from rampart.manager.spec.schema import SystemSpec


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "verify", "verify the arbitration exhaustively", run, systems.choice(),
             several("--strategy", "NAME", "verify only this strategy; repeatable (default: all)"),
             flag("--strict", "exit with 1 if a property fails"), JSON)


def run(options: argparse.Namespace) -> int:
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
