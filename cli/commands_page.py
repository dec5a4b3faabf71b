"""The reference page of all commands, made from their parsers.

`python -m rampart.cli.commands_page > docs/reference/commands.md` writes it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from rampart.actors.system.members import application_class
from rampart.cli import run_options, systems
from rampart.cli.analyse import campaign_verb
from rampart.cli.main import build_parser
from rampart.cli.operate import kill_node
from rampart.cli.output import rendered, say_text


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
    yield from _block(parser.description)
    family = next((a for a in parser._actions if isinstance(a, argparse._SubParsersAction)), None)
    if rows := [_row(parser, a) for a in parser._actions if a.help is not argparse.SUPPRESS
                and a is not family and "--help" not in a.option_strings]:
        yield "\n".join(("| option | meaning |", "|---|---|", *rows)) + "\n"
    yield from _block(parser.epilog)
    if family is not None:
        for listed in family._choices_actions:
            yield from _section(family.choices[listed.dest], f"{name} {listed.dest}", level + 1)


def _row(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    value = parser._get_formatter()._format_args(
        action, action.dest.upper() if action.option_strings else action.dest)
    what = f"{', '.join(action.option_strings)} {value}".strip()
    return "| `{}` | {} |".format(what, (action.help or "").replace("|", "\\|"))


def _block(text: str | None) -> Iterator[str]:
    shown = (text or "").strip("\n")
    if "\n  " in shown:
        yield f"```text\n{shown}\n```\n"
    elif shown:
        yield f"{shown}\n"


if __name__ == "__main__":
    say_text(markdown().rstrip("\n"))
