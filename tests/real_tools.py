"""Verbs of `rampart` on a real run, in the process of the test.

A look at a run takes 10 ms. A new interpreter for each look takes half a second of a processor.
"""

from __future__ import annotations

import contextlib
import io

from rampart.cli.main import main
from rampart.testing import RealRun


def printed(run: RealRun, *arguments: str) -> str:
    """Return the output of a verb, called in the folder of the run."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.chdir(run.directory):
        main([*arguments, "--port", str(run.port)])
    return said.getvalue()
