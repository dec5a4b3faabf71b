"""Runs all tests but the slow ones: what waits, what needs the machine for itself, what computes.

    python -m tests.suite

*In a crowd*, one worker more than cores: many of these wait more than they compute. What fails in
that crowd, as a wait of half a second may, is run once more by itself, and counts then.

*In pairs*, two files at a time: what has a mission of the real robot against the clock. A mission
takes less than a core. What fails beside another is run once more alone, and counts then.

*Beside both*, at the lowest priority, what only computes: it takes what is left, and does not care
when. What fails there is run once more when the machine is free. (Not a job of a shell: that would
have SIGINT ignored, and so would the runs that tests start.)

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
_SOME_FAILED = 1
"""Exit code of pytest; others say that it could not work."""


def main() -> int:
    """Run all; what is beside is printed when it is over."""
    with tempfile.TemporaryDirectory() as folder:
        cache = ("-o", f"cache_dir={folder}/beside")
        computing = [*_PYTEST, _COMPUTES, "--numprocesses", "logical", *cache, *VIRTUAL]
        with beside(computing) as virtual:
            crowd = twice(f"{folder}/crowd", _CROWD,
                          "--numprocesses", str((os.cpu_count() or 1) + 1))
            alone = twice(f"{folder}/alone", _ALONE, *having("mark.alone"),
                          "--numprocesses", "2", "--dist", "loadfile")
            computes = virtual.wait()
        if computes == _SOME_FAILED:
            computes = once_more(_COMPUTES, *cache, *VIRTUAL)
    return crowd or alone or computes


def twice(folder: str, which: str, *arguments: str) -> int:
    """Run tests, and once more by themselves those that failed; return the exit code."""
    cache = ("-o", f"cache_dir={folder}")
    code = subprocess.run([*_PYTEST, which, *arguments, *cache], check=False).returncode
    return once_more(which, *cache) if code == _SOME_FAILED else code


def once_more(which: str, *arguments: str) -> int:
    """Run those that failed, one after the other."""
    print("once more, by themselves:", flush=True)
    return subprocess.run([*_PYTEST, which, "--last-failed", *arguments], check=False).returncode


@contextlib.contextmanager
def beside(command: list[str]) -> Iterator[subprocess.Popen[str]]:
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
