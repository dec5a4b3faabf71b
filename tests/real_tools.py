"""Verbs of `rampart` on a real run, in the process of the test.

Tests that poll a run use them: a new interpreter for each look takes most of a processor.
"""

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
