"""What was measured, as data: spreads, ratios, the rows of each part. Pure.

Times are milliseconds. A spread is the median with the 5th and the 95th percentile, interpolated
between the samples (Hyndman and Fan's type 7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

PARTS = ("peers", "floors", "restart", "size", "keys")
"""Of the benchmark, in the sequence in which they are measured; fields of `Figures`."""

SIZES = "10,35,70,140"
"""Processes of the systems that are measured unless told otherwise."""


class Spread(msgspec.Struct, frozen=True):
    """Some samples in four numbers."""

    n: int
    median: float
    low: float
    high: float


def quantile(ordered: Sequence[float], share: float) -> float:
    """Return a quantile of samples in ascending order.

    Raises:
        ValueError: There are none, or the share is not between 0 and 1.
    """
    if not ordered or not 0 <= share <= 1:
        raise ValueError(f"quantile {share} of {len(ordered)} samples")
    place = share * (len(ordered) - 1)
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (ordered[above] - ordered[below]) * (place - below)


def spread(samples: Sequence[float | None]) -> Spread | None:
    """Return the spread of the samples that there are, None if there are none."""
    ordered = sorted(sample for sample in samples if sample is not None)
    if not ordered:
        return None
    median, low, high = (round(quantile(ordered, share), 4) for share in (0.5, 0.05, 0.95))
    return Spread(len(ordered), median, low, high)


def ratios(of: Sequence[float | None], to: Sequence[float | None]) -> Spread | None:
    """Return how many times as long some took as others, round by round.

    Samples of the same place were taken in the same round, right after each other; so what slows
    the machine down for a while slows both.
    """
    return spread([a / b for a, b in zip(of, to, strict=False)
                   if a is not None and b is not None and b > 0])


def ratio(of: Spread | None, to: Spread | None) -> float | None:
    """Return the ratio of two medians."""
    return round(of.median / to.median, 3) if of and to and to.median > 0 else None


class Kill(msgspec.Struct, frozen=True):
    """What followed one SIGKILL, milliseconds after it; None where that was not observed.

    Attributes:
        detected: That the process is gone is told by whoever keeps it alive.
        decided: The manager of a system decides on a recovery.
        begun: The replacement runs its first line.
        output: An independent process hears the replacement's first valid output.
    """

    detected: float | None = None
    decided: float | None = None
    begun: float | None = None
    output: float | None = None


class Killed(msgspec.Struct, frozen=True):
    """One row of a part that kills.

    Attributes:
        name: Of the peer, or of the node.
        title: The same in words.
        kills: In the sequence of the rounds.
        note: Why there are none, or not all.
        times: How many times as long the peer takes as Rampart's actor.
    """

    name: str
    title: str
    kills: tuple[Kill, ...] = ()
    note: str = ""
    detected_ms: Spread | None = None
    decided_ms: Spread | None = None
    begun_ms: Spread | None = None
    output_ms: Spread | None = None
    times: Spread | None = None


def killed(name: str, title: str, kills: Sequence[Kill], note: str = "",
           beside: Sequence[Kill] = ()) -> Killed:
    """Return a row with its spreads.

    Args:
        name: See `Killed`.
        title: Likewise.
        kills: Likewise.
        note: Likewise.
        beside: Those of Rampart's actor in the same rounds.
    """
    outputs = [kill.output for kill in kills]
    return Killed(
        name, title, tuple(kills), note, spread([kill.detected for kill in kills]),
        spread([kill.decided for kill in kills]), spread([kill.begun for kill in kills]),
        spread(outputs), ratios(outputs, [kill.output for kill in beside]))


class Floor(msgspec.Struct, frozen=True):
    """What cannot be beaten, and how near the system comes.

    Attributes:
        name: Of the floor.
        title: What was measured.
        unit: Of both spreads.
        floor: What it takes.
        against: What is compared with it.
        ours: What that takes.
        ratio: Of the medians; None where the other one was not measured in this run.
        target: At most so much is aimed at.
    """

    name: str
    title: str
    unit: str
    floor: Spread | None
    against: str = ""
    ours: Spread | None = None
    ratio: float | None = None
    target: float | None = None
    note: str = ""


class Size(msgspec.Struct, frozen=True):
    """A system of so many processes.

    Attributes:
        processes: Root, supervisor, routers and pool included.
        start_s: From the command until all processes run.
        pss_mb: Proportional memory of one process at the mean; what is shared is divided.
        uss_mb: Memory that one process has for itself, at the mean.
        total_mb: Proportional memory of all.
        cores: Processor time of all in a second, each node at 20 Hz.
        output_ms: From SIGKILL of a node until its replacement is heard.
        times: Ratio of that to the smallest system's.
        note: What went wrong.
        samples_ms: Of `output_ms`.
    """

    processes: int
    start_s: float | None = None
    pss_mb: float | None = None
    uss_mb: float | None = None
    total_mb: float | None = None
    cores: float | None = None
    output_ms: Spread | None = None
    times: float | None = None
    note: str = ""
    samples_ms: tuple[float, ...] = ()


class Machine(msgspec.Struct, frozen=True):
    """Where it was measured, in general words."""

    cores: int
    memory_gb: int
    system: str
    python: str
    zenoh: str
    load: float


class Figures(msgspec.Struct, frozen=True):
    """All of one run of the benchmark; a part that was not asked for is None."""

    rampart: str
    when: str
    command: str
    machine: Machine
    peers: tuple[Killed, ...] | None = None
    floors: tuple[Floor, ...] | None = None
    restart: tuple[Killed, ...] | None = None
    size: tuple[Size, ...] | None = None
    keys: tuple[Floor, ...] | None = None
