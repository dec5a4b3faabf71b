"""Faults on topics: named disturbances, and every topic in every mode, as `MODE:TOPIC`.

A disturbance acts in the process that publishes its topic (`rampart.actors.runtime.injection`), so
the rest of the system receives what it would receive after a real failure of that node.

`corrupt:TOPIC` adds a constant offset to every number in a message, also in nested structs,
sequences and arrays. Each offset is drawn once per fault, from a range that is plausible for its
field, so the message stays possible. Truth values, words and texts stay. So does `pid`: the
supervisor kills by it, and a wrong one may be another process. The range comes from the range of
the field (`Annotated[float, Meta(ge=0, le=1)]`), its unit (`Meta(extra={"unit": "m"})`), or the
unit at the end of its name; a robot's own table (`Faults.sizes`) counts first.

`restamp:TOPIC` is a clock with a constant error, ahead or behind, drawn as well.

A *nonsense reading* (`NONSENSE`) is impossible for a sound device: zeros, negative or huge numbers,
arrays of another length. Topics of sensors and devices have them: `nan:TOPIC`.

Topics below `world/` are left out, since the judge uses them and a fault there would falsify the
verdict. Topics that carry injections are left out, too.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from random import Random
from typing import Any, NamedTuple

import msgspec

from rampart.actors.bus.bounds import narrow_range
from rampart.actors.bus.messages import Injection
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.runtime.corruption import InjectionError, check_fields, field_types, is_array
from rampart.actors.runtime.injection import MODES, UNTOUCHED
from rampart.actors.system.topics import find_topic


class UnknownFaultError(ValueError):
    """Unknown name of a fault; the message is one line, with a hint to the known ones."""


class Disturbance(msgspec.Struct, frozen=True):
    """Disturbance of one topic; the fields are those of `Injection`."""

    topic: str
    mode: str
    delay_s: float = 0.0
    set_fields: Mapping[str, Any] = {}
    ramp_fields: Mapping[str, float] = {}
    keep_ends: tuple[str, ...] = ()
    add_fields: Mapping[str, float] = {}
    noise_fields: Mapping[str, float] = {}
    share: float = 1.0
    on_s: float = 0.0
    off_s: float = 0.0
    seed: int = 0
    stamp_s: float = 0.0

    def order(self, injection: str, duration_s: float) -> Injection:
        """Return the message that orders it, with an id and a duration in simulated seconds."""
        return Injection(injection, duration_s=duration_s, **msgspec.structs.asdict(self))


class Fault(msgspec.Struct, frozen=True):
    """A named fault.

    Args:
        name: As typed by the user.
        title: One line for people.
        disturbances: Its effects.
        detected_by: Detection modules that should detect it; empty if none should.
        duration_s: Default duration, simulated seconds; infinity for permanent.
        group: Its part of the catalogue.
    """

    name: str
    title: str
    disturbances: tuple[Disturbance, ...]
    detected_by: tuple[str, ...]
    duration_s: float
    group: str = ""

    def orders(self, injection: str, duration_s: float | None = None) -> tuple[Injection, ...]:
        """Return the injections that make up the fault.

        Args:
            injection: Id; several disturbances get "ID.1", "ID.2" and so on.
            duration_s: Simulated seconds, infinity for permanent; None for the default.
        """
        lasts_s = self.duration_s if duration_s is None else duration_s
        several = len(self.disturbances) > 1
        return tuple(d.order(f"{injection}.{i}" if several else injection, lasts_s)
                     for i, d in enumerate(self.disturbances, start=1))

    def varied(self, *, share: float | None = None, on_s: float | None = None,
               off_s: float | None = None, seed: int | None = None) -> Fault:
        """Return the fault for a share of the messages, intermittent, or with another seed.

        Args:
            share: Probability that a message is affected.
            on_s: How long an intermittent fault is in force, simulated seconds.
            off_s: How long it is absent in between, simulated seconds.
            seed: Of the first disturbance; the others get the next ones. None keeps the seeds.
        """
        given = {"share": share, "on_s": on_s, "off_s": off_s}
        changed = {name: value for name, value in given.items() if value is not None}
        return msgspec.structs.replace(self, disturbances=tuple(
            msgspec.structs.replace(d, **changed, seed=d.seed if seed is None else seed + i)
            for i, d in enumerate(self.disturbances)))


GROUP, READING = "topic", "reading"
DURATION_S = 10.0

DELAY_S = 1.5
"""Delay of `delay:TOPIC`: half longer than the longest freshness timeout of the shipped system
(0.99 s), so it should be detected."""

STAMPS_S = (0.02, 5.0)
"""Least and greatest error of a stamp, from a harmless one to one beyond every freshness timeout.
Drawn by its logarithm, so small errors are as frequent as large ones."""

_TITLES = {
    "drop": "nothing on {} arrives",
    "freeze": "{} repeats its last message, old stamp included",
    "stuck": "{} repeats its last content with fresh stamps",
    "delay": "{} arrives " + f"{DELAY_S:g} s late",
    "duplicate": "each message on {} is sent twice",
    "restamp": "the stamps on {} are wrong by a constant",
    "corrupt": "each number on {} is wrong by a constant"}

_NUMBERS = {"zero": 0, "negative": -1, "huge": 10**6, "infinite": math.inf, "nan": math.nan}
_ARRAYS = {"tiny": 0.01, "single": struct.pack("<f", 0.0), "short": None}
NONSENSE = (*_NUMBERS, *_ARRAYS)
"""Readings that are impossible for a sound device. The last three are for arrays: smaller than any
range, a single element, only the first and the last element."""

OF_RANGE = (0.05, 0.3)
"""Least and greatest error as a share of the field's range."""

UNITS: dict[str, tuple[float, float]] = {
    "m": (0.5, 3.0), "cm": (5.0, 50.0), "mm": (5.0, 50.0), "rad": (0.3, 1.5), "deg": (15.0, 90.0),
    "mps": (0.2, 0.8), "mps2": (0.5, 2.0), "radps": (0.2, 1.0), "s": (1.0, 10.0),
    "ms": (100.0, 2000.0), "hz": (1.0, 20.0), "kg": (0.5, 5.0), "n": (5.0, 50.0),
    "nm": (1.0, 10.0), "pa": (1e3, 2e4), "bar": (0.2, 1.0), "k": (5.0, 40.0),
    "degc": (5.0, 40.0), "v": (1.0, 10.0), "a": (0.5, 5.0), "w": (10.0, 200.0),
    "percent": (10.0, 50.0)}
"""Unit, in lower case → least and greatest error of a field without range."""

NO_UNIT = (0.1, 0.5)
"""Least and greatest error of numbers without range and unit, such as ratios."""

NEVER_NEGATIVE = frozenset({"s", "ms", "hz", "kg", "k"})
"""Numbers of these units only grow, like those that their type keeps from being negative."""


class Sizes(NamedTuple):
    """A robot's own sizes.

    Attributes:
        by_end: End of a field's path, least and greatest error; the first match counts.
        only_grow: Ends of paths whose numbers only grow.
    """

    by_end: tuple[tuple[str, float, float], ...] = ()
    only_grow: tuple[str, ...] = ()


def topic_fault(mode: str, key: str, seed: int, known: Sequence[Topic[Any]],
                sizes: Sizes = Sizes()) -> Fault:  # noqa: B008 a constant
    """Return the fault `MODE:TOPIC`.

    Args:
        mode: One of `MODES` or `NONSENSE`.
        key: Key of a topic or of a member of a family, with or without `rampart/`.
        seed: Of random numbers. An even seed changes all numbers of a message, like a wrong sender;
            an odd one changes a single number, so the others may reveal it. In a message with
            arrays, an even seed puts nonsense only into the arrays.
        known: All topics of the system, see `system_topics`.
        sizes: Sizes of errors that count before those of the fields.

    Raises:
        UnknownFaultError: The mode or topic is unknown, or the mode is senseless on this topic.
    """
    short = key.removeprefix("/").removeprefix(f"{ROOT}/")
    if mode not in (*MODES, *NONSENSE):
        raise UnknownFaultError(f"unknown fault {f'{mode}:{key}'!r}: the mode must be one of "
                                f"{', '.join((*MODES, *NONSENSE))}")
    topic = find_topic(short, known)
    if topic is None:
        raise UnknownFaultError(f"unknown fault {f'{mode}:{key}'!r}: no topic has this key; "
                                "see `rampart topic list`")
    if reason := closed(short) or _senseless(mode, topic):
        raise UnknownFaultError(f"no fault {f'{mode}:{key}'!r}: {reason}")
    draw = Random(f"{short} {seed}")  # noqa: S311 no secret
    if mode in NONSENSE:
        what = _nonsense(mode, topic.type, draw if seed % 2 else None)
        assert what is not None, "checked above"  # noqa: S101
        fields = ", ".join((*what.set_fields, *what.keep_ends))
        return Fault(f"{mode}:{short}", f"nonsense on {short}, {mode}: {fields}",
                     (msgspec.structs.replace(what, topic=short, seed=seed),), (), DURATION_S,
                     READING)
    title, offsets = _TITLES[mode].format(short), {}
    if mode == "corrupt":
        offsets = plausible_offsets(topic.type, draw, sizes)
        if seed % 2:
            path = draw.choice(list(offsets))
            title, offsets = f"{path} on {short} is wrong by a constant", {path: offsets[path]}
    what = Disturbance(
        short, mode, DELAY_S if mode == "delay" else 0.0, add_fields=offsets, seed=seed,
        stamp_s=stamp_error_s(draw) if mode == "restamp" else 0.0)
    return Fault(f"{mode}:{short}", title, (what,), (), DURATION_S, GROUP)


def systematic_faults(keys: Iterable[str], known: Sequence[Topic[Any]],
                      seed: int = 0) -> tuple[Fault, ...]:
    """Return every fault `MODE:TOPIC` of the given topics.

    Args:
        keys: Keys of topics, such as `published_keys` of a system. Topics that must not be
            disturbed are left out, and so are senseless modes.
        known: See `topic_fault`.
        seed: See `topic_fault`.

    Raises:
        UnknownFaultError: A topic is unknown.
    """
    return tuple(topic_fault(mode, key, seed, known)
                 for key in keys for mode in modes_of(key, known))


def modes_of(key: str, known: Sequence[Topic[Any]]) -> tuple[str, ...]:
    """Return the modes in which a topic can fail; none if it must not be disturbed.

    Raises:
        UnknownFaultError: The topic is unknown.
    """
    topic = find_topic(key, known)
    if topic is None:
        raise UnknownFaultError(f"no topic has the key {key!r}; see `rampart topic list`")
    if closed(key):
        return ()
    return tuple(mode for mode in (*MODES, *NONSENSE) if not _senseless(mode, topic))


def stamp_error_s(draw: Random) -> float:
    """Return the error of a stamp, s, above 0 for ahead; never 0."""
    size_s = math.exp(draw.uniform(*map(math.log, STAMPS_S)))
    return round(draw.choice((-1.0, 1.0)) * size_s, 3)


def _nonsense(mode: str, kind: type[msgspec.Struct], draw: Random | None) -> Disturbance | None:
    """Return the disturbance, without a topic; None if no number in a message can have the value.

    Args:
        mode: One of `NONSENSE`.
        kind: Type of the messages.
        draw: Chooses one number; None changes all readings.
    """
    value = {**_NUMBERS, **_ARRAYS}[mode]
    found: dict[str, Disturbance] = {}
    for path, of, _ in numbers(kind):
        change = Disturbance("", "corrupt", keep_ends=(path,)) if mode == "short" else Disturbance(
            "", "corrupt", set_fields={path: value})
        if (mode in _NUMBERS or is_array(path, of)) and _fits(change, kind):
            found[path] = change
    if not found:
        return None
    if draw is not None:
        return draw.choice(list(found.values()))
    arrays = [path for path in found if path.endswith("_f32")] or list(found)
    if mode == "short":
        return Disturbance("", "corrupt", keep_ends=tuple(arrays))
    return Disturbance("", "corrupt", set_fields=dict.fromkeys(arrays, value))


def _fits(change: Disturbance, kind: type[msgspec.Struct]) -> bool:
    try:
        check_fields(kind, change.order("", 0.0))
    except InjectionError:
        return False
    return True


def _senseless(mode: str, topic: Topic[Any]) -> str:
    """Return why a mode is senseless on a topic, or an empty text."""
    kind = topic.type
    if mode in {"corrupt", *NONSENSE} and kind.__struct_config__.array_like:
        return f"{kind.__name__} is array_like: its fields have no names on the way"
    if mode in NONSENSE and topic.qos is not Qos.SENSOR and not topic.outside:
        return f"{topic.key} carries no readings"
    if mode in NONSENSE and _nonsense(mode, kind, None) is None:
        return f"no number in a {kind.__name__} can have this value"
    if mode == "corrupt" and next(numbers(kind), None) is None:
        return f"there is no number to corrupt in a {kind.__name__}"
    if mode == "stuck" and not msgspec.structs.fields(kind):
        return f"a {kind.__name__} has no content that could be stuck"
    return ""


def closed(key: str) -> str:
    """Return why a topic must not be disturbed, or an empty text."""
    if key.startswith("world/"):
        return "the judge uses world/, so a fault there would falsify the verdict"
    if key in UNTOUCHED:
        return "it carries the injections themselves"
    return ""


# -- sizes of errors ---------------------------------------------------------------------------


class Number(NamedTuple):
    """A number in a message: path, type without bounds, and declarations of its field."""

    path: str
    kind: Any
    metas: tuple[msgspec.Meta, ...]

    @property
    def unit(self) -> str:
        """Declared unit, else the last word of its name, in lower case."""
        for meta in self.metas:
            if unit := (meta.extra or {}).get("unit"):
                return str(unit).lower()
        return self.path.removesuffix("_f32").rpartition("_")[2].lower()


def plausible_offsets(kind: type[msgspec.Struct], draw: Random, sizes: Sizes = Sizes()  # noqa: B008
                      ) -> dict[str, float]:
    """Return a plausible offset for every number in a message type: path → amount, never 0."""
    return {number.path: _offset(number, draw, sizes) for number in numbers(kind)}


def _offset(number: Number, draw: Random, sizes: Sizes) -> float:
    own = next(((a, b) for end, a, b in sizes.by_end if number.path.endswith(end)), None)
    span = narrow_range(number.metas)
    if own is not None:
        grows = number.path.endswith(sizes.only_grow)
    else:
        grows = span is None and (number.unit in NEVER_NEGATIVE
                                  or any(m.ge == 0 or m.gt == 0 for m in number.metas))
    sign = 1.0 if grows else draw.choice((-1.0, 1.0))
    if own is None and span is not None:
        width = span[1] - span[0]
        if number.kind is int:
            return sign * draw.randint(1, max(1, int(OF_RANGE[1] * width)))
        return sign * float(f"{width * draw.uniform(*OF_RANGE):.3g}")
    if number.kind is int:
        return draw.randint(1, 3)
    least, most = own or UNITS.get(number.unit, NO_UNIT)
    return round(sign * draw.uniform(least, most), 3)


def numbers(kind: Any, within: str = "") -> Iterator[Number]:
    """Yield each number in a message type, through structs and sequences."""
    for name, field in field_types(kind).items():
        path = f"{within}{name}"
        if name == "pid":
            continue
        if field.element in (int, float) or is_array(path, field.element):
            yield Number(path, field.element, field.metas)
        yield from numbers(field.element, f"{path}.")
