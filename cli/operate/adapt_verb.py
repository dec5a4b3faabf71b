"""`rampart adapt`: change mechanisms and strategy of a running system."""

from __future__ import annotations

import argparse
import asyncio
import uuid
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.cli.output import NoEffectError, UsageError, print_json, say
from rampart.cli.session import connect
from rampart.files import toml
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.adaptation import SETTINGS, Action, ChangeError, parse_value

_WAIT_S = 2.0
"""Real seconds for the manager to answer; it answers at once, or is being respawned."""


_EXAMPLES = {
    Action.ENABLE: "  rampart adapt enable FTM7",
    Action.DISABLE: "  rampart adapt disable FTM7\n  rampart adapt disable DM7   and what uses it",
    Action.RETUNE: "  rampart adapt retune RM3 deadline_s=2.5\n"
                   "  rampart adapt retune DM1 margin_m=0.7\n"
                   "  rampart adapt retune FTM2 detect='DM2 or DM6'",
    Action.REPLACE: "  rampart adapt replace FTM7 ftm7.toml",
    Action.SET: "  rampart adapt set strategy guarded-repair\n"
                "  rampart adapt set order safer autonomy",
}


def add(verbs: Any, formatter: Any, common: argparse.ArgumentParser) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser(
        "adapt", formatter_class=formatter, help="change mechanisms or strategy while it runs",
        description="Change a detection module, a recovery module, a mechanism or the strategy of\n"
                    "a running system. The changed system is checked like a fresh spec: names,\n"
                    "trees, orders, time budgets. It is applied whole or refused with the reason,\n"
                    "never in the middle of a recovery. The spec file stays as it is.",
        epilog="examples:\n"
               "  rampart adapt set strategy guarded-repair\n"
               "  rampart adapt set shadow mission-first\n"
               "  rampart adapt disable FTM7\n"
               "  rampart adapt enable FTM7\n"
               "  rampart adapt retune RM3 deadline_s=2.5\n"
               "  rampart adapt retune DM1 margin_m=0.7        a parameter of the module\n"
               "  rampart adapt retune FTM2 detect='DM2 or DM6'\n"
               "  rampart adapt replace FTM7 ftm7.toml         the new table, without the name\n\n"
               "exit code: 0 changed; 1 refused, or nobody answered; 2 bad usage")
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    for action in (Action.ENABLE, Action.DISABLE):
        one = _action(actions, formatter, common, action, f"{action} a module or a mechanism")
        one.add_argument("name", metavar="NAME")
    one = _action(actions, formatter, common, Action.RETUNE, "change fields or parameters")
    one.add_argument("name", metavar="NAME")
    one.add_argument("values", nargs="+", metavar="FIELD=VALUE", help="value as in TOML")
    one = _action(actions, formatter, common, Action.REPLACE, "replace a whole table")
    one.add_argument("name", metavar="NAME")
    one.add_argument("file", metavar="FILE", help="TOML with the fields of the new table")
    one = _action(actions, formatter, common, Action.SET, f"set {', '.join(SETTINGS)}")
    one.add_argument("name", choices=SETTINGS)
    one.add_argument("values", nargs="+", metavar="VALUE",
                     help="name of a strategy or order; several orders: the first comes first")


def _action(actions: Any, formatter: Any, common: argparse.ArgumentParser, action: Action,
            text: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = actions.add_parser(
        action.value, parents=[common], formatter_class=formatter, help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=f"examples:\n{_EXAMPLES[action]}")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=lambda options: asyncio.run(change(options)))
    return parser


async def change(options: argparse.Namespace) -> int:
    """Ask the manager for the change and show the answer."""
    values = _values(options)
    async with connect(options.port) as session:
        answers: list[m.AdaptationAnswer] = []
        request = m.AdaptationRequest(uuid.uuid4().hex, options.action, options.name,
                                      msgspec.json.encode(values).decode(), session.name)

        def heard(_key: str, _header: Header, answer: m.AdaptationAnswer) -> None:
            if answer.request == request.request:
                answers.append(answer)

        session.listen(topics.ADAPTATION, topics.ADAPTATION.at(), heard)
        await session.command(topics.ADAPT, request, lambda: bool(answers), _WAIT_S)
    if not answers:
        raise NoEffectError("the FTM Manager does not answer; try again when it is back")
    answer = answers[0]
    if options.json:
        print_json({"accepted": answer.accepted, "reason": answer.reason,
                    "version": answer.version})
    elif answer.accepted:
        say(f"changed; this is change {answer.version} of the run")
    if not answer.accepted:
        raise NoEffectError(f"refused: {answer.reason}")
    return 0


def _values(options: argparse.Namespace) -> dict[str, Any]:
    """Return the values of a change.

    Raises:
        UsageError: they cannot be read.
    """
    try:
        match options.action:
            case Action.RETUNE:
                pairs = [text.partition("=") for text in options.values]
                for key, sign, text in pairs:
                    if not sign or not key.strip() or not text.strip():
                        raise UsageError(f"{key}{sign}{text}: expected FIELD=VALUE")
                return {key.strip(): parse_value(text.strip()) for key, _, text in pairs}
            case Action.SET:
                names = [name for text in options.values for name in text.split(",") if name]
                return {"value": names if options.name == "order" and len(names) > 1
                        else " ".join(options.values)}
            case Action.REPLACE:
                return toml.parse(read_text(Path(options.file), toml.MAX_SIZE))
    except ChangeError as error:
        raise UsageError(str(error)) from None
    except OSError as error:
        raise UsageError(f"{options.file}: {error.strerror}") from None
    except FileError as error:
        raise UsageError(f"{options.file}: {error}") from None
    return {}
