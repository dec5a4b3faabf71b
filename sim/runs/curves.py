"""Curves of a robot's numbers over a run, for its report. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import msgspec

from rampart.actors.bus.fields import Field
from rampart.actors.bus.topic import Topic
from rampart.actors.operator.panels import plots_of
from rampart.actors.runtime.actor import Header

MOST = 600
"""Most points of a curve; beyond, every second one is dropped."""


class Curve(msgspec.Struct, frozen=True):
    """One number over a run: times in simulated seconds, and values."""

    plot: str
    field: str
    points: tuple[tuple[float, float], ...]


class CurveRecorder:
    """Records the numbers that a page without panels plots.

    Args:
        topics: Topics of the robot.

    Attributes:
        topics: The topics that it needs, by key.
    """

    def __init__(self, topics: Iterable[Topic[Any]]) -> None:
        known = {topic.key: topic for topic in topics}
        self.topics: dict[str, Topic[Any]] = {}
        self._fields: dict[str, list[tuple[Field, list[tuple[float, float]]]]] = {}
        self._curves: list[tuple[str, str, list[tuple[float, float]]]] = []
        for panel in plots_of(known.values()):
            for shown in panel.fields():
                key, _, path = shown.field.partition(":")
                points: list[tuple[float, float]] = []
                self.topics[key] = known[key]
                self._fields.setdefault(key, []).append((Field(known[key].type, path), points))
                self._curves.append((panel.title, path, points))

    def take(self, topic: Topic[Any], message: Any, header: Header) -> None:
        """Take a message of the run."""
        for field, points in self._fields.get(topic.key, ()):
            value = field(message)
            at_s = header.stamp
            if not math.isfinite(value) or (
                    points and at_s - points[-1][0] <= (at_s - points[0][0]) / MOST):
                continue
            points.append((round(at_s, 3), float(value)))
            if len(points) > MOST:
                del points[1::2]

    def curves(self) -> tuple[Curve, ...]:
        """Return the curves in the order of the plots."""
        return tuple(Curve(plot, field, tuple(points)) for plot, field, points in self._curves
                     if points)
