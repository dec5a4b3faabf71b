"""`rampart decide` and `rampart table`: ask the arbiter, without any running system."""

from __future__ import annotations

import argparse
from itertools import combinations
from typing import Any

from manager.decision import Decision
from manager.order import UnknownElementError
from manager.schema import SystemSpec
from manager.strategies import UnknownStrategyError, decide
from manager.words import decision_in_words
from toolbox import systems
from toolbox.output import UsageError, print_json, print_table, say


def add(verbs: Any, formatter: Any) -> None:
    """Add the verbs to the parser."""
    parser = verbs.add_parser(
        "decide", formatter_class=formatter, help="what the manager decides for active mechanisms",
        description="Show the decision for a set of active mechanisms, with its certificate: the\n"
                    "block (rule) that applies, the path of dominance, what was rejected and why.",
        epilog="examples:\n  rampart decide FTM3 FTM4\n  rampart decide FTM1 FTM6 --json\n"
               "  rampart decide FTM2 FTM5 --system my_system.toml")
    parser.add_argument("ftm", nargs="+", metavar="FTM", help="active mechanisms, e.g. FTM3")
    _common(parser)
    parser.set_defaults(run=show_decision)

    parser = verbs.add_parser(
        "table", formatter_class=formatter, help="the decision for every set of active mechanisms",
        description="Show the decision for every non-empty set of active mechanisms.",
        epilog="examples:\n  rampart table\n  rampart table --json | python3 -m json.tool\n"
               "  rampart table --system my_system.toml --strategy safety-first")
    _common(parser)
    parser.set_defaults(run=show_table)


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--system", metavar="FILE", help="system spec; default the shipped one")
    parser.add_argument("--strategy", metavar="NAME", help="default the spec's")
    parser.add_argument("--json", action="store_true", help="print JSON")


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
    arbiter = _Arbiter(spec, options.strategy or spec.strategy)
    names = [m.name for m in spec.mechanisms]
    if len(names) > 14:
        raise UsageError(f"{spec.name}: {len(names)} mechanisms have {2 ** len(names) - 1} sets; "
                         "a table is for up to 14, ask `rampart decide` for the sets of interest")
    decisions = [arbiter.decide(chosen) for size in range(1, len(names) + 1)
                 for chosen in combinations(names, size)]
    if options.json:
        print_json([_row(d) for d in decisions], indent=False)
    else:
        print_table(("active", "block", "executed"),
                    [(" ".join(d.active), d.rule, " ".join(d.recoveries)) for d in decisions])
    return 0


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
