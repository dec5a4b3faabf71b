"""`rampart`: the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points, version
from typing import Any

import argcomplete

from rampart.actors.bus.bus import BusError
from rampart.actors.bus.run_info import NoRunError
from rampart.actors.recording.bag_writer import BagError
from rampart.actors.supervision.kill_node import SignalError
from rampart.cli import new, service_verb
from rampart.cli.analyse import (
    check_verbs,
    decide_verbs,
    tree_verbs,
)
from rampart.cli.look import doctor_verb, ros_verbs, serving_verbs, topic_verbs
from rampart.cli.operate import (
    adapt_verb,
    inject_verb,
    keys_verb,
    node_verbs,
    token_verbs,
)
from rampart.cli.output import NoEffectError, say_text, warn
from rampart.cli.record import incident_verbs, record_verbs
from rampart.cli.verbs import FORMATTER, PORT
from rampart.files import loading, streams, working_folder

_MODULES = (
    node_verbs, topic_verbs, ros_verbs, inject_verb, serving_verbs, adapt_verb,
    record_verbs, incident_verbs, keys_verb, token_verbs, check_verbs, tree_verbs,
    decide_verbs, doctor_verb, service_verb)
"""Each adds its verbs."""

_GROUPS = {
    "start": ("new", "run", "record", "replay", "doctor"),
    "look": ("status", "top", "node", "topic", "bag", "incident", "live", "ros2"),
    "operate": ("reset", "inject", "adapt"),
    "analyse": ("check", "explain", "decide", "tree", "verify", "cut-sets", "campaign"),
    "administer": ("keys", "tokens", "service")}
"""Groups of the help. Verbs of other packages come last, under `robots`."""

_HELP = """usage: rampart VERB ...       (rampart VERB --help: options and examples)

Start a fault-tolerant robot controller, inspect it, inject faults, verify decisions.

{groups}
examples:
  rampart run --virtual --seed 7      # a mission in virtual time, in seconds
  rampart run                         # on processes; then, in another shell:
  kill-node localization              # crash a process; it is restarted
"""


class RampartParser(argparse.ArgumentParser):
    """Lists its verbs in groups."""

    verbs: Any = None

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Title of a group → names of its verbs, with those of other packages."""
        grouped = {name for names in _GROUPS.values() for name in names}
        return {**_GROUPS, "robots": tuple(sorted(
            action.dest for action in self.verbs._choices_actions if action.dest not in grouped))}

    def format_help(self) -> str:
        """Return the help of `rampart` itself."""
        texts = {action.dest: action.help for action in self.verbs._choices_actions}
        return _HELP.format(groups="".join(
            f"{group if name == names[0] else '':<12}{name:<10}{texts[name]}\n"
            for group, names in self.groups.items() for name in names))


def build_parser() -> RampartParser:
    """Return the parser with all verbs; each sets `run`, a function of the options.

    A package adds verbs by entry points of the group `rampart.verbs`: functions of the verbs'
    subparsers, the formatter class, and a parent parser with `--port`.
    """
    parser = RampartParser(prog="rampart")
    parser.add_argument("--version", action="version",
                        version=f"rampart {version('rampart-robot')}")
    verbs = parser.verbs = parser.add_subparsers(
        dest="verb", required=True, metavar="VERB", parser_class=argparse.ArgumentParser)
    new.add(verbs)
    verbs.add_parser("run", add_help=False, help="start a system, as launch.py does")
    for module in _MODULES:
        module.add(verbs)
    verbs.add_parser("campaign", add_help=False, help="run many missions with injected faults")
    common = argparse.ArgumentParser(add_help=False)
    PORT(common)
    of_packages = {verb.name: verb for verb in entry_points(group="rampart.verbs")}
    for _, found in sorted(of_packages.items()):  # a package may be installed twice
        try:
            found.load()(verbs, FORMATTER, common)
        except Exception as error:  # of another package: the other verbs must work
            warn(f"verb {found.name} ({found.value}): {type(error).__name__}: {error}")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code.

    0 success; 1 no effect, or no answer; 2 bad usage, unknown name, no run found, or output that
    cannot be written.
    """
    if arguments is None:
        arguments = sys.argv[1:]
    if arguments[:1] == ["run"]:
        loading.begin()
        from rampart.cli.run import main as run  # noqa: PLC0415 other verbs need no physics

        return run(arguments[1:], "rampart run")
    streams.secure()
    code = _run(arguments)
    if code == 0 and (why := streams.lost_result()):
        warn(f"stdout: {why}")
        return 2
    return code


def _run(arguments: Sequence[str]) -> int:
    working_folder.admit()  # for the user's actors, as in the processes of a run
    try:
        if arguments[:1] == ["campaign"]:
            from rampart.cli.analyse import campaign_verb  # noqa: PLC0415 others need no physics

            options = campaign_verb.parse(arguments[1:])
        else:
            parser = build_parser()
            argcomplete.autocomplete(parser)
            if not arguments:
                say_text(parser.format_help())
                return 0
            options = parser.parse_args(arguments)
        return int(options.run(options))
    except NoEffectError as error:
        warn(str(error))
        return 1
    except OSError as error:
        warn(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        return 2
    except (ValueError, BagError, BusError, NoRunError, SignalError) as error:
        warn(str(error))
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
