"""`rampart top`: the run in the terminal, for those without a browser."""

from __future__ import annotations

import argparse
from collections.abc import Coroutine
from typing import Any

from rampart.cli.verbs import PORT, add_verb, flag


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "top", "the run in the terminal, refreshed four times a second", top, PORT,
             flag("--once", "print one picture and end"),
             flag("--json", "print one picture as JSON and end"),
             flag("--follow", "wait for a run if there is none, and for the next when one ends"))


def top(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Show the run.

    Show the robot, mechanisms, decisions, processes and topic rates
    of the run. Keys: q or Ctrl-C quits, c sorts by CPU, arrows scroll.
    Processor time is in percent of one core; memory is resident, most of it shared.

    Examples:
      rampart top
      rampart top --follow          stay for the next run
      rampart top --once | less
      NO_COLOR=1 rampart top
      rampart top --json | python3 -m json.tool
    """
    from rampart.cli.look import top_screen  # noqa: PLC0415 no other verb should wait for it

    return top_screen.top(options)
