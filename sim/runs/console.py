"""What a run tells on the terminal: one line per event, and a live line where there is a tty."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, TextIO

from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.messages import Diagnostic
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm.narrator import Narrator
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import SUPERVISOR, RunPlan
from rampart.files.plain_text import one_line, printable
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.runs.record import RunRecord

REPORTS_PER_S = 10
"""Error reports shown in a real second."""

LINES_PER_S = 50
"""Other lines shown in a real second."""

LINE_CHARS = 400
"""Longest line that is shown."""


class Console:
    """Writes the story of a run to a stream as it happens.

    What it is told comes from the bus, and from any sender: each line is made printable and
    clipped, and of more lines than can be read the number is told instead. In virtual time there
    are no other senders, and a second may be a whole mission: there all lines are shown. A robot
    derives its own for what it has to tell.

    Class attributes:
        example: of a node to kill; a system that has it not offers its first that a recovery
            brings back.

    Args:
        stream: where to.
        clock: real seconds.
    """

    example: ClassVar[str] = ""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        self._is_limited = True
        self._narrator = Narrator()
        self._reports = RateLimit(REPORTS_PER_S)
        self._others = RateLimit(LINES_PER_S)
        self._live = stream.isatty()
        self._live_text = ""
        self._last_live_s = 0.0

    def banner(self, what: str, plan: RunPlan, spec: SystemSpec, *, virtual: bool = False) -> None:
        """Say what is about to run, and in real time how to disturb it."""
        self._is_limited = not virtual
        self._narrator.titles = spec.titles
        mode = spec.strategy if plan.ftm else "no fault tolerance"
        time_is = f"virtual time, seed {plan.seed}" if virtual else f"rate {plan.rate:g}"
        self.say(f"Rampart: {what}, {mode}, {time_is}")
        if virtual:
            return
        if comes_back := [node.name for node in spec.nodes if node.respawn != SUPERVISOR]:
            example = self.example if self.example in comes_back else comes_back[0]
            self.say(f"Try from another shell: kill-node {example}")

    def speed(self, times: float, messages: int, trace: str) -> None:
        """Say how fast virtual time went, and by what the run can be recognised."""
        self.say(f"{times:.0f} times real time, {messages} messages, trace {trace[:16]}")

    def take(self, _topic: Topic[Any], message: Any, header: Header) -> None:
        """Take one message of the run."""
        at = header.stamp
        now_s = self._clock()
        if count := self._reports.left_out(now_s) + self._others.left_out(now_s):
            self.say(f"[{at:7.2f} s] {count} more lines were left out")
        limit = self._reports if isinstance(message, Diagnostic) else self._others
        for line in self._narrator.describe(message, header):
            self.line(at, line.text, limit)

    def line(self, at_s: float, text: str, limit: RateLimit | None = None) -> None:
        """Write one line with its simulated time, unless there are too many of its kind."""
        if not self._is_limited or (limit or self._others).allows(self._clock()):
            self.say(f"[{at_s:7.2f} s] {one_line(text, LINE_CHARS)}")

    def conclusion(self, record: RunRecord, report: Path | None) -> None:
        """Say how it ended, and where the report is, if there is one."""
        for line in self.verdict(record):
            self.say(line)
        for reason in record.reasons:
            self.say(f"  {reason}")
        if (kept_up := record.keeping_up) and kept_up.behind_s:
            self.say(f"  for {kept_up.behind_s:.0f} s of {record.duration_s:.0f} s {kept_up}")
        if report is not None:
            self.say(f"Report: {report}")

    def verdict(self, record: RunRecord) -> list[str]:
        """Return the verdict of a run that was judged, in lines."""
        if record.mission is None:
            return []
        safety = "safety not known" if record.safety == "not known" else record.safety
        return [f"{record.mission}, {safety}, {record.duration_s:.1f} s simulated."]

    def show_live(self, text: str, at_s: float) -> None:
        """Show a line in place of the last one, four times a simulated second, on a terminal."""
        if not self._live or at_s - self._last_live_s < 0.25:
            return
        self._last_live_s = at_s
        self.close()
        self._live_text = printable(text)[:shutil.get_terminal_size().columns - 1]
        self._stream.write(self._live_text)
        self._stream.flush()

    def close(self) -> None:
        """Take the live line away."""
        if self._live_text:
            self._stream.write("\r\x1b[K")
            self._live_text = ""

    def say(self, text: str) -> None:
        """Write a line."""
        self.close()
        self._stream.write(printable(text) + "\n")
        self._stream.flush()
