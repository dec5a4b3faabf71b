"""`rampart tree`: draw a system's fault tree, FTMTree and order of the recoveries."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from rampart.cli import systems
from rampart.cli.analyse.tree_svg import to_svg
from rampart.cli.analyse.tree_text import to_text
from rampart.cli.output import UsageError, say, unknown
from rampart.cli.verbs import add_verb, option, word
from rampart.files.plain_text import one_line
from rampart.manager.drawing.diagram import WHATS, Diagram, Situation, draw
from rampart.manager.model.order import CycleError
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import decide


def to_json(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as a list of JSON objects."""
    return msgspec.json.format(msgspec.json.encode(diagrams), indent=2).decode() + "\n"


FORMATS: dict[str, Callable[[Sequence[Diagram]], str]] = {
    "text": to_text, "svg": to_svg, "json": to_json}
_ENDINGS = {".svg": "svg", ".json": "json", ".txt": "text"}


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "tree", "draw fault tree, FTMTree and order of recoveries", show_tree,
             systems.choice(),
             option("--what", choices=(*WHATS, "all"), default="all",
                    help="which diagrams (default: all)"),
             option("--format", choices=tuple(FORMATS),
                    help="format (default: by the ending of --output, else text)"),
             option("--json", action="store_const", dest="format", const="json",
                    help="same as --format json"),
             word("--output", "FILE", "write to FILE instead of standard output"),
             option("--order", metavar="NAME", action="append",
                    help="order of recoveries; repeatable: each decides the pairs that the "
                         "previous ones leave open (default: the system's)"),
             option("--active", metavar="FTM", nargs="+", default=[],
                    help="active mechanisms, which are highlighted with the decision"),
             word("--strategy", "NAME", "strategy that decides (default: the system's)"))


def show_tree(options: argparse.Namespace) -> int:
    """Print or write the diagrams.

    Draw the fault tree with the mechanisms as barriers (‖), the FTMTree that
    follows from it, and the order of the recoveries with the safer ones above.

    Examples:
      rampart tree
      rampart tree my_system.toml
      rampart tree --what ftm-tree --active FTM3 FTM4
      rampart tree --what fault-tree --output fault_tree.svg
      rampart tree --what order --json
    """
    ending = Path(options.output).suffix.lower() if options.output else ""
    if ending and not options.format and ending not in _ENDINGS:
        raise UsageError(f"--output {options.output}: unknown ending; expected "
                         f"{', '.join(_ENDINGS)}, or --format")
    form = options.format or _ENDINGS.get(ending, "text")
    spec = systems.load(options.system)
    diagrams = _draw(spec, WHATS if options.what == "all" else (options.what,), options)
    text = FORMATS[form](diagrams)
    if options.output is None:
        _print(text)
        return 0
    Path(options.output).write_text(text, encoding="utf-8")
    for diagram in diagrams:
        say(f"{options.output}: {diagram.what}, {len(diagram.boxes)} boxes, "
            f"{len(diagram.edges)} lines")
    return 0


def _draw(spec: SystemSpec, whats: Sequence[str], options: argparse.Namespace
          ) -> tuple[Diagram, ...]:
    criteria = tuple(options.order or spec.criteria)
    for name in criteria:
        if name not in spec.orders:
            raise unknown("order", name, map(one_line, spec.orders))
    strategy = options.strategy or spec.strategy
    try:
        order = spec.build_order(*criteria)
    except CycleError as error:
        raise UsageError(f"--order {' '.join(criteria)}: together they form a {error}") from None
    situation = Situation()
    if options.active or options.strategy:
        decision = decide(options.active, spec.build_mechanisms(), spec.build_ftm_tree(),
                          order, strategy)
        situation = Situation(frozenset(decision.active), decision.recoveries, decision.rule,
                              strategy)
    return tuple(draw(spec, what, order, criteria, situation) for what in whats)


def _print(text: str) -> None:
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        raise UsageError(f"stdout: encoding {sys.stdout.encoding} lacks characters of the tree; "
                         "use --output FILE") from None
    sys.stdout.write(text)
    sys.stdout.flush()
