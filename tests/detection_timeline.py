"""Timelines for detection monitors: one character per 100 ms in, one out.

An event happens at the beginning of its slot, the monitor is woken exactly when it is due, and
what it finds is read in the middle of the slot: `-` idle, `A` active, `?` not known yet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rampart.actors.detection.module import Monitor
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, Context, Header, on

SLOT_S = 0.1
Handler = Callable[[str, float], None]


def play(monitor: Monitor, handle: Handler, events: Iterable[str], start_s: float = 0.0) -> str:
    found = []
    for slot, event in enumerate(events):
        begin_s = round(start_s + slot * SLOT_S, 9)
        wake(monitor, begin_s - 1e-9)
        if event != ".":
            handle(event, begin_s)
        wake(monitor, begin_s + SLOT_S / 2)
        found.append("A" if monitor.active else "-" if monitor.known else "?")
        assert bool(monitor.reason) == monitor.active
    return "".join(found)


def wake(monitor: Monitor, until_s: float) -> None:
    while monitor.due_s <= until_s:
        due_s = monitor.due_s
        monitor.expire(due_s)
        assert monitor.due_s > due_s, "woken at its due time, it is due at the same time again"


def table(cases: dict[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Arguments for `pytest.mark.parametrize` from sentences to cases."""
    return {"argvalues": list(cases.values()), "ids": list(cases)}


class Source(Actor):
    """Publishes commands and poses when told."""

    outputs = (topics.COMMAND, topics.POSE)


class Ear(Actor):
    """Keeps all detection reports with the time of their arrival."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.heard: list[tuple[float, m.DetectionReport]] = []

    @on(ftm_topics.DETECTION)
    def detection(self, message: m.DetectionReport, _header: Header) -> None:
        self.heard.append((self.clock.now(), message))

    @property
    def states(self) -> list[str]:
        """States in sequence, repetitions left out."""
        states = [report.state.value for _, report in self.heard]
        return [s for i, s in enumerate(states) if i == 0 or states[i - 1] != s]
