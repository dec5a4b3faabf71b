"""`rampart top`: the run in a terminal, for those without a browser."""

from __future__ import annotations

import argparse
import asyncio
from typing import Any


def add(verbs: Any, formatter: Any, common: argparse.ArgumentParser) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser(
        "top", parents=[common], formatter_class=formatter,
        help="the run in the terminal, refreshed four times a second",
        description="Show the robot, mechanisms, decisions, processes and topic rates"
                    "\nof the run. Keys: q or Ctrl-C quits, c sorts by CPU, arrows scroll.\n"
                    "Processor time is in percent of one core; memory is resident, most of it "
                    "shared.",
        epilog="examples:\n  rampart top\n  rampart top --follow          stay for the next run\n"
               "  rampart top --once | less\n  NO_COLOR=1 rampart top\n"
               "  rampart top --json | python3 -m json.tool")
    parser.add_argument("--once", action="store_true", help="print one picture and end")
    parser.add_argument("--json", action="store_true", help="print one picture as JSON and end")
    parser.add_argument("--follow", action="store_true",
                        help="wait for a run if there is none, and for the next when one ends")
    parser.set_defaults(run=_top)


def _top(options: argparse.Namespace) -> int:
    from rampart.cli.look.top_screen import top  # noqa: PLC0415 no other verb should wait for it

    return asyncio.run(top(options))
