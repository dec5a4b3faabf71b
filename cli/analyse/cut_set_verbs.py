"""`rampart cut-sets`: minimal sets of events that cause the top, and their barriers."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rampart.cli import systems
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    print_json,
    print_table,
    progress,
    say,
    say_text,
    using,
    warn,
)
from rampart.cli.verbs import JSON, add_verb, flag, option, whole, word
from rampart.files.reading import read_bytes
from rampart.manager.analysis.barriers import Guarded, guard, outlook
from rampart.manager.analysis.cut_sets import CutSets, TooLargeError
from rampart.manager.analysis.formula import Formula, FormulaError, formula_of
from rampart.manager.analysis.open_psa import MAX_BYTES, read_open_psa, write_open_psa
from rampart.manager.spec.schema import SystemSpec

_LIMIT = 100


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "cut-sets", "find minimal cut sets and their barriers", run,
             systems.choice("file", ", or Open-PSA file .xml"),
             flag("--count", "print only the number of sets"),
             word("--top", "GATE", "top gate of an Open-PSA file", ""),
             whole("--max-order", "K", "leave out sets with more than K events"),
             whole("--limit", "N", f"list at most N sets (default: {_LIMIT})", _LIMIT),
             option("--active", nargs="+", default=[], metavar="FTM",
                    help="show what is left before the top if these mechanisms are active"),
             word("--export", "FILE", "write the fault tree in Open-PSA format"), JSON)


def run(options: argparse.Namespace) -> int:
    """Do what the options ask for.

    Find the minimal sets of events that cause the top event of a fault tree. For
    a system, also show the mechanisms that are barriers on each set, and the single
    events that are left before the top. Sets are counted without listing them, so
    the count may be in the millions. docs/explanation/fault-trees.md explains it.

    Examples:
      rampart cut-sets                              # the default system
      rampart cut-sets paper
      rampart cut-sets plant.xml --count --json     # an Open-PSA file
      rampart cut-sets plant.xml --top g12 --max-order 2
      rampart cut-sets --active FTM2                # what is left if FTM2 is active
      rampart cut-sets --export osmosis.xml         # for other tools
    """
    for name in ("limit", "max_order"):
        if (getattr(options, name) or 0) < 0:
            raise UsageError(f"--{name.replace('_', '-')} {getattr(options, name)}: must be 0 or "
                             "more")
    spec, formula = _load(options)
    if options.active or options.export:
        if spec is None:
            raise UsageError(f"{options.file}: --active and --export need a system spec")
        if options.export:
            Path(options.export).write_text(write_open_psa(spec), encoding="utf-8")
            say(f"{spec.name}: {len(spec.events)} events written to {options.export}")
            return 0
        return _show_outlook(spec, options.active, as_json=options.json)
    try:
        with progress() as show:
            found = CutSets(formula, progress=show, max_order=options.max_order)
        if not options.count:
            return _list(spec, formula, found, options)
    except TooLargeError as error:
        raise NoEffectError(f"{options.file}: {error}") from None
    if options.json:
        print_json({"top": formula.top, "minimal_cut_sets": found.count})
    else:
        say(f"{formula.top}: {found.count} minimal cut sets{_of_order(options)}")
    return 0


def _of_order(options: argparse.Namespace) -> str:
    return "" if options.max_order is None else f" of at most {options.max_order} events"


def _load(options: argparse.Namespace) -> tuple[SystemSpec | None, Formula]:
    if options.file and options.file.lower().endswith(".xml"):
        with using(options.file):
            text = read_bytes(Path(options.file), MAX_BYTES)
            return None, read_open_psa(text, options.file, options.top,
                                       lambda doubt: warn(str(doubt)))
    spec = systems.load(options.file)
    try:
        formula = formula_of(spec.build_fault_tree())
        if options.top:
            formula = Formula(formula.gates, frozenset(formula.basic), {}, options.top)
    except FormulaError as error:
        raise UsageError(f"{options.file or spec.name}: {error}") from None
    return spec, formula


def _list(spec: SystemSpec | None, formula: Formula, found: CutSets, options: argparse.Namespace
          ) -> int:
    sets = list(found.sets(options.limit))
    guarded = guard(spec, sets) if spec is not None and not options.top else ()
    if options.json:
        print_json({
            "top": formula.top, "minimal_cut_sets": found.count, "by_size": found.sizes,
            "coherent": formula.is_monotone,
            "sets": guarded or [{"events": events} for events in sets]})
        return 0
    say(f"{formula.top}: {found.count} minimal cut sets{_of_order(options)}"
        + ("" if formula.is_monotone else " (not coherent: sets of which exactly these occur)"))
    for size, count in enumerate(found.sizes):
        if count:
            say(f"  {count} of {size} event{'s' if size != 1 else ''}")
    say()
    if guarded:
        _print_barriers("events", guarded)
        bare = [g for g in guarded if len(g.barriers) < 2]
        if bare:
            say_text("\nfewer than two barriers:")
            for g in bare:
                behind = f"only {g.barriers[0]}" if g.barriers else "none"
                say(f"  {' and '.join(g.events)}: {behind}")
    else:
        for events in sets:
            say("  " + (" ".join(events) or "(the empty set: the top occurs by itself)"))
    if len(sets) < found.count:
        say_text(f"\n{len(sets)} shown; --limit N shows more")
    return 0


def _show_outlook(spec: SystemSpec, active: list[str], *, as_json: bool) -> int:
    spec.build_mechanisms().sort(active)
    view = outlook(spec, active)
    if as_json:
        print_json(view)
        return 0
    top = spec.build_fault_tree().top
    if not view.occurred:
        say("no mechanism is active: no event has occurred")
    for name, barriers in view.left.items():
        event = next(m.event for m in spec.mechanisms if m.name == name)
        say(f"{event} has occurred ({name} is active); left before {top}: "
            f"{', '.join(barriers) or 'nothing'}")
    say()
    say(f"single events that would now lead to {top}, and the idle barriers between:")
    _print_barriers("event", view.next_events)
    return 0


def _print_barriers(events: str, guarded: Iterable[Guarded]) -> None:
    print_table(("barriers", events, "mechanisms, nearest to the top first"),
                [(len(g.barriers), " ".join(g.events), " ".join(g.barriers)) for g in guarded])
