"""`rampart decide` and `rampart table`: ask the arbiter, without any running system."""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Sequence
from itertools import combinations
from typing import Any

from rampart.cli import systems
from rampart.cli.output import UsageError, print_json, print_table, say, say_text
from rampart.manager.model.order import UnknownElementError
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.decision import Decision
from rampart.manager.strategies.decision_words import decision_in_words
from rampart.manager.strategies.registry import UnknownStrategyError, decide


def add(verbs: Any, formatter: Any) -> None:
    """Add the verbs to the parser."""
    parser = verbs.add_parser(
        "decide", formatter_class=formatter, help="what the manager decides for active mechanisms",
        description="Show the decision for a set of active mechanisms, with its certificate: the\n"
                    "block (rule) that applies, the path of dominance, what was rejected and why.",
        epilog="examples:\n  rampart decide FTM3 FTM4\n  rampart decide FTM1 FTM6 --json\n"
               "  rampart decide FTM2 FTM5 --system my_system.toml")
    parser.add_argument("ftm", nargs="+", metavar="FTM", help="active mechanisms, e.g. FTM3")
    parser.add_argument("--strategy", metavar="NAME", help="default the spec's")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--system", metavar="SPEC",
                        help="file, or name of a shipped system; default the shipped one")
    parser.set_defaults(run=show_decision)

    parser = verbs.add_parser(
        "table", formatter_class=formatter, help="the decision for every set of active mechanisms",
        description="Show the decision for every non-empty set of active mechanisms; with several\n"
                    "strategies, what each of them would run, side by side.",
        epilog="examples:\n  rampart table\n  rampart table --json | python3 -m json.tool\n"
               "  rampart table --system my_system.toml --format csv > decisions.csv\n"
               "  rampart table --strategy safety-first --strategy guarded-repair --differing")
    parser.add_argument("--strategy", metavar="NAME", action="append",
                        help="default the spec's; several are compared")
    parser.add_argument("--differing", action="store_true",
                        help="only the sets in which the strategies run different recoveries")
    parser.add_argument("--format", choices=("table", "csv", "json"), default="table",
                        help="default table")
    parser.add_argument("--json", action="store_const", dest="format", const="json",
                        help="the same as --format json")
    systems.add_arguments(parser)
    parser.set_defaults(run=show_table)


def show_decision(options: argparse.Namespace) -> int:
    """Print one decision."""
    spec = systems.load(options.system)
    strategy = options.strategy or spec.strategy
    decision = _Arbiter(spec, strategy).decide(options.ftm)
    if options.json:
        print_json({
            **_row(decision),
            "path": decision.path,
            "rejected": [{"name": name, "reason": why} for name, why in decision.rejected],
            "strategy": strategy,
        })
        return 0
    say(decision_in_words(decision.active, decision.rule, decision.recoveries, strategy))
    for chain in decision.path:
        say(f"  path      {chain}")
    for name, why in decision.rejected:
        say(f"  rejected  {name}: {why}")
    return 0


def show_table(options: argparse.Namespace) -> int:
    """Print the decision for all non-empty sets."""
    spec = systems.load(options.system)
    strategies = tuple(dict.fromkeys(options.strategy or [spec.strategy]))
    if options.differing and len(strategies) < 2:
        raise UsageError("--differing compares; give --strategy twice or more")
    arbiters = [_Arbiter(spec, strategy) for strategy in strategies]
    names = [m.name for m in spec.mechanisms]
    if len(names) > 14:
        raise UsageError(f"{spec.name}: {len(names)} mechanisms have {2 ** len(names) - 1} sets; "
                         "a table is for up to 14, ask `rampart decide` for the sets of interest")
    rows = [[arbiter.decide(chosen) for arbiter in arbiters]
            for size in range(1, len(names) + 1) for chosen in combinations(names, size)]
    differing = [row for row in rows if len({frozenset(d.recoveries) for d in row}) > 1]
    if len(strategies) == 1:
        _print_decisions([decision for (decision,) in rows], options.format)
        return 0
    _print_comparison(differing if options.differing else rows, strategies, options.format)
    if options.format == "table":
        say(f"{len(differing)} of {len(rows)} sets differ")
    return 0


def _print_decisions(decisions: Sequence[Decision], form: str) -> None:
    cells = [(" ".join(d.active), d.rule, " ".join(d.recoveries)) for d in decisions]
    if form == "json":
        print_json([_row(d) for d in decisions], indent=False)
    elif form == "csv":
        _print_csv(("active", "block", "rm"), cells)
    else:
        print_table(("active", "block", "executed"), cells)


def _print_comparison(rows: Sequence[Sequence[Decision]], strategies: Sequence[str],
                      form: str) -> None:
    if form == "json":
        print_json([{"active": row[0].active,
                     "decisions": {strategy: {"block": d.rule, "rm": d.recoveries}
                                   for strategy, d in zip(strategies, row, strict=True)}}
                    for row in rows], indent=False)
        return
    cells = [(" ".join(row[0].active), *(" ".join(d.recoveries) for d in row)) for row in rows]
    (_print_csv if form == "csv" else print_table)(("active", *strategies), cells)


def _print_csv(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    say_text(text.getvalue().rstrip("\n"))


class _Arbiter:
    def __init__(self, spec: SystemSpec, strategy: str) -> None:
        self._mechanisms = spec.build_mechanisms()
        self._tree = spec.build_ftm_tree()
        self._order = spec.build_order()
        self._strategy = strategy

    def decide(self, active: Any) -> Decision:
        try:
            return decide(active, self._mechanisms, self._tree, self._order, self._strategy)
        except (UnknownElementError, UnknownStrategyError) as error:
            raise UsageError(str(error)) from None


def _row(decision: Decision) -> dict[str, Any]:
    return {"active": decision.active, "block": decision.rule, "rm": decision.recoveries}
