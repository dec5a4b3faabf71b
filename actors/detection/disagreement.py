"""`Disagreement` and `Vote`: values that should be alike and are not."""

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
    """A value, and when it was true (simulated seconds)."""

    value: Any
    stamp_s: float


_NOTHING = Sample(None, -math.inf)


def apart(one: Any, other: Any, *, angle: bool) -> float:
    """Return how far two values are from each other.

    Args:
        one: a number, a text or a truth value.
        other: of the same kind.
        angle: whether they are angles, rad, of which the shorter way counts.

    Returns:
        The distance; of a text or a truth value 0 if they are equal, else infinity.
    """
    if isinstance(one, str | bool) or isinstance(other, str | bool):
        return 0.0 if one == other else math.inf
    if not (math.isfinite(one) and math.isfinite(other)):
        return math.inf
    difference = float(one) - float(other)
    return abs(math.remainder(difference, math.tau) if angle else difference)


def agreeing(values: Sequence[Any], within: float, *, angle: bool) -> list[int]:
    """Return the places of the most values that lie within a distance of one of them."""
    clusters = ([i for i, other in enumerate(values)
                 if other is not None and apart(one, other, angle=angle) <= within]
                for one in values if one is not None)
    return max(clusters, key=len, default=[])


class _Comparing(DetectionModule):
    """Receives several fields, and compares values of about the same time."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """How they are compared.

        Attributes:
            angle: whether they are angles, rad.
            stale_s: what is older than this does not take part, s.
            for_s: how long it has to be wrong, s.
            clear_s: how long it has to be well before the module is idle again, s.
            suspects: names of nodes to be respawned when it is active; none by default.
        """

        angle: bool = False
        stale_s: Positive = 1.0
        for_s: NonNegative = 0.2
        clear_s: NonNegative = 0.5
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.monitor = self.judged_by(Sustained(
            said.for_s, said.clear_s, self.known_after_s(said.stale_s + said.clear_s)))
        self._waits_until_s = self.clock.now() + self.grace_s(said.stale_s)
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
        """Return the fields that are compared."""
        raise NotImplementedError

    def compare(self, values: Sequence[Any]) -> str | None:
        """Return what is wrong, "" if nothing is, None if that cannot be said.

        Args:
            values: in the order of the fields; None for one that is not known.
        """
        raise NotImplementedError


class Disagreement(_Comparing):
    """Active while two fields are further apart than they may be."""

    class Parameters(_Comparing.Parameters, frozen=True, kw_only=True):
        """Which fields, and how far they may be apart.

        Attributes:
            one: the one, as "topic:field".
            other: the other.
            more_than: greatest distance that is in order.
        """

        one: FieldName
        other: FieldName
        more_than: NonNegative = 0.0

    parameters: Parameters

    def compared(self) -> Sequence[str]:
        """Return the two fields."""
        return self.parameters.one, self.parameters.other

    def compare(self, values: Sequence[Any]) -> str | None:
        """Compare the two."""
        one, other = values
        said = self.parameters
        if one is None or other is None:
            return None
        if apart(one, other, angle=said.angle) <= said.more_than:
            return ""
        return f"{said.one} is {_shown(one)}, {said.other} is {_shown(other)}"


class Vote(_Comparing):
    """Active while fewer than `agree` of several fields are alike."""

    class Parameters(_Comparing.Parameters, frozen=True, kw_only=True):
        """Which fields, and how many of them have to be alike.

        Attributes:
            values: as "topic:field" each.
            agree: how many.
            within: greatest distance of those that are alike.
        """

        values: FieldNames
        agree: Annotated[int, msgspec.Meta(ge=2)]
        within: NonNegative = 0.0

        def __post_init__(self) -> None:
            """Refuse a majority of more than there are."""
            if self.agree > len(self.values):
                raise ValueError(f"agree: there are {len(self.values)} values only")

    parameters: Parameters

    def compared(self) -> Sequence[str]:
        """Return all fields."""
        return self.parameters.values

    def compare(self, values: Sequence[Any]) -> str | None:
        """Count the largest number that are alike; one that is not known is not."""
        said = self.parameters
        alike = agreeing(values, said.within, angle=said.angle)
        if len(alike) >= said.agree:
            return ""
        others = ", ".join(f"{name} is {_shown(values[i])}"
                           for i, name in enumerate(said.values) if i not in alike)
        return f"{len(alike)} of {len(values)} agree, {said.agree} have to: {others}"


def _shown(value: Any) -> str:
    if value is None:
        return "not known"
    return f"{value:g}" if isinstance(value, float) else str(value)
