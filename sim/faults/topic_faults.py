"""The systematic faults: every topic that a node publishes, with every mode, as `MODE:TOPIC`.

`corrupt:TOPIC` needs no knowledge of the message. It adds a constant offset to every number in
it, also to those in nested structs, sequences and arrays. The offset is drawn once per fault from
a range that its unit makes plausible (`SPREADS`): the message stays one that a node could have
sent, and each number in it is wrong, every time by the same. Its sign is random, but durations,
illuminances, intensities and whole numbers only grow, since hardly any of them can be negative;
whole numbers by 1 to 3. Truth values, words and texts stay. So does `pid`: the supervisor kills
by it, and a wrong one may be a stranger's process.

`restamp:TOPIC` is a clock that is wrong by a constant, ahead or behind, drawn as well.

The topics below `world/` are left out, because the judge goes by them and a fault there would
falsify the verdict, and so are those that carry the injections themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from random import Random
from typing import Any

import msgspec

from rampart.actors.bus.bounds import bare
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.layout.system_topics import find_topic
from rampart.actors.runtime.corruption import is_array
from rampart.actors.runtime.injection import MODES, UNTOUCHED
from rampart.sim.faults.disturbance import Disturbance, Fault, UnknownFaultError

GROUP = "topic"
DURATION_S = 10.0

DELAY_S = 1.5
"""Delay of `delay:TOPIC`: half as long again as the longest freshness timeout that is derived
for the shipped system (0.99 s), so that a delay is one that should be detected."""

SPREADS: tuple[tuple[str, float, float], ...] = (
    ("_m", 0.5, 3.0), ("_rad", 0.3, 1.5), ("_mps", 0.2, 0.8), ("_radps", 0.2, 1.0),
    ("_mps2", 0.5, 2.0), ("_s", 1.0, 10.0), ("_lux", 200.0, 1000.0), ("_cd", 50.0, 150.0),
    ("_f32", 0.3, 1.5), ("waypoints", 0.5, 3.0), ("", 0.1, 0.5))
"""End of a field's name → least and greatest offset; the first that fits counts. The last is for
numbers without a unit, such as ratios and stick positions."""

_ONLY_GROW = ("_s", "_lux", "_cd")

STAMPS_S = (0.02, 5.0)
"""Least and greatest error of a stamp: from one that need not be noticed to one beyond every
freshness timeout. Drawn by its logarithm, so that the small ones are as frequent as the large."""

_TITLES = {
    "drop": "nothing on {} arrives",
    "freeze": "{} repeats its last message, old stamp included",
    "stuck": "{} repeats its last content with fresh stamps",
    "delay": "{} arrives " + f"{DELAY_S:g} s late",
    "duplicate": "each message on {} is sent twice",
    "restamp": "the stamps on {} are wrong by a constant",
    "corrupt": "each number on {} is wrong by a constant"}


def topic_fault(mode: str, key: str, seed: int, known: Sequence[Topic[Any]]) -> Fault:
    """Return the fault `MODE:TOPIC`.

    Args:
        mode: one of `MODES`.
        key: of a declared topic or one member of a family, with or without `rampart/`.
        seed: of what `restamp` and `corrupt` draw, and of the gate's chance. An even one corrupts
            every number of a message, as a wrong sender does; an odd one only one of them, which
            leaves whatever the others can be checked by.
        known: all topics of the system, see `system_topics`.

    Raises:
        UnknownFaultError: no such mode or topic, or the two do not go together.
    """
    short = key.removeprefix("/").removeprefix(f"{ROOT}/")
    if mode not in MODES:
        raise UnknownFaultError(f"unknown fault {f'{mode}:{key}'!r}: the mode must be one of "
                                f"{', '.join(MODES)}")
    topic = find_topic(short, known)
    if topic is None:
        raise UnknownFaultError(f"unknown fault {f'{mode}:{key}'!r}: no topic has this key; "
                                "see `rampart topic list`")
    if reason := _closed(short) or _senseless(mode, topic.type):
        raise UnknownFaultError(f"no fault {f'{mode}:{key}'!r}: {reason}")
    draw = Random(f"{short} {seed}")  # noqa: S311 no secret
    title, offsets = _TITLES[mode].format(short), {}
    if mode == "corrupt":
        offsets = plausible_offsets(topic.type, draw)
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
        keys: of single topics, e.g. those that `published_keys` of a system gives; those that must
            not be disturbed are passed over, and so are modes that make no sense on a topic.
        known: see `topic_fault`.
        seed: likewise.

    Raises:
        UnknownFaultError: a key is none.
    """
    return tuple(topic_fault(mode, key, seed, known)
                 for key in keys for mode in modes_of(key, known))


def modes_of(key: str, known: Sequence[Topic[Any]]) -> tuple[str, ...]:
    """Return the modes in which a topic can fail; none for one that must not be disturbed.

    Raises:
        UnknownFaultError: there is no such topic.
    """
    topic = find_topic(key, known)
    if topic is None:
        raise UnknownFaultError(f"no topic has the key {key!r}; see `rampart topic list`")
    if _closed(key):
        return ()
    return tuple(mode for mode in MODES if not _senseless(mode, topic.type))


def plausible_offsets(kind: type[msgspec.Struct], draw: Random) -> dict[str, float]:
    """Return an offset for every number in a message type: path → amount, never 0."""
    offsets: dict[str, float] = {}
    for path, leaf in _numbers(kind):
        sign = 1.0 if path.endswith(_ONLY_GROW) else draw.choice((-1.0, 1.0))
        if leaf is int:
            offsets[path] = draw.randint(1, 3)
        else:
            least, most = next((a, b) for end, a, b in SPREADS if path.endswith(end))
            offsets[path] = round(sign * draw.uniform(least, most), 3)
    return offsets


def stamp_error_s(draw: Random) -> float:
    """Return by how much a stamp is wrong, s, above 0 for ahead; never 0."""
    size_s = math.exp(draw.uniform(*map(math.log, STAMPS_S)))
    return round(draw.choice((-1.0, 1.0)) * size_s, 3)


def _numbers(kind: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and type of each number in a type, through structs and sequences."""
    kind = bare(kind)
    if getattr(kind, "__origin__", None) in (tuple, list):
        yield from _numbers(kind.__args__[0], path)
    elif isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        for f in msgspec.structs.fields(kind):
            if f.name != "pid":
                yield from _numbers(f.type, f"{path}.{f.name}" if path else f.name)
    elif kind in (int, float) or is_array(path, kind):
        yield path, kind


def _senseless(mode: str, kind: type[msgspec.Struct]) -> str:
    """Return why a message type cannot fail in a mode, or an empty text."""
    if mode == "corrupt" and kind.__struct_config__.array_like:
        return f"{kind.__name__} is array_like: its fields have no names on the way"
    if mode == "corrupt" and next(_numbers(kind), None) is None:
        return f"there is no number to corrupt in a {kind.__name__}"
    if mode == "stuck" and not msgspec.structs.fields(kind):
        return f"a {kind.__name__} has no content that could be stuck"
    return ""


def _closed(key: str) -> str:
    """Return why a topic must not be disturbed, or an empty text."""
    if key.startswith("world/"):
        return "the judge goes by world/, a fault there would falsify the verdict"
    if key in UNTOUCHED:
        return "it carries the injections themselves"
    return ""
