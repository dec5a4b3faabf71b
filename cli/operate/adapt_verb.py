"""`rampart adapt`: change mechanisms and strategy of a running system.

Change a detection module, a recovery module, a mechanism or the strategy of a
running system. The changed system is checked like a fresh specification: names,
trees, orders, time budgets. The change is applied as a whole or refused with the
reason. It is refused while a recovery is in force. The file is not changed.

Examples:
  rampart adapt set strategy guarded-repair
  rampart adapt set shadow mission-first
  rampart adapt disable FTM7
  rampart adapt enable FTM7
  rampart adapt retune RM3 deadline_s=2.5
  rampart adapt retune DM1 margin_m=0.7            # a parameter of the module
  rampart adapt retune FTM2 detect='DM2 or DM6'
  rampart adapt replace FTM7 ftm7.toml             # the new table, without its name

exit code: 0 changed, 1 refused or no answer, 2 bad usage
"""

from __future__ import annotations

import argparse
import json
import uuid
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.cli.output import NoEffectError, UsageError, print_json, say, using
from rampart.cli.session import connect
from rampart.cli.verbs import JSON, PORT, add_family, add_verb, option
from rampart.files import toml
from rampart.files.reading import read_text
from rampart.manager.spec.adaptation import SETTINGS, Action, parse_value

_WAIT_S = 2.0
"""Real seconds for the answer of the manager."""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    actions = add_family(verbs, "adapt", "change mechanisms or strategy of the run", __doc__,
                         dest="action", metavar="ACTION")
    name = option("name", metavar="NAME", help="a module or mechanism")
    for action, text, examples, *options in (
        (Action.ENABLE, "enable a module or a mechanism", ("enable FTM7",), name),
        (Action.DISABLE, "disable a module or a mechanism",
         ("disable FTM7", "disable DM7     # and each mechanism that uses it"), name),
        (Action.RETUNE, "change fields or parameters",
         ("retune RM3 deadline_s=2.5", "retune DM1 margin_m=0.7",
          "retune FTM2 detect='DM2 or DM6'"),
         name, option("values", nargs="+", metavar="FIELD=VALUE",
                      help="a field or parameter, and its new value in TOML")),
        (Action.REPLACE, "replace a whole table", ("replace FTM7 ftm7.toml",), name,
         option("file", metavar="FILE", help="TOML file with the fields of the new table")),
        (Action.SET, f"set {', '.join(SETTINGS)}",
         ("set strategy guarded-repair", "set order safer autonomy"),
         option("name", choices=SETTINGS, help="the setting"),
         option("values", nargs="+", metavar="VALUE",
                help="a strategy or order; for several orders the first decides first")),
    ):
        shown = "\n".join(f"  rampart adapt {example}" for example in examples)
        add_verb(actions, action.value, text, change, PORT, JSON, *options,
                 doc=f"{action}\n\n{text[0].upper()}{text[1:]}.\n\nExamples:\n{shown}")


async def change(options: argparse.Namespace) -> int:
    """Ask the manager for the change and show the answer.

    Raises:
        NoEffectError: The manager refuses the change, or does not answer.
        UsageError: The values cannot be read, or are not finite.
    """
    values = _values(options)
    for name, value in values.items():
        try:
            json.dumps(value, allow_nan=False, default=str)
        except ValueError:  # JSON, which carries the request, has no such number
            raise UsageError(f"{name} = {value}: expected a finite number") from None
    async with connect(options.port) as session:
        answers: list[m.AdaptationAnswer] = []
        request = m.AdaptationRequest(uuid.uuid4().hex, options.action, options.name,
                                      msgspec.json.encode(values).decode(), session.name)

        def heard(_key: str, _header: Header, answer: m.AdaptationAnswer) -> None:
            if answer.request == request.request:
                answers.append(answer)

        session.listen(topics.ADAPTATION, heard)
        await session.command(topics.ADAPT, request, lambda: bool(answers), _WAIT_S)
    if not answers:
        raise NoEffectError("the FTM Manager does not answer; try again when it is back")
    answer = answers[0]
    if options.json:
        print_json({name: getattr(answer, name) for name in ("accepted", "reason", "version")})
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
            with using(options.file):
                return toml.parse(read_text(Path(options.file), toml.MAX_SIZE))
    return {}
