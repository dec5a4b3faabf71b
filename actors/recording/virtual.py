"""Recording of a run in virtual time, in the same process; the same run gives the same file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rampart.actors.recording.bag_writer import BagError, BagWriter, open_target
from rampart.actors.recording.run_documents import collect

FLUSH_S = 10.0
"""Simulated seconds between two flushes: some tenths of a real second."""


class VirtualRecording:
    """One recording. Call `take` for each message, then `close`.

    If the file cannot be written any more, the recording ends and the run goes on.

    Args:
        path: path of the file.
        plan: plan of the run (`RunPlan.description`).
        title: title for people.
        nodes: names of the nodes.
        lead_s: whole simulated seconds from the start of the run to simulated time 0.
        overwrite: whether the file may exist.

    Raises:
        BagError: the file cannot be written.
    """

    def __init__(self, path: Path, plan: Mapping[str, Any], title: str, *,
                 nodes: Iterable[str], lead_s: float, overwrite: bool) -> None:
        self._path = path
        self._failed = ""
        self._next_flush_s = 0.0
        documents = collect(plan, run_id=f"virtual-{plan.get('seed')}", title=title, rate=1.0,
                            nodes=tuple(nodes), started="")
        file = open_target(path, overwrite=overwrite)
        try:
            self._writer = BagWriter(file, documents, time_zero_s=-lead_s,
                                     views=documents.known.views(), from_start=True)
        except OSError as error:
            file.close()
            raise BagError(f"{path}: {error.strerror or error}") from None

    @property
    def problem(self) -> str:
        """Why the recording has ended before the run; "" if it has not."""
        return self._failed

    def take(self, at_s: float, key: str, payload: bytes) -> None:
        """Record a message that was sent at a simulated time."""
        if self._failed:
            return
        try:
            self._writer.take(at_s, key, payload)
            if at_s >= self._next_flush_s:
                self._next_flush_s = at_s + FLUSH_S
                self._writer.flush()
        except Exception as error:  # the run goes on in any case
            self._fail(error)

    def close(self) -> str:
        """Write the end of the file, and return one line about the recording."""
        if not self._failed:
            try:
                self._writer.close({"ended": "the run has ended"})
            except Exception as error:
                self._fail(error)
        if not self._failed and not self._path.exists():
            return f"{self._path}: was removed while it was written: nothing is recorded"
        return self._failed or f"recorded {self._writer.messages} messages in {self._path}"

    def _fail(self, error: Exception) -> None:
        self._writer.abandon()
        why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        self._failed = (f"{self._path}: {why}: the recording ends after "
                        f"{self._writer.messages} messages")
