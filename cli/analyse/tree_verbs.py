"""`rampart tree` and `rampart cut-sets`: the fault tree of a system, and what follows from it.

In text, a box with several parents is drawn under the first; under the others, its name refers to
it (↑). A barrier stands on the branch of its event: `├─‖ event`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
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
from rampart.cli.verbs import JSON, add_verb, either, flag, option, whole, word
from rampart.files.reading import read_bytes
from rampart.manager.analysis.barriers import guard
from rampart.manager.analysis.cut_sets import CutSets, TooLargeError
from rampart.manager.analysis.formula import Formula, FormulaError, formula_of
from rampart.manager.analysis.open_psa import MAX_BYTES, read_open_psa, write_open_psa
from rampart.manager.drawing.diagram import WHATS, Box, Diagram, draw
from rampart.manager.spec.schema import SystemSpec

ABOVE = "↑"
_LIMIT = 100


def to_text(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as text, separated by empty lines."""
    return "\n\n".join("\n".join(_lines(diagram)) for diagram in diagrams) + "\n"


def _lines(diagram: Diagram) -> list[str]:
    lines = [diagram.title]
    boxes = {box.name: box for box in diagram.boxes}
    below: dict[str, list[str]] = {name: [] for name in boxes}
    lowers = {lower for _, lower in diagram.edges}
    for upper, lower in diagram.edges:
        below[upper].append(lower)
    if not boxes:
        lines.append("(empty)")
    drawn: set[str] = set()
    # Name, indentation, branch. A stack, because a tree can be deeper than Python's recursion.
    to_do = [(name, "", "") for name in reversed(boxes) if name not in lowers]
    while to_do:
        name, before, branch = to_do.pop()
        box = boxes[name]
        barred = diagram.what == "fault-tree" and bool(box.mechanism)
        mark = branch + ("‖ " if barred else "─ " if branch else "")
        if name in drawn:
            lines.append(f"{before}{mark}{name} {ABOVE}")
            continue
        drawn.add(name)
        lines.append(f"{before}{mark}{'  '.join(_words(box, diagram))}")
        if branch:
            before += "    " if branch[0] == "└" else "│   "
        for index, lower in enumerate(reversed(below[name])):
            to_do.append((lower, before, "├─" if index else "└─"))
    return lines


def _words(box: Box, diagram: Diagram) -> list[str]:
    """Return the words of a box: name with its gate, title, barrier."""
    name = (diagram.what == "ftm-tree" and box.barrier_words) or box.name
    gate = f" [{box.gate_words}]" if box.gate else ""
    barrier = box.barrier_words if diagram.what == "fault-tree" else ""
    return list(filter(None, (name + gate, box.subtitle, barrier)))


def to_dot(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as one graph in the language DOT of Graphviz."""
    lines = ["digraph {", "  node [shape=box]"]
    for number, diagram in enumerate(diagrams):
        ids = {box.name: f"b{number}_{place}" for place, box in enumerate(diagram.boxes)}
        lines.append(f"  subgraph cluster_{number} {{ label={_quoted(diagram.title)}")
        lines += (f"    {ids[box.name]} [label={_quoted(*_words(box, diagram))}]"
                  for box in diagram.boxes)
        lines += (f"    {ids[upper]} -> {ids[lower]}" for upper, lower in diagram.edges)
        lines.append("  }")
    return "\n".join((*lines, "}")) + "\n"


def _quoted(*lines: str) -> str:
    escaped = [line.replace("\\", "\\\\").replace('"', '\\"') for line in lines]
    return '"' + "\\n".join(escaped) + '"'


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "tree", "draw fault tree, FTMTree and order of recoveries", show_tree,
             systems.choice(),
             option("--what", choices=(*WHATS, "all"), default="all",
                    help="which diagrams (default: all)"),
             either(flag("--dot", "print DOT, which Graphviz draws"), JSON))
    add_verb(verbs, "cut-sets", "find minimal cut sets and their barriers", cut_sets,
             systems.choice("file", ", or Open-PSA file .xml"),
             flag("--count", "print only the number of sets"),
             word("--top", "GATE", "top gate of an Open-PSA file", ""),
             whole("--max-order", "K", "leave out sets with more than K events"),
             whole("--limit", "N", f"list at most N sets (default: {_LIMIT})", _LIMIT),
             word("--export", "FILE", "write the fault tree in Open-PSA format"), JSON)


def show_tree(options: argparse.Namespace) -> int:
    """Print the diagrams.

    Draw the fault tree with the mechanisms as barriers (‖), the FTMTree that
    follows from it, and the order of the recoveries with the safer ones above.

    Examples:
      rampart tree
      rampart tree my_system.toml
      rampart tree --what fault-tree --dot | dot -Tsvg > fault_tree.svg
      rampart tree --what order --json
    """
    spec = systems.load(options.system)
    whats = WHATS if options.what == "all" else (options.what,)
    diagrams = [draw(spec, what) for what in whats]
    if options.json:
        print_json(diagrams)
        return 0
    text = to_dot(diagrams) if options.dot else to_text(diagrams)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        raise UsageError(f"stdout: encoding {sys.stdout.encoding} lacks characters of the tree; "
                         "set PYTHONUTF8=1") from None
    say_text(text.rstrip("\n"))
    return 0


def cut_sets(options: argparse.Namespace) -> int:
    """Do what the options ask for.

    Find the minimal sets of events that cause the top event of a fault tree. For
    a system, also show the mechanisms that are barriers on each set. Sets are counted
    without listing them, so the count may be in the millions.
    docs/explanation/fault-trees.md explains it.

    Examples:
      rampart cut-sets                              # the default system
      rampart cut-sets paper
      rampart cut-sets plant.xml --count --json     # an Open-PSA file
      rampart cut-sets plant.xml --top g12 --max-order 2
      rampart cut-sets --export osmosis.xml         # for other tools
    """
    for name in ("limit", "max_order"):
        if (getattr(options, name) or 0) < 0:
            raise UsageError(f"--{name.replace('_', '-')} {getattr(options, name)}: must be 0 or "
                             "more")
    spec, formula = _load(options)
    if options.export:
        if spec is None:
            raise UsageError(f"{options.file}: --export needs a system spec")
        Path(options.export).write_text(write_open_psa(spec), encoding="utf-8")
        say(f"{spec.name}: {len(spec.events)} events written to {options.export}")
        return 0
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
        print_table(("barriers", "events", "mechanisms, nearest to the top first"),
                    [(len(g.barriers), " ".join(g.events), " ".join(g.barriers)) for g in guarded])
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
