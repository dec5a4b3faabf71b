"""Runs what needs the machine for itself, and beside it, politely, what only computes.

    python -m tests.beside

A mission on real processes takes half a core; what is in virtual time takes what is left, at the
lowest priority, and does not care when. What fails there is run once more when the machine is free,
and counts then. Exit code 0 if all have passed. (Not a job of a shell: that would have SIGINT
ignored, and so would the runs that tests start.)

A Linux that groups processes by session gives each group the same, whatever the niceness within: so
those beside are a session of their own, and the group's is set as well (sched(7), autogroup).
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.conftest import VIRTUAL

_PYTEST = (sys.executable, "-m", "pytest", "-m")
_VIRTUAL = "virtual and not slow and not alone and not processes"
_LOWEST = 19


def main() -> int:
    """Run both; what is beside is printed when it is over."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as said:
        cache = ("-o", f"cache_dir={folder}")
        virtual = subprocess.Popen(
            ["nice", "-n", str(_LOWEST), *_PYTEST, _VIRTUAL, "--numprocesses", "logical", *cache,
             *VIRTUAL],
            stdout=said, stderr=subprocess.STDOUT, start_new_session=True)
        with contextlib.suppress(OSError):  # not every kernel has groups
            Path(f"/proc/{virtual.pid}/autogroup").write_text(str(_LOWEST), encoding="ascii")
        try:
            alone = subprocess.run([*_PYTEST, "alone and not slow", *having("mark.alone")],
                                   check=False).returncode
            beside = virtual.wait()
        finally:
            virtual.terminate()
        said.seek(0)
        print(said.read(), flush=True)
        if beside == 1:
            print("once more, by themselves:", flush=True)
            beside = subprocess.run([*_PYTEST, _VIRTUAL, "--last-failed", *cache, *VIRTUAL],
                                    check=False).returncode
    return alone or beside


def having(words: str) -> list[str]:
    """Return the files of tests in which these words are: to collect all of them takes long."""
    return sorted(str(file) for file in Path("tests").rglob("test_*.py")
                  if words in file.read_text(encoding="utf-8"))


if __name__ == "__main__":
    sys.exit(main())
