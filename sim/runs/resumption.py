"""The files with which a run can be resumed, and how they are found.

The report's directory holds a manifest (`run.json`: the run's id, its arguments, and digests of its
input files), the nodes' checkpoints, and a copy of the run's record. Every process of the run locks
the directory (flock(2)). So a locked run lives, even if its launcher has died.

A resumed run has the same run id and the next part number. Its simulated time continues a little
after the record, so that no state is from the future.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.launcher import STARTUP_S
from rampart.files.writing import replace_file

MANIFEST = "run.json"
FORMAT = 1
_LARGEST_BYTES = 64 << 20

_PATIENCE_S = 3.0
"""Real seconds in which the processes of a run end after their launcher was killed."""

AFTER_S = 2.0 + STARTUP_S[1]
"""Real seconds from the copy of the record to the beginning of the next part. A copy is made
each second, checkpoints may be newer, and the processes start before the part begins.
"""


class ResumptionError(ValueError):
    """A run cannot be resumed. The text is one line that names the run and the reason."""


class Manifest(msgspec.Struct, frozen=True):
    """A run and its start.

    Attributes:
        format: Version of the file format.
        run_id: Name of the run.
        part: Number of resumptions.
        arguments: Arguments of the command line.
        choices: Options that a resumed run must share, by name.
        rate: Simulated seconds per second.
        digests: SHA-256 of each input file, by path.
        ended: How the run ended; "" if it has not.
    """

    format: int
    run_id: str
    part: int
    arguments: tuple[str, ...]
    choices: dict[str, Any]
    rate: float
    digests: dict[str, str]
    ended: str = ""


def manifest_of(plan: RunPlan, arguments: Iterable[str], files: Iterable[Path]) -> Manifest:
    """Return the manifest of a run that is about to start.

    Raises:
        OSError: a file cannot be read.
    """
    paths = sorted({str(file.resolve()) for file in (Path(plan.system_file), *files)})
    digests = {path: hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in paths}
    choices = {name: getattr(plan, name)
               for name in ("system_file", "strategy", "shadow", "ftm", "seed")}
    return Manifest(FORMAT, plan.run_id, plan.part, tuple(arguments), {**choices, **plan.options},
                    plan.rate, digests)


def differences(before: Manifest, now: Manifest) -> str:
    """Return the first difference between a run and its resumption; "" if there is none."""
    for name in sorted(before.choices.keys() | now.choices.keys()):
        was, is_now = before.choices.get(name), now.choices.get(name)
        if msgspec.json.encode(was) != msgspec.json.encode(is_now):
            return f"{name} is {is_now!r}, expected {was!r} as in the run"
    for path, digest in before.digests.items():
        if now.digests.get(path) != digest:
            return f"{path} has changed since the run was started"
    return ""


class RunFiles:
    """The files of a run in the directory of its report.

    Args:
        directory: Directory of the report.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._lock = -1

    def lock(self) -> bool:
        """Lock the directory for this process and its forks; return whether that succeeded.

        Raises:
            OSError: The directory does not exist.
        """
        if self._lock < 0:
            self._lock = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.unlock()
            return False
        return True

    def unlock(self) -> None:
        """Unlock the directory. Harmless when repeated."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def manifest(self) -> Manifest:
        """Return the manifest.

        Raises:
            ResumptionError: The manifest is missing or damaged.
        """
        file = self.directory / MANIFEST
        try:
            found = msgspec.json.decode(_content(file), type=Manifest)
        except FileNotFoundError:
            raise ResumptionError(f"{self.directory}: no run that can be resumed: no {MANIFEST} "
                                  "in it") from None
        except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
            raise ResumptionError(f"{file}: damaged: {error}") from None
        if found.format != FORMAT:
            raise ResumptionError(f"{file}: format: {found.format}, expected {FORMAT}")
        return found

    def save(self, manifest: Manifest) -> None:
        """Write the manifest.

        Raises:
            ResumptionError: It cannot be written.
        """
        file = self.directory / MANIFEST
        try:
            replace_file(file, msgspec.json.format(msgspec.json.encode(manifest)))
        except OSError as error:
            raise ResumptionError(f"{file}: cannot be written: {error.strerror}") from None

    def saved(self) -> bytes | None:
        """Return the manifest's bytes; None if it is missing or unreadable."""
        try:
            return _content(self.directory / MANIFEST)
        except OSError:
            return None

    def put_back(self, saved: bytes | None) -> None:
        """Restore the manifest after a run that did not start.

        Raises:
            OSError: It cannot be written.
        """
        if saved is None:
            (self.directory / MANIFEST).unlink(missing_ok=True)
        elif saved != self.saved():
            replace_file(self.directory / MANIFEST, saved)

    def end(self, manifest: Manifest) -> None:
        """Write the manifest of a run that has ended, and remove the copy of its record.

        Raises:
            ResumptionError: The manifest cannot be written.
            OSError: The copy cannot be removed.
        """
        self.save(manifest)
        self._memory(manifest.run_id).unlink(missing_ok=True)

    def keep_memory(self, run_id: str, memory: bytes) -> None:
        """Replace the copy of a run's record.

        Raises:
            OSError: It cannot be written; the one before stays.
        """
        replace_file(self._memory(run_id), hashlib.sha256(memory).digest() + memory)

    def recall(self, run_id: str, recall: Callable[[bytes], float]) -> tuple[float, str]:
        """Load the copy of a run's record.

        Args:
            run_id: Name of the run.
            recall: Takes the copy and returns its time, simulated seconds.

        Returns:
            That time, 0 without a copy; and why a copy could not be loaded, "" if it could.
        """
        file = self._memory(run_id)
        try:
            data = _content(file)
            if hashlib.sha256(data[32:]).digest() != data[:32]:
                raise msgspec.DecodeError("its checksum is wrong")
            return recall(data[32:]), ""
        except FileNotFoundError:
            return 0.0, ""
        except (OSError, msgspec.DecodeError) as error:
            return 0.0, f"{file}: damaged: {error}"

    def _memory(self, run_id: str) -> Path:
        return self.directory / f"record-{run_id}.memory"


def find(reports: Path, which: str) -> tuple[RunFiles, Manifest]:
    """Return the files of a run that can be resumed, locked, and its manifest.

    Args:
        reports: Folder of the reports.
        which: Directory of a run's report, its name in `reports`, or the run's id; "" for the
            newest run that did not end.

    Raises:
        ResumptionError: The run does not exist, has ended, lives, or is damaged.
    """
    directory = _newest(reports) if not which else _named(reports, which)
    files = RunFiles(directory)
    until_s = time.monotonic() + _PATIENCE_S
    while not files.lock():
        if time.monotonic() > until_s:
            raise ResumptionError(f"{directory}: the run still lives")
        time.sleep(0.05)
    try:
        manifest = files.manifest()
        if manifest.ended:
            raise ResumptionError(f"{directory}: the run has ended ({manifest.ended})")
    except BaseException:
        files.unlock()
        raise
    return files, manifest


def _newest(reports: Path) -> Path:
    found = sorted(reports.glob(f"*/{MANIFEST}"), key=lambda file: -file.lstat().st_mtime)
    damaged = None
    for file in found:
        try:
            if not RunFiles(file.parent).manifest().ended:
                return file.parent
        except ResumptionError as error:
            damaged = damaged or error
    raise damaged or ResumptionError(f"{reports}: no run that did not end")


def _named(reports: Path, which: str) -> Path:
    for directory in (Path(which), reports / which):
        if directory.is_dir():
            return directory
    for file in reports.glob(f"*/{MANIFEST}"):
        with contextlib.suppress(ResumptionError):
            if RunFiles(file.parent).manifest().run_id == which:
                return file.parent
    raise ResumptionError(f"{which}: no such run; expected the directory of a report, its name in "
                          f"{reports}, or a run's id")


def _content(file: Path) -> bytes:
    with file.open("rb") as opened:
        data = opened.read(_LARGEST_BYTES + 1)
    if len(data) > _LARGEST_BYTES:
        raise OSError(0, f"more than {_LARGEST_BYTES} bytes")
    return data
