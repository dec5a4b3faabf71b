"""Hung, or merely without a processor? How long a process could have answered and did not.

A deadline alone takes a starved process for a hung one: on a busy machine a process may wait for a
processor longer than any sensible deadline, and killing it makes the machine busier. So only time
counts in which the process could have run:

* not what it spent in the run queue, which the kernel counts (`/proc/PID/schedstat`, proc(5));
* of a process that is on the run queue right now, only what it has run, for the kernel adds the
  wait that is not over yet later: spinning is found out, waiting is not;
* of the time before the first look, for which there are no figures, all or nothing: nothing if it
  is on the run queue then, and mostly waits until the next look;
* nothing while the kernel itself makes it wait (state D: a disk, or memory that is swapped);
* and no more than a moment a look, so that a caller that stood still itself blames no other.

A stopped process (state T) is not on the run queue: all of its time counts.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rampart.actors.machine.unix_peer import process_state


class Usage(NamedTuple):
    """What the kernel has counted for the main thread of a process, and its state letter now.

    A thread that sleeps may wait for another one of its process, and that one for a processor: then
    the state is R as well.
    """

    state: str
    ran_s: float
    waited_s: float


AT_LEISURE = Usage("S", 0.0, 0.0)
"""Of a process that waits for nothing."""


def usage(pid: int) -> Usage:
    """Return the usage of a process; without figures, where the kernel keeps none."""
    try:
        text = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii")
        ran_ns, waited_ns, _slices = map(int, text.split())
    except (OSError, ValueError):
        ran_ns = waited_ns = 0
    state = process_state(pid)
    with contextlib.suppress(OSError):  # it has ended
        if state == "S" and any(map(_is_on_run_queue, Path(f"/proc/{pid}/task").iterdir())):
            state = "R"
    return Usage(state, ran_ns / 1e9, waited_ns / 1e9)


def _is_on_run_queue(thread: Path) -> bool:
    try:
        stat = (thread / "stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # it has ended
        return False
    return stat.rpartition(")")[2].split()[0] == "R"


@dataclass(slots=True)
class Patience:
    """With one process that owes an answer. Pure; times are seconds of the caller's clock.

    Args:
        look_s: The longest time between two looks that counts.
    """

    look_s: float
    _pid: int = 0
    _at_s: float = 0.0
    _used: Usage = AT_LEISURE
    _counted_s: float = 0.0
    _doubtful_s: float = 0.0

    def answered(self) -> None:
        """It owes nothing: begin anew."""
        self._pid = 0

    def look(self, now_s: float, pid: int, used: Usage, owes_since_s: float | None = None) -> float:
        """Return for how many seconds a process that has not answered could have.

        Args:
            now_s: Now.
            pid: Of the process; another one than at the last look begins anew.
            used: By it.
            owes_since_s: Since when it owes the answer, if not since the first look.
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
