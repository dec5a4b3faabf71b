"""Verbs of `rampart` on a real run, in the process of the test.

Tests that poll a run use them: a new interpreter for each look takes most of a processor.
"""

import contextlib
import io
from typing import Any

import psutil

from rampart.actors.supervision.process_title import find_processes
from rampart.cli.main import main
from rampart.testing import RealRun


def printed(run: RealRun, *arguments: str) -> str:
    """Return the output of a verb, called in the folder of the run."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.chdir(run.directory):
        main([*arguments, "--port", str(run.port)])
    return said.getvalue()


def connections(run: RealRun) -> list[Any]:
    """Return the connections over the network of all processes of a run."""
    found = []
    for pid in (run.process.pid, *(p.pid for p in find_processes(run.port))):
        with contextlib.suppress(psutil.NoSuchProcess):  # one of the pool may just have ended
            found += psutil.Process(pid).net_connections("inet")
    return found
