"""What takes disk, descriptors, memory or the time of day away from a running system."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun


class OwnClock:
    """A time of day for a run alone, which may jump."""

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("no C compiler: the time of day cannot be changed for one run alone")
        library, self._file = folder / "clock_shift.so", folder / "shift"
        subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", str(library),
                        str(Path(__file__).with_name("clock_shift.c"))], check=True)
        self.before_command = ("env", f"LD_PRELOAD={library}", f"SHIFT_FILE={self._file}")
        self._file.write_bytes(bytes(8))

    def jump(self, shift_s: int) -> None:
        """Be so far off the true time from now on."""
        with self._file.open("r+b", buffering=0) as shift:
            shift.write(shift_s.to_bytes(8, sys.byteorder, signed=True))


@contextmanager
def small_disk(folder: Path, size_mb: int) -> Iterator[Path]:
    """Mount a file system that is soon full."""
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size_mb}m,mode=0700", "tmpfs", str(folder)],
        check=False, capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system may be mounted here: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def small_files(size: int) -> Callable[[], None]:
    """Have no file of a process be larger: as on a full disk, writing fails."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def fill(folder: Path) -> Path:
    """Write a file until the disk is full."""
    file = folder / "filler"
    with file.open("wb", buffering=0) as filler:
        try:
            while True:
                filler.write(bytes(4096))
        except OSError:
            return file


def processes(run: RealRun) -> dict[str, psutil.Process]:
    """Return the processes of a run that are there now, the launcher among them."""
    found = {" ".join(p.names): psutil.Process(p.pid) for p in find_processes(run.port)}
    return found | {"launcher": psutil.Process(run.process.pid)}


@contextmanager
def no_descriptor_left(run: RealRun) -> Iterator[None]:
    """Let no process of a run open anything more."""
    held = processes(run)
    before = {pid: resource.prlimit(pid, resource.RLIMIT_NOFILE)
              for pid in (process.pid for process in held.values())}
    for pid, (_, hard) in before.items():
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, hard))
    try:
        yield
    finally:
        for pid, limits in before.items():
            if psutil.pid_exists(pid):
                resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)


@contextmanager
def member(run: RealRun, script: str, *arguments: str, key: str | Path = ""
           ) -> Iterator[subprocess.Popen[str]]:
    """Run a script that is told the port of a run to join; wait until it says it is there.

    Args:
        key: with which it joins a run with keys.
    """
    with subprocess.Popen([sys.executable, "-c", script, *arguments, str(run.port)],
                          env={**os.environ, "RAMPART_KEY": str(key)},
                          stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "here\n"
            yield process
        finally:
            process.kill()
