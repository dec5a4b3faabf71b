"""Fills the picture with the contents of messages, as pages show them. Pure.

It is cheap, because it runs for every message: a repeated state changes nothing, and nothing is
encoded while no page is open (`picture`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm.narrator import Line, Narrator
from rampart.actors.operator.picture import SHOWN, Bounds, Picture
from rampart.files.plain_text import one_line
from rampart.manager.strategies.registry import decision_in_words

STALE_S = 1.5
"""Simulated seconds without a message after which a state is shown as stale."""

_SYSTEM = Bounds(text=40_000, items=1000)
"""Bounds of the drawing of a system, with up to 300 boxes (`system`)."""

TRACE_POINTS = 240
"""Points of a number's past that a new page receives."""

LARGEST = 1e15
"""Greatest number that is drawn."""


class Heard(msgspec.Struct):
    """The latest message, as pages see it, and whether the next one is overdue.

    `t` is the stamp of the message, if a page needs it.
    """

    value: Any
    stale: bool = False
    t: float = 0.0


class Trace:
    """The recent past of a number: one value per interval.

    Args:
        kept_s: length of the past, simulated seconds.
    """

    def __init__(self, kept_s: float) -> None:
        self.points: deque[tuple[float, Any]] = deque(maxlen=TRACE_POINTS)
        self._step_s = kept_s / TRACE_POINTS

    def add(self, t_s: float, value: Any) -> None:
        """Add a value, unless the last one is too young; a value that is not finite is a gap."""
        if self.points and t_s < self.points[-1][0]:
            self.points.clear()  # another run
        if not math.isfinite(t_s) or (
                self.points and t_s - self.points[-1][0] < self._step_s):
            return
        number = isinstance(value, int | float) and abs(value) < LARGEST
        self.points.append((round(t_s, 3), float(f"{value:.6g}") if number else None))


class HmiState:
    """The operator's view of the system.

    Attributes:
        picture: contents of pages.
        narrator: describes events, with the titles of modules, mechanisms and recoveries.
    """

    def __init__(self) -> None:
        self.picture = picture = Picture()
        self._heard_s: dict[str, float] = {}
        self._aged: list[str] = []
        self._patience_s: dict[str, float] = {}
        self._traces: dict[str, Trace] = {}
        self.narrator = Narrator()
        self._outcomes = 0
        picture.section("system", bounds=_SYSTEM)
        picture.section("order", {"number": 0, "text": ""})
        self.aged("manager", "nodes")
        picture.section("usage", {})
        picture.section("behind", "")
        picture.section("history", [])
        picture.journal("decisions")
        picture.journal("events")

    def show_field(self, name: str, kept_s: float, silent_s: float) -> None:
        """Declare a field of a topic, "topic:field", that panels show.

        Args:
            name: of the field and of its section.
            kept_s: length of the past that pages show, s; 0 for none.
            silent_s: seconds without a message after which it is stale.
        """
        if kept_s:
            self._traces[name] = Trace(kept_s)
        self._patience_s[name] = silent_s
        self.aged(name)

    def field(self, name: str, value: Any, stamp_s: float, now_s: float) -> None:
        """Keep the value of a declared field, and its past if a panel shows it."""
        trace = self._traces.get(name)
        if trace is not None:
            trace.add(stamp_s, value)
        self.put(name, Heard(value, t=0.0 if trace is None else round(stamp_s, 3)), now_s)

    def past(self) -> dict[str, list[tuple[float, Any]]]:
        """Return the past of each plotted field: simulated seconds, and value."""
        return {name: list(trace.points) for name, trace in self._traces.items()}

    def aged(self, *names: str, show: Callable[[Heard | None], Any] = lambda heard: heard) -> None:
        """Declare sections that become stale without messages."""
        for name in names:
            self._aged.append(name)
            self.picture.section(name, show=show)

    # -- messages -------------------------------------------------------------------------------

    def keep(self, what: str, message: Any, now_s: float) -> None:
        """Keep the latest message for a section that becomes stale."""
        self.put(what, Heard(message), now_s)

    def put(self, what: str, heard: Heard, now_s: float) -> None:
        """Set a section that becomes stale."""
        self._heard_s[what] = now_s
        self.picture.put(what, heard)

    def manager(self, status: fm.ManagerStatus, now_s: float) -> None:
        """Keep the manager's status, and log changes of detections."""
        self.keep("manager", status, now_s)
        for view in status.detections[:SHOWN.items]:
            self._log_lines(self.narrator.detection(view.name, view.active, view.reason), now_s)

    def decision(self, record: fm.DecisionRecord, now_s: float) -> None:
        """Add a decision to the decision log."""
        r = record
        self.picture.add("decisions", {
            "t": round(now_s, 2), "number": r.decision, "active": r.active, "block": r.rule,
            "strategy": r.strategy, "recoveries": r.recoveries, "path": r.path,
            "words": decision_in_words(r.active, r.rule, r.recoveries, r.strategy,
                                       self.narrator.titles),
            "rule": f"{r.rule} of {r.strategy}",
            "rejected": [f"{name}: {why}" for name, why in r.rejected]})

    def event(self, message: fm.ProcessEvent | bm.Diagnostic, header: Header) -> None:
        """Log an event of a process, or an error report of a node."""
        self._log_lines(self.narrator.describe(message, header), header.stamp)

    def _log_lines(self, lines: Iterable[Line], now_s: float) -> None:
        for line in lines:
            self.log(now_s, line.level, line.text)

    def announce(self, text: str, now_s: float, about: str = "") -> None:
        """Log the result of an operator's request, and show it."""
        self._outcomes += 1
        self.picture.put("order", {"number": self._outcomes, "text": text})
        self.log(now_s, "note", f"{about}{text}")

    def log(self, now_s: float, kind: str, text: str) -> None:
        """Add a line to the event log; `kind` is fault, clear or note."""
        self.picture.add("events", {"t": round(now_s, 2), "kind": kind, "text": one_line(text)})

    # -- contents -------------------------------------------------------------------------------

    @property
    def latched(self) -> tuple[str, ...]:
        """Recoveries that wait for the operator's reset, by the manager's last status."""
        manager = self.picture.value("manager")
        return manager.value.latched if manager else ()

    def grow_old(self, now_s: float) -> None:
        """Mark sections without recent messages as stale."""
        for name in self._aged:
            heard = self.picture.value(name)
            if heard is None or heard.stale or now_s - self._heard_s[name] <= (
                    self._patience_s.get(name, STALE_S)):
                continue
            self.picture.put(name, msgspec.structs.replace(heard, stale=True))
