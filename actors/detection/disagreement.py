"""`Disagreement` and `Vote`: values that should be equal are not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, NamedTuple

import msgspec

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import FieldName, FieldNames, Suspects
from rampart.manager.spec.tables import NonNegative, Positive


class Sample(NamedTuple):
    """A value, and when it was true, simulated seconds."""

    value: Any
    stamp_s: float


_NOTHING = Sample(None, -math.inf)


def apart(one: Any, other: Any, *, angle: bool) -> float:
    """Return the distance of two values.

    Args:
        one: A number, text or truth value.
        other: A value of the same kind.
        angle: Whether they are angles, rad.

    Returns:
        The distance; of texts and truth values 0 if they are equal, else infinity.
    """
    if isinstance(one, str | bool) or isinstance(other, str | bool):
        return 0.0 if one == other else math.inf
    if not (math.isfinite(one) and math.isfinite(other)):
        return math.inf
    difference = float(one) - float(other)
    return abs(math.remainder(difference, math.tau) if angle else difference)


def agreeing(values: Sequence[Any], within: float, *, angle: bool) -> list[int]:
    """Return the indices of the largest group of values within a distance of one of them."""
    clusters = ([i for i, other in enumerate(values)
                 if other is not None and apart(one, other, angle=angle) <= within]
                for one in values if one is not None)
    return max(clusters, key=len, default=[])


class _Comparing(DetectionModule):
    """Compares values of several fields at about the same time."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Way of comparison.

        Attributes:
            angle: whether they are angles, rad.
            stale_s: greatest age of a value that takes part, s.
            for_s: how long they have to disagree, s.
            clear_s: how long they have to agree before the module is idle again, s.
            suspects: nodes to be respawned while it is active; none by default.
        """

        angle: bool = False
        stale_s: Positive = 1.0
        for_s: NonNegative = 0.2
        clear_s: NonNegative = 0.5
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self.monitor = self.judged_by(Sustained(
            chosen.for_s, chosen.clear_s, self.known_after_s(chosen.stale_s + chosen.clear_s)))
        self._waits_until_s = self.clock.now() + self.grace_s(chosen.stale_s)
        fields = self.compared()
        self._samples = [_NOTHING] * len(fields)
        for i, name in enumerate(fields):
            self.hear_field(name, partial(self._take, i))

    def _take(self, place: int, value: Any, header: Header) -> None:
        self._samples[place] = Sample(value, header.stamp)
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        now_s = self.clock.now()
        oldest_s = now_s - self.parameters.stale_s
        if _NOTHING in self._samples and now_s < self._waits_until_s:
            return
        why = self.compare([s.value if s.stamp_s >= oldest_s else None for s in self._samples])
        if why is None:
            self.monitor.doubt()
        else:
            self.monitor.note(why, self.clock.now())
        self.follow()

    def compared(self) -> Sequence[str]:
        """Return the fields to compare."""
        raise NotImplementedError

    def compare(self, values: Sequence[Any]) -> str | None:
        """Return the error, "" for none, None if the values do not show it.

        Args:
            values: In the order of the fields; None for an unknown one.
        """
        raise NotImplementedError


class Disagreement(_Comparing):
    """Active while the distance of two fields is too large."""

    class Parameters(_Comparing.Parameters, frozen=True, kw_only=True):
        """Two fields and their greatest distance.

        Attributes:
            one: first field, as "topic:field".
            other: second field.
            more_than: greatest permitted distance.
        """

        one: FieldName
        other: FieldName
        more_than: NonNegative = 0.0

    parameters: Parameters

    def compared(self) -> Sequence[str]:
        """Return the two fields."""
        return self.parameters.one, self.parameters.other

    def compare(self, values: Sequence[Any]) -> str | None:
        """Compare the two values."""
        one, other = values
        chosen = self.parameters
        if one is None or other is None:
            return None
        if apart(one, other, angle=chosen.angle) <= chosen.more_than:
            return ""
        return f"{chosen.one} is {_shown(one)}, {chosen.other} is {_shown(other)}"


class Vote(_Comparing):
    """Active while fewer than `agree` of several fields agree."""

    class Parameters(_Comparing.Parameters, frozen=True, kw_only=True):
        """Fields, and how many of them have to agree.

        Attributes:
            values: the fields, each as "topic:field".
            agree: how many have to agree.
            within: greatest distance of values that agree.
        """

        values: FieldNames
        agree: Annotated[int, msgspec.Meta(ge=2)]
        within: NonNegative = 0.0

        def __post_init__(self) -> None:
            """Refuse a majority of more values than there are."""
            if self.agree > len(self.values):
                raise ValueError(f"agree: there are only {len(self.values)} values")

    parameters: Parameters

    def compared(self) -> Sequence[str]:
        """Return all fields."""
        return self.parameters.values

    def compare(self, values: Sequence[Any]) -> str | None:
        """Find the largest group of known values that agree."""
        chosen = self.parameters
        alike = agreeing(values, chosen.within, angle=chosen.angle)
        if len(alike) >= chosen.agree:
            return ""
        others = ", ".join(f"{name} is {_shown(values[i])}"
                           for i, name in enumerate(chosen.values) if i not in alike)
        return f"{len(alike)} of {len(values)} agree, expected {chosen.agree}: {others}"


def _shown(value: Any) -> str:
    if value is None:
        return "unknown"
    return f"{value:g}" if isinstance(value, float) else str(value)
