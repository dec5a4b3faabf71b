"""The reference page of all commands, made from their parsers.

`python -m rampart.cli.commands_page > docs/reference/commands.md` writes it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rampart.actors.system.members import application_class
from rampart.cli import run_options, systems
from rampart.cli.analyse import campaign_verb
from rampart.cli.main import build_parser
from rampart.cli.operate import kill_node
from rampart.cli.output import rendered, say_text

_WITHOUT_VALUE = (argparse._StoreTrueAction, argparse._StoreConstAction)


def markdown() -> str:
    """Return the page."""
    main, spec = build_parser(), systems.load(None)
    own = {"run": run_options.parser("rampart run", application_class(spec), spec.application),
           "campaign": campaign_verb.parser("rampart campaign", systems.DEFAULT.stem,
                                            campaign_verb.named_campaigns())}
    parts = [""]
    for title, names in main.groups.items():
        parts.append(f"## {title.capitalize()}\n")
        for name in names:
            parts += _section(own.get(name, main.verbs.choices[name]), f"rampart {name}", 3)
    parts.append("## Other programs\n")
    parts += _section(kill_node.build_parser(), "kill-node", 3)
    parts += ["### launch.py\n",
              "`python launch.py` takes the options of [`rampart run`](#rampart-run).\n"]
    return rendered(Path(__file__).with_name("commands.md.jinja"), body="\n".join(parts))


def _section(parser: argparse.ArgumentParser, name: str, level: int) -> Iterator[str]:
    yield f"{'#' * level} {name}\n"
    yield from _prose(parser.description or "")
    family = next((a for a in parser._actions if isinstance(a, argparse._SubParsersAction)), None)
    if rows := [_row(a) for a in parser._actions if a.help is not argparse.SUPPRESS
                and a is not family and "--help" not in a.option_strings]:
        yield "\n".join(("| option | meaning |", "|---|---|", *rows)) + "\n"
    yield from _prose((parser.epilog or "").replace("examples:\n", "", 1))
    if family is not None:
        for listed in family._choices_actions:
            yield from _section(family.choices[listed.dest], f"{name} {listed.dest}", level + 1)


def _row(action: Any) -> str:
    value = action.metavar or ("" if action.option_strings else action.dest)
    if action.choices and not action.metavar:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    if isinstance(action, _WITHOUT_VALUE):
        value = ""
    elif action.nargs == "?":
        value = f"[{value}]"
    elif action.nargs == "*":
        value = f"[{value} ...]"
    elif action.nargs == "+":
        value = f"{value} ..."
    what = f"{', '.join(action.option_strings)} {value}".strip()
    return f"| `{_cell(what)}` | {_cell(action.help or '')} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _prose(text: str) -> Iterator[str]:
    """Yield the paragraphs of a help text; what is indented becomes a block of code."""
    lines = text.strip("\n").splitlines()
    while lines:
        code = lines[0].startswith("  ")
        end = next((i for i, line in enumerate(lines)
                    if not line or line.startswith("  ") != code), len(lines))
        block, lines = lines[:end], lines[end + (end < len(lines) and not lines[end]):]
        if block and code:
            yield "\n".join(("```", *(line[2:] for line in block), "```")) + "\n"
        elif block:
            text = "\n".join(block)
            if text.startswith("exit code:"):
                text = f"Exit code:{text.removeprefix('exit code:').removesuffix('.')}."
            yield f"{text}\n"


if __name__ == "__main__":
    say_text(markdown().rstrip("\n"))
