"""Terminal output of a run: one line per event, and a live line on a tty."""

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
"""Error reports shown per real second."""

LINES_PER_S = 50
"""Other lines shown per real second."""

LINE_CHARS = 400
"""Longest shown line."""


class Console:
    """Writes the events of a run to a stream as they happen.

    The text comes from the bus and from any sender. So each line is made printable and clipped, and
    above a rate only the number of lines is shown. In virtual time there are no foreign senders and
    a second may be a whole mission, so all lines are shown. A robot derives a class for its events.

    Class attributes:
        example: Node to kill in the hint at the start; by default, the first node that a recovery
            module restarts.

    Args:
        stream: Output.
        clock: Real seconds.
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
        """Print the system of the run and, in real time, how to disturb it."""
        self._is_limited = not virtual
        self._narrator.titles = spec.titles
        mode = spec.strategy if plan.ftm else "no fault tolerance"
        time_is = f"virtual time, seed {plan.seed}" if virtual else (
            f"rate {plan.rate:g}, port {plan.base_port}")
        self.say(f"Rampart: {what}, {mode}, {time_is}")
        if virtual:
            return
        if comes_back := [node.name for node in spec.nodes if node.respawn != SUPERVISOR]:
            example = self.example if self.example in comes_back else comes_back[0]
            self.say(f"Try from another shell: kill-node {example}")

    def speed(self, times: float, messages: int, trace: str) -> None:
        """Print the speed of virtual time and the hash of the run."""
        self.say(f"{times:.0f} times real time, {messages} messages, trace {trace[:16]}")

    def take(self, _topic: Topic[Any], message: Any, header: Header) -> None:
        """Print the lines of one message."""
        at = header.stamp
        now_s = self._clock()
        if count := self._reports.left_out(now_s) + self._others.left_out(now_s):
            self.say(f"[{at:7.2f} s] {count} more lines were left out")
        limit = self._reports if isinstance(message, Diagnostic) else self._others
        for line in self._narrator.describe(message, header):
            self.line(at, line.text, limit)

    def line(self, at_s: float, text: str, limit: RateLimit | None = None) -> None:
        """Print a line with its simulated time, unless its rate is too high."""
        if not self._is_limited or (limit or self._others).allows(self._clock()):
            self.say(f"[{at_s:7.2f} s] {one_line(text, LINE_CHARS)}")

    def conclusion(self, record: RunRecord, report: Path | None) -> None:
        """Print the result, and the path of the report if there is one."""
        for line in self.verdict(record):
            self.say(line)
        for reason in record.reasons:
            self.say(f"  {reason}")
        if (kept_up := record.keeping_up) and kept_up.behind_s:
            self.say(f"  late for {kept_up.behind_s:.0f} s of {record.duration_s:.0f} s: {kept_up}")
        if report is not None:
            self.say(f"Report: {report}")

    def verdict(self, record: RunRecord) -> list[str]:
        """Return the lines of the verdict; none without a judge."""
        if record.mission is None:
            return []
        safety = "safety not known" if record.safety == "not known" else record.safety
        return [f"{record.mission}, {safety}, {record.duration_s:.1f} s simulated."]

    def show_live(self, text: str, at_s: float) -> None:
        """Replace the live line of a terminal, at most four times per simulated second."""
        if not self._live or at_s - self._last_live_s < 0.25:
            return
        self._last_live_s = at_s
        self.close()
        self._live_text = printable(text)[:shutil.get_terminal_size().columns - 1]
        self._stream.write(self._live_text)
        self._stream.flush()

    def close(self) -> None:
        """Remove the live line."""
        if self._live_text:
            self._stream.write("\r\x1b[K")
            self._live_text = ""

    def say(self, text: str) -> None:
        """Print a line."""
        self.close()
        self._stream.write(printable(text) + "\n")
        self._stream.flush()
