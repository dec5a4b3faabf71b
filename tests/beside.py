"""Runs what needs the machine for itself, and beside it, politely, what only computes.

    python -m tests.beside

A mission on real processes takes half a core; what is in virtual time takes what is left, at the
lowest priority, and does not care when. Exit code 0 if both have passed. (Not a job of a shell:
that would have SIGINT ignored, and so would the runs that tests start.)
"""

from __future__ import annotations

import subprocess
import sys
import tempfile

_PYTEST = (sys.executable, "-m", "pytest", "-m")


def main() -> int:
    """Run both; what is beside is printed when it is over."""
    with tempfile.TemporaryFile("w+") as said:
        virtual = subprocess.Popen(
            ["nice", "-n", "19", *_PYTEST, "virtual and not slow and not alone and not processes",
             "--numprocesses", "logical"], stdout=said, stderr=subprocess.STDOUT)
        alone = subprocess.run([*_PYTEST, "alone and not slow"], check=False).returncode
        beside = virtual.wait()
        said.seek(0)
        print(said.read(), flush=True)
    return alone or beside


if __name__ == "__main__":
    sys.exit(main())
