"""Panels of the operator's page: tables `[[panel]]` of a specification, or of a page's class. Pure.

The browser draws them: `rampart/actors/operator/page/widgets.js`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Annotated, Any, NamedTuple

import msgspec

from rampart.actors.bus.fields import ANYTHING, NUMBER, TEXT, TRUTH, Field, StickMessages
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.runtime.actor import BASE_OUTPUTS
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import read_rows
from rampart.manager.spec.tables import SpecificationError, Table

MAX_PANELS = 40
MAX_PLOTS = 8
"""Most generated plots of a page without panels."""
LARGEST = 1e9
"""Greatest number of a stick."""
MAX_KEPT = 32
"""Most fields of all plots and maps: some minutes of each are kept for new pages."""

FieldText = Annotated[str, msgspec.Meta(
    pattern=r"^[^:]+:[^:]+\Z", max_length=200,
    description="'topic:field', e.g. 'tank/level:height_m'")]
"""A field of the messages of a topic, "topic:field"."""
_Short = Annotated[str, msgspec.Meta(max_length=60)]

_SHOWS: dict[str, tuple[tuple[str, ...], frozenset[str]]] = {
    "gauge": ((NUMBER,), frozenset({"min", "max", "unit"})),
    "plot": ((NUMBER, TRUTH), frozenset({"min", "max", "unit", "seconds"})),
    "table": (ANYTHING, frozenset()),
    "states": ((TEXT, TRUTH), frozenset({"of"})),
    "text": (ANYTHING, frozenset({"unit"})),
    "map": ((NUMBER,), frozenset({"extent_m"})),
    "stick": ((NUMBER,), frozenset({"held", "scale"})),
    "script": ((), frozenset()),
}
"""Kind of panel → kinds of fields that it takes, and its options."""
_OPTIONS = sorted(frozenset().union(*(options for _, options in _SHOWS.values())))


class Shown(NamedTuple):
    """A field of a panel: the key that names it, and the kinds it may have.

    `is_published`: the page publishes the field; it subscribes to others.
    """

    key: str
    field: str
    kinds: tuple[str, ...]
    is_published: bool = False


class Panel(Table, frozen=True, kw_only=True, omit_defaults=True):
    """A panel of the operator's page; it shows one thing.

    Attributes:
        title: Above it, and its name; no two panels of a page have the same.
        gauge: A number between `min` and `max`.
        plot: Numbers over the last `seconds`, simulated; truth values are drawn as 0 and 1.
        table: Fields, each with its latest value.
        states: A text, as one of the states in `of`.
        text: The latest value of a field.
        map: x and y, m, and if there is a third one the heading, rad, counted from x to y.
        stick: One or two numbers of the messages of a topic, which the page publishes while an
            operator holds the stick: how far it is forward, and how far to the left.
        script: A JavaScript module that draws it, of the files of the page's class.
        min: Lower end of a gauge (0 if left out) or of a plot (its least value).
        max: Upper end of a gauge (1 if left out) or of a plot (its greatest value).
        unit: Behind the number.
        seconds: How much of the past a plot shows.
        of: States that are shown in this order; a state that is not listed is shown beside them.
        extent_m: x and y of the lower left and of the upper right corner of a map; what it has to
            hold if left out.
        held: A truth value of a stick's messages: whether an operator holds it.
        scale: What the numbers of a stick are when it is at its end; the bounds of their types if
            left out, 1 where these have none. A negative one reverses the direction.
        columns: How wide it is; as much as suits it if left out.
    """

    title: Annotated[str, msgspec.Meta(min_length=1, max_length=60)]
    gauge: FieldText | None = None
    plot: Annotated[tuple[FieldText, ...], msgspec.Meta(min_length=1, max_length=8)] | None = None
    table: Annotated[tuple[FieldText, ...], msgspec.Meta(min_length=1, max_length=40)] | None = None
    states: FieldText | None = None
    text: FieldText | None = None
    map: Annotated[tuple[FieldText, ...], msgspec.Meta(min_length=2, max_length=3)] | None = None
    stick: Annotated[tuple[FieldText, ...], msgspec.Meta(min_length=1, max_length=2)] | None = None
    script: Annotated[str, msgspec.Meta(pattern=r"^[a-z_]+\.js\Z")] | None = None
    min: float | None = None
    max: float | None = None
    unit: Annotated[str, msgspec.Meta(max_length=12)] = ""
    seconds: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 60.0
    of: Annotated[tuple[_Short, ...], msgspec.Meta(max_length=40)] = ()
    extent_m: tuple[float, float, float, float] | None = None
    held: FieldText | None = None
    scale: Annotated[tuple[float, ...], msgspec.Meta(max_length=2)] = ()
    columns: Annotated[int, msgspec.Meta(ge=0, le=6)] = 0

    def __post_init__(self) -> None:
        """Refuse a panel that shows nothing or several things, and options that do not apply."""
        shown = [key for key in _SHOWS if getattr(self, key) is not None]
        if len(shown) != 1:
            raise ValueError(f"{self.title!r} has {' and '.join(shown) or 'nothing to show'}; "
                             f"expected one of {', '.join(_SHOWS)}")
        _, options = _SHOWS[self.kind]
        defaults = dict(zip(self.__struct_fields__[-len(self.__struct_defaults__):],
                            self.__struct_defaults__, strict=True))
        for name in _OPTIONS:
            if name not in options and getattr(self, name) != defaults[name]:
                raise ValueError(f"{self.title!r}: {name} does not apply to a {self.kind}; "
                                 f"it takes {', '.join(sorted(options)) or 'no options'}")
        low, high = self._ends()
        if low is not None and high is not None and not low < high:
            raise ValueError(f"{self.title!r}: min = {low:g} is not below max = {high:g}")
        box = self.extent_m
        if box is not None and not (box[0] < box[2] and box[1] < box[3]):
            raise ValueError(f"{self.title!r}: extent_m: expected x0, y0, x1, y1 with x0 < x1 and "
                             "y0 < y1")
        if self.stick is not None:
            self._check_stick(self.stick)

    def _check_stick(self, numbers: tuple[FieldText, ...]) -> None:
        fields = (*numbers, *((self.held,) if self.held else ()))
        keys = dict.fromkeys(field.partition(":")[0] for field in fields)
        if len(keys) > 1:
            raise ValueError(f"{self.title!r}: stick: fields of {' and '.join(keys)}; expected "
                             "fields of one topic")
        if len({*fields}) < len(fields):
            raise ValueError(f"{self.title!r}: stick: {', '.join(fields)}: expected each "
                             "field once")
        if self.scale and len(self.scale) != len(numbers):
            raise ValueError(f"{self.title!r}: scale = {[*self.scale]}: expected one number for "
                             f"each of {', '.join(numbers)}")
        if not all(1e-9 <= abs(scale) <= LARGEST for scale in self.scale):
            raise ValueError(f"{self.title!r}: scale = {[*self.scale]}: expected numbers other "
                             f"than 0, at most {LARGEST:g}")

    @property
    def topic(self) -> str:
        """Key of the topic of its stick, "" if it is not a stick."""
        return self.stick[0].partition(":")[0] if self.stick else ""

    @property
    def kind(self) -> str:
        """Kind of the panel."""
        return next(key for key in _SHOWS if getattr(self, key) is not None)

    @property
    def kept_s(self) -> float:
        """Seconds of the past that it shows; 0 for only the present."""
        return self.seconds if self.plot else 600.0 if self.map else 0.0

    def fields(self) -> Iterator[Shown]:
        """Yield the fields that it shows or publishes."""
        kinds, _ = _SHOWS[self.kind]
        value = getattr(self, self.kind)
        if kinds:
            for field in (value,) if isinstance(value, str) else value:
                yield Shown(self.kind, field, kinds, bool(self.stick))
        if self.held:
            yield Shown("held", self.held, (TRUTH,), True)

    def _ends(self) -> tuple[float | None, float | None]:
        if self.gauge is None:
            return self.min, self.max
        return (0.0 if self.min is None else self.min, 1.0 if self.max is None else self.max)


def read_panels(spec: SystemSpec, file: str) -> tuple[Panel, ...]:
    """Return the panels of a specification.

    Raises:
        SpecificationError: a panel is not valid, or panels contradict each other.
    """
    panels = read_rows(spec.panels, Panel, "panel", file)
    for place, panel in enumerate(panels):
        if panel.script is not None:
            raise SpecificationError(
                file, f"$.panel[{place}].script", f"{panel.title!r}: only the class of a page has "
                "scripts; expected a field of a topic, e.g. gauge", panel.script)
    if problem := problem_of(panels):
        raise SpecificationError(file, "$.panel", problem)
    return panels


def plots_of(topics: Iterable[Topic[Any]]) -> tuple[Panel, ...]:
    """Return a plot of each periodic topic with numbers, at most `MAX_PLOTS`."""
    engine = {topic.key for topic in (*ftm_topics.ALL, *BASE_OUTPUTS)}
    plots = (Panel(title=f"{topic.key} {unit}"[:60].strip(), plot=tuple(fields[:4]))
             for topic in topics
             if topic.key not in engine and not topic.is_family and topic.rate_hz > 0
             for unit, fields in _numbers(topic).items())
    return tuple(islice({plot.title: plot for plot in plots}.values(), MAX_PLOTS))


def _numbers(topic: Topic[Any]) -> dict[str, list[str]]:
    """Return the numbers of a topic's messages by their unit, the last word of their names."""
    found: dict[str, list[str]] = {}
    for path in getattr(topic.type, "__struct_fields__", ()):
        if _kind(topic, path) == NUMBER:
            unit = path.rpartition("_")[2] if "_" in path else ""
            found.setdefault(unit, []).append(f"{topic.key}:{path}")
    return found


def _kind(topic: Topic[Any], path: str) -> str:
    try:
        return Field(topic.type, path).kind
    except ValueError:
        return ""  # a list or struct


def steered(panel: Panel, topic: Topic[Any]) -> StickMessages:
    """Return the builder of messages of a panel's stick.

    Raises:
        ValueError: a field does not fit.
    """
    names = [shown.field.partition(":")[2] for shown in panel.fields()]
    count = len(panel.stick or ())
    return StickMessages(topic.type, names[:count], "".join(names[count:]), panel.scale)


def problem_of(panels: Sequence[Panel]) -> str:
    """Return why panels do not go together on a page, "" if they do."""
    titles = [panel.title for panel in panels]
    twice = next((title for title in titles if titles.count(title) > 1), None)
    if twice is not None:
        return f"panel {twice!r}: two panels have this title; expected different titles"
    steered_topics = [panel.topic for panel in panels if panel.stick]
    rival = next((panel for panel in panels if steered_topics.count(panel.topic) > 1), None)
    if rival is not None:
        return f"panel {rival.title!r}: another stick publishes {rival.topic} too; expected one"
    if len(panels) > MAX_PANELS:
        return f"{len(panels)} panels; expected at most {MAX_PANELS}"
    kept = sum(1 for panel in panels if panel.kept_s for _ in panel.fields())
    if kept > MAX_KEPT:
        return f"panels: {kept} fields in plots and maps; expected at most {MAX_KEPT} together"
    return ""
