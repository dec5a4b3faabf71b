"""Runs all tests but the slow ones: what waits, what needs the machine for itself, what computes.

    python -m tests.suite

*In a crowd*, one worker more than cores: many of these wait more than they compute.

*In pairs*, two files at a time: what has a mission of the real robot against the clock. A mission
takes less than a core.

*Beside both*, at the lowest priority, lint, types and the tests that only compute: they take what
is left, and do not care when. (Not jobs of a shell: these would have SIGINT ignored, and so would
the runs that tests start.)

Nothing is tried twice: a test that fails now and then is mended.

A Linux that groups processes by session gives each group the same, whatever the niceness within: so
what is beside is a session of its own, and the group's is set as well (sched(7), autogroup). Exit
code 0 if all have passed.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import VIRTUAL

_PYTEST = (sys.executable, "-m", "pytest", "-m")
_CROWD = "not slow and not nightly and not alone and (not virtual or processes)"
_ALONE = "alone and not slow and not nightly"
_COMPUTES = "virtual and not slow and not nightly and not alone and not processes"
_LOWEST = 19


def main() -> int:
    """Run all; what is beside is printed when it is over."""
    with tempfile.TemporaryDirectory() as folder:
        computes = (*_PYTEST, _COMPUTES, "--numprocesses", "logical",
                    "-o", f"cache_dir={folder}", *VIRTUAL)
        with (beside(sys.executable, "-m", "ruff", "check", ".") as lint,
              beside(sys.executable, "-m", "mypy") as types, beside(*computes) as computing):
            codes = [subprocess.run(command, check=False).returncode for command in (
                (*_PYTEST, _CROWD, "--numprocesses", str((os.cpu_count() or 1) + 1)),
                (*_PYTEST, _ALONE, "--numprocesses", "2", "--dist", "loadfile",
                 *having("mark.alone")))]
            codes += [process.wait() for process in (lint, types, computing)]
    return int(any(codes))


@contextlib.contextmanager
def beside(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Have a command run at the lowest priority; print at the end what it has said."""
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(["nice", "-n", str(_LOWEST), *command], stdout=said,
                                   stderr=subprocess.STDOUT, start_new_session=True, text=True)
        with contextlib.suppress(OSError):  # not every kernel has groups
            Path(f"/proc/{process.pid}/autogroup").write_text(str(_LOWEST), encoding="ascii")
        try:
            yield process
        finally:
            process.terminate()
            process.wait()
            said.seek(0)
            print(said.read(), flush=True)


def having(words: str) -> list[str]:
    """Return the files of tests in which these words are: to collect all of them takes long."""
    return sorted(str(file) for file in Path("tests").rglob("test_*.py")
                  if words in file.read_text(encoding="utf-8"))


if __name__ == "__main__":
    sys.exit(main())
