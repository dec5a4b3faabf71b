"""Completion in the shell (argcomplete): verbs, and nodes, topics and faults of the run.

`eval "$(register-python-argcomplete rampart kill-node)"` in the shell's start-up file turns it on.
"""

from __future__ import annotations

import argparse
import contextlib
from typing import Any

from rampart.actors.bus.run_info import find_runs
from rampart.actors.system.layout import published_keys
from rampart.cli import systems
from rampart.sim.faults.faults import faults_of


def nodes(**_: Any) -> list[str]:
    """Return the nodes of all runs of this machine."""
    return sorted({name for run in find_runs() for name in run.nodes})


def topics(parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Return the keys that the nodes of the run, or of the shipped system, publish."""
    with contextlib.suppress(ValueError):
        return sorted(published_keys(systems.at_hand(None, getattr(parsed_args, "port", None))))
    return []


def faults(parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Return the named faults of the run, or of the shipped system."""
    with contextlib.suppress(ValueError):
        known = faults_of(systems.at_hand(None, getattr(parsed_args, "port", None)))
        return [*known.named, *(fault.name for fault in known.offered())]
    return []
