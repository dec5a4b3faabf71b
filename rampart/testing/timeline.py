"""Timelines for detection monitors: one character per 100 ms in, one out.

An event happens at the beginning of its slot. The monitor is woken exactly when it is due. Its
state is read in the middle of the slot: `-` idle, `A` active, `?` not known yet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rampart.actors.detection.module import Monitor
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.runtime.actor import Actor, Context, Header, on

SLOT_S = 0.1
NOTHING = "."


def play(monitor: Monitor, handle: Callable[[str, float], None], events: Iterable[str],
         start_s: float = 0.0) -> str:
    """Play events to a monitor and return its states, slot by slot.

    Args:
        monitor: The monitor, which is woken when it is due.
        handle: Called with each event but `.` and its time, simulated seconds.
        events: One character per slot of 100 ms; `.` is no event.
        start_s: Beginning of the first slot, simulated seconds.

    Raises:
        AssertionError: The monitor is active without a reason, has one while idle, or is due again
            at the time at which it was woken.
    """
    found = []
    for slot, event in enumerate(events):
        begin_s = round(start_s + slot * SLOT_S, 9)
        wake(monitor, begin_s - 1e-9)
        if event != NOTHING:
            handle(event, begin_s)
        wake(monitor, begin_s + SLOT_S / 2)
        found.append("A" if monitor.active else "-" if monitor.known else "?")
        if bool(monitor.reason) != monitor.active:
            raise AssertionError(f"active: {monitor.active}, and its reason: {monitor.reason!r}")
    return "".join(found)


def wake(monitor: Monitor, until_s: float) -> None:
    """Wake a monitor whenever it is due, until a simulated time.

    Raises:
        AssertionError: Woken at its due time, it is due at the same time again.
    """
    while (due_s := monitor.due_s) <= until_s:
        monitor.expire(due_s)
        if monitor.due_s <= due_s:
            raise AssertionError(f"woken at its due time, {due_s} s, it is due again at "
                                 f"{monitor.due_s} s")


def table(cases: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Return arguments for `pytest.mark.parametrize` from sentences to cases."""
    return {"argvalues": list(cases.values()), "ids": list(cases)}


class Ear(Actor):
    """Keeps all detection reports with the time of their arrival, simulated seconds."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.heard: list[tuple[float, m.DetectionReport]] = []

    @on(ftm_topics.DETECTION)
    def detection(self, message: m.DetectionReport, _header: Header) -> None:
        """Keep a report."""
        self.heard.append((self.clock.now(), message))

    @property
    def states(self) -> list[str]:
        """States in sequence, repetitions left out."""
        states = [report.state.value for _, report in self.heard]
        return [s for i, s in enumerate(states) if i == 0 or states[i - 1] != s]
