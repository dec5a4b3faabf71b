"""Events of a run in one line each: the same words for console, report, page and viewers. Pure.

A repeated report or event adds no line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.ftm import messages as fm
from rampart.manager.strategies.registry import decision_in_words, listing, named

MOST = 500
"""Most modules, nodes and injections that are remembered."""

Level = Literal["fault", "clear", "note"]


class Line(msgspec.Struct, frozen=True):
    """One line; the level is *clear* when a fault is over."""

    level: Level
    text: str


class Narrator:
    """Describes the messages of one run; `titles` are those of `SystemSpec.titles`."""

    def __init__(self, titles: Mapping[str, str] = MappingProxyType({})) -> None:
        self.titles = titles
        self._last: dict[tuple[str, ...], Any] = Remembered(MOST)
        self._injections: dict[str, str] = Remembered(MOST)
        self._silent: tuple[str, ...] = ()
        self._describe: dict[type, Callable[[Any, Header], list[Line]]] = {
            fm.ProcessEvent: self._process, fm.DetectionReport: self._detection,
            fm.ManagerStatus: self._silence, fm.DecisionRecord: self._decision,
            fm.ShadowRecord: self._shadow, bm.Diagnostic: self._diagnostic,
            bm.Injection: self._ordered, bm.InjectionReport: self._injection}

    def describe(self, message: Any, header: Header) -> list[Line]:
        """Return the lines for a message; none if it is not new."""
        describe = self._describe.get(type(message))
        return describe(message, header) if describe else []

    def detection(self, name: str, active: bool, reason: str) -> list[Line]:
        """Return the line for a detection module that has become active or idle."""
        if not self._is_new(("detection", name), active, at_first=False):
            return []
        what = named(name, self.titles)
        return [Line("fault", f"{what}: {reason}") if active else Line("clear", f"{what}: clear")]

    def _process(self, event: fm.ProcessEvent, _header: Header) -> list[Line]:
        if not event.news or event.event == "adopted":
            return []
        by = f" by {event.by}" if event.by and event.event == "respawned" else ""
        detail = f": {event.detail}" if event.detail else ""
        which = f", incarnation {event.incarnation}" if event.incarnation else ""
        return [Line("clear" if event.news == "clear" else "fault",
                     f"{event.node} {event.event}{by}{which}{detail}")]

    def _detection(self, report: fm.DetectionReport, header: Header) -> list[Line]:
        return self.detection(
            header.source, report.state is fm.DetectionState.ACTIVE, report.reason)

    def _silence(self, status: fm.ManagerStatus, _header: Header) -> list[Line]:
        before, self._silent = self._silent, (silent := status.silent)
        return [*(Line("fault", f"{named(name, self.titles)} silent: it counts as active")
                  for name in silent if name not in before),
                *(Line("clear", f"{named(name, self.titles)}: no longer silent")
                  for name in before if name not in silent)]

    def _decision(self, record: fm.DecisionRecord, header: Header) -> list[Line]:
        if not self._is_new(("decision",), (header.incarnation, record.decision)):
            return []
        words = decision_in_words(record.active, record.rule, record.recoveries, record.strategy,
                                  self.titles)
        return [Line("fault" if record.active else "clear", f"decision {record.decision}: {words}")]

    def _shadow(self, record: fm.ShadowRecord, _header: Header) -> list[Line]:
        taken = listing([named(name, self.titles) for name in record.recoveries])
        return [Line("note", f"in shadow {record.strategy} would run {taken}")]

    def _diagnostic(self, report: bm.Diagnostic, _header: Header) -> list[Line]:
        times = f" ({report.count} times)" if report.count > 1 else ""
        return [Line("note", f"{report.node}: {report.context}: {report.reason} "
                             f"[{report.offender}]{times}")]

    def _ordered(self, order: bm.Injection, _header: Header) -> list[Line]:
        self._injections[order.injection] = f"{order.mode} {order.topic}"
        return []

    def _injection(self, report: bm.InjectionReport, _header: Header) -> list[Line]:
        if not self._is_new(("injection", report.injection, report.node),
                            report.finished):
            return []
        where = f"{self._injections.get(report.injection, report.injection)} at {report.node}"
        why = f": {report.reason}" if report.reason else ""
        if report.finished:
            return [Line("clear", f"injection over: {where}, {report.affected} messages changed"
                                  f"{why}")]
        return [Line("fault", f"fault injected: {where}{why}")]

    def _is_new(self, what: tuple[str, ...], value: Any, at_first: Any = None) -> bool:
        if self._last.get(what, at_first) == value:
            return False
        self._last[what] = value
        return True
