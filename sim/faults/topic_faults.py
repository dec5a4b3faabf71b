"""Systematic faults: every topic that a node publishes, in every mode, as `MODE:TOPIC`.

`corrupt:TOPIC` adds a constant offset to every number in a message, also in nested structs,
sequences and arrays. Each offset is drawn once per fault, from a range that is plausible for its
unit (`wrong_numbers`), so the message stays possible. Truth values, words and texts stay. So does
`pid`: the supervisor kills by it, and a wrong one may be another process.

`restamp:TOPIC` is a clock with a constant error, ahead or behind, drawn as well.

A *nonsense reading* (`NONSENSE`) is impossible for a sound device: zeros, negative or huge numbers,
arrays of another length. Topics of sensors and devices have them: `nan:TOPIC`.

Topics below `world/` are left out, since the judge uses them and a fault there would falsify the
verdict. Topics that carry injections are left out, too.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from random import Random
from typing import Any

import msgspec

from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.runtime.corruption import InjectionError, check_fields, is_array
from rampart.actors.runtime.injection import MODES, UNTOUCHED
from rampart.actors.system.topics import find_topic
from rampart.sim.faults.disturbance import Disturbance, Fault, UnknownFaultError
from rampart.sim.faults.wrong_numbers import Sizes, numbers, plausible_offsets

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
