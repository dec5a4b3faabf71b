"""Distinguishes a hung process from one that waits for a processor.

A deadline alone does not. On a busy machine a process may wait for a processor longer than any
useful deadline, and a kill makes the machine busier. So only time in which the process could have
run counts:

* Its wait in the run queue does not count (`/proc/PID/schedstat`, proc(5)).
* If it is in the run queue right now, only its run time counts, since the kernel adds the present
  wait later. So a process that spins is found, and one that waits is not blamed.
* There are no figures for the time before the first check. That time does not count if the process
  is in the run queue then, and mostly waits until the next check. Otherwise all of it counts.
* Time in state D does not count: the kernel makes the process wait for a disk or swapped memory.
* Between two checks only a short time counts, so a caller that was stopped blames no process.

A stopped process (state T) is not in the run queue, so all of its time counts.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rampart.actors.machine.unix_peer import process_state


class Usage(NamedTuple):
    """State letter of a process, and the kernel's figures for its main thread.

    A sleeping main thread may wait for another thread, which waits for a processor. Then the state
    is R, too.
    """

    state: str
    ran_s: float
    waited_s: float


AT_LEISURE = Usage("S", 0.0, 0.0)
"""Usage of a process that does not wait for a processor."""


def usage(pid: int) -> Usage:
    """Return the usage of a process; its figures are 0 where the kernel has none."""
    try:
        text = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii")
        ran_ns, waited_ns, _slices = map(int, text.split())
    except (OSError, ValueError):
        ran_ns = waited_ns = 0
    state = process_state(pid)
    with contextlib.suppress(OSError):  # it has ended
        if state == "S" and any(process_state(f"{pid}/task/{thread.name}") == "R"
                                for thread in Path(f"/proc/{pid}/task").iterdir()):
            state = "R"
    return Usage(state, ran_ns / 1e9, waited_ns / 1e9)


@dataclass(slots=True)
class Patience:
    """Patience with one process that owes an answer. Pure; times are seconds of the caller's clock.

    Args:
        look_s: The longest time between two checks that counts.
    """

    look_s: float
    _pid: int = 0
    _at_s: float = 0.0
    _used: Usage = AT_LEISURE
    _counted_s: float = 0.0
    _doubtful_s: float = 0.0

    def answered(self) -> None:
        """Note an answer: nothing counts so far."""
        self._pid = 0

    def look(self, now_s: float, pid: int, used: Usage, owes_since_s: float | None = None) -> float:
        """Return for how many seconds the process could have answered.

        Args:
            now_s: Now.
            pid: Of the process; a pid other than the last one starts from 0.
            used: Its usage.
            owes_since_s: Since when it owes the answer, if not since the first check.
        """
        if pid != self._pid:
            self._pid = pid
            owed_s = 0.0 if owes_since_s is None else now_s - owes_since_s
            self._counted_s, self._doubtful_s = (
                (0.0, owed_s) if used.state == "R" else (owed_s, 0.0))
        elif used.state != "D":
            passed_s = now_s - self._at_s
            could_s = passed_s - (used.waited_s - self._used.waited_s)
            if used.state == "R":
                could_s = min(could_s, used.ran_s - self._used.ran_s)
            if could_s >= passed_s / 2:
                self._counted_s += self._doubtful_s
            self._doubtful_s = 0.0
            self._counted_s += min(max(0.0, could_s), self.look_s)
        self._at_s, self._used = now_s, used
        return self._counted_s
