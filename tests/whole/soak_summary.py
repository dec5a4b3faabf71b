"""What a soak came to: figures, what grows, and what was not as it has to be. Pure.

A figure grows if the low end of the slope's 95 % interval is more than what counts. Samples of one
mission have a level of their own, so each is compared with the mean of its mission alone (fixed
effects). Neighbouring samples are nearly equal, so the means of whole minutes are taken. The first
five minutes of a mission are left out: processes begin as copies of the root, and what they share
with it becomes their own as they touch it.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from tests.whole.chaos import ROOT_PROCESS
from tests.whole.chaos_runs import spread

Record = dict[str, Any]
BLOCK_S, WARM_UP_S = 60.0, 300.0
LEAST_BLOCKS = 6
OWN, SHARE, DESCRIPTORS, THREADS = range(4)

TOTALS = (("memory of their own, all", "MB", OWN, 1e-3, 30.0),
          ("shares of memory, all", "MB", SHARE, 1e-3, 30.0),
          ("descriptors, all", "", DESCRIPTORS, 1.0, 60.0),
          ("threads, all", "", THREADS, 1.0, 20.0))
"""Figure, unit, its place in a sample, its scale, and how much in an hour counts."""

SINGLE = (("memory of its own", "MB", OWN, 1e-3, 5.0), ("descriptors", "", DESCRIPTORS, 1.0, 6.0),
          ("threads", "", THREADS, 1.0, 2.0))
ROOT_MB = 15.0
WORST = 6
"""Processes that are listed one by one, besides the root."""


@dataclass(frozen=True, slots=True)
class Sample:
    """A figure at one moment: seconds of the soak, the mission, seconds of that, and its value."""

    at_s: float
    mission: int
    into_s: float
    value: float


@dataclass(frozen=True, slots=True)
class Growth:
    """How a figure changes in an hour, with its 95 % interval, over `blocks` of a minute."""

    figure: str
    unit: str
    mean: float
    slope: float
    low: float
    high: float
    counts: float
    blocks: int

    @property
    def verdict(self) -> str:
        """In words."""
        if self.blocks < LEAST_BLOCKS or not math.isfinite(self.low):
            return "too short to tell"
        if self.low > self.counts:
            return "GROWS"
        return "grows, less than counts" if self.low > 0 else "within noise"

    def __str__(self) -> str:
        return (f"{self.figure:<34} {self.mean:9.1f} {self.unit:<4} {self.slope:+8.2f} an hour "
                f"({self.low:+.2f} to {self.high:+.2f}; {self.counts:g} counts): {self.verdict}")


def growth(figure: str, unit: str, samples: Iterable[Sample], counts: float) -> Growth:
    """Return how a figure grows over samples of any missions; in an hour, `counts` matters."""
    blocks: dict[int, dict[int, list[Sample]]] = defaultdict(lambda: defaultdict(list))
    for s in samples:
        if s.into_s >= WARM_UP_S:
            blocks[s.mission][int(s.into_s // BLOCK_S)].append(s)
    missions = [[(statistics.fmean(s.at_s / 3600 for s in block),
                  statistics.fmean(s.value for s in block)) for block in mission.values()]
                for mission in blocks.values() if len(mission) > 1]
    around = []
    for points in missions:
        t, v = (statistics.fmean(column) for column in zip(*points, strict=True))
        around += [(x - t, y - v) for x, y in points]
    mean = statistics.fmean([v for points in missions for _, v in points]) if missions else 0.0
    free = len(around) - len(missions) - 1
    squares = sum(t * t for t, _ in around)
    slope, half = 0.0, math.inf
    if free > 0 and squares > 0:
        slope = sum(t * v for t, v in around) / squares
        left = sum((v - slope * t) ** 2 for t, v in around)
        half = student(free) * math.sqrt(left / free / squares)
    return Growth(figure, unit, mean, slope, slope - half, slope + half, counts, len(around))


def student(free: int) -> float:
    """Return the 97.5 % quantile of Student's t (Cornish-Fisher; 0.5 % at 5 degrees of freedom)."""
    z = statistics.NormalDist().inv_cdf(0.975)
    exact = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776}
    return exact.get(free) or (
        z + (z**3 + z) / (4 * free) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * free**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * free**3))


def of_kind(records: Iterable[Record], kind: str) -> list[Record]:
    """Return the records of a kind."""
    return [record for record in records if record["kind"] == kind]


def growths(records: Sequence[Record]) -> list[Growth]:
    """Return how the sums grow, the root, and the worst of the other processes.

    Once without the root's family and the routers, too: the watching process keeps a record and the
    routers keep something of each client that was killed; that growth is known and must not hide
    another. The two routers count as one: all clients are of one of them, and change over when it
    is killed.
    """
    samples = of_kind(records, "sample")

    def total(place: int, scale: float, without: Collection[str] = ()) -> list[Sample]:
        return [Sample(r["at_s"], r["mission"], r["into_s"], scale * sum(
            used[place] for name, used in r["used"].items() if name not in without))
            for r in samples]

    def of(names: Collection[str], place: int, scale: float) -> list[Sample]:
        return [Sample(r["at_s"], r["mission"], r["into_s"],
                       scale * sum(r["used"][name][place] for name in names))
                for r in samples if r["used"].keys() >= set(names)]

    found = [growth(figure, unit, total(place, scale), counts)
             for figure, unit, place, scale, counts in TOTALS]
    found += [growth(f"{figure}, {ROOT_PROCESS}", unit, of([ROOT_PROCESS], place, scale),
                     ROOT_MB if place == OWN else counts)
              for figure, unit, place, scale, counts in SINGLE]
    _, unit, place, scale, counts = TOTALS[0]
    found.append(growth("memory of their own, the others", unit,
                        total(place, scale, {ROOT_PROCESS, *ROUTERS}), counts))
    names = {name for r in samples for name in r["used"]} - {ROOT_PROCESS, *ROUTERS}
    figure, unit, place, scale, counts = SINGLE[0]
    others = [growth(f"{figure}, {name}", unit, of(members, place, scale), counts)
              for name, members in {"routers": ROUTERS, **{n: (n,) for n in sorted(names)}}.items()]
    return [*found, *sorted(others, key=lambda one: -one.low)[:WORST]]


def summary(records: Sequence[Record]) -> list[str]:
    """Return the figures, what grows, and what was wrong; each a line."""
    missions, hits = of_kind(records, "mission"), of_kind(records, "hit")
    latencies = of_kind(records, "latency")
    of_hits = [r for r in latencies if "affected" not in r]
    injected = [r for r in latencies if "affected" in r]
    effective = [r for r in injected if r["affected"]]
    lasted_s = max((r["at_s"] for r in records if "at_s" in r), default=0.0)
    return [
        f"{lasted_s / 3600:.2f} hours, {len(of_kind(records, 'begin'))} missions: "
        f"{sum(m['safety'] == 'safe' for m in missions)} of {len(missions)} safe, "
        f"{sum(m['verdict'] == 'success' for m in missions)} successful, "
        f"{sum(m['cut'] for m in missions)} cut, {sum(m['resets'] for m in missions)} resets of "
        "the emergency stop",
        f"{len(hits) + len(injected)} faults: {len(hits)} of processes, {len(injected)} of "
        f"messages, sensors and actuators, of which {len(effective)} changed anything",
        f"process hit until it is replaced: {spread(h['back_s'] for h in hits)}",
        f"node hit until it is known to be down: {spread(r['detected_s'] for r in of_hits)}",
        f"node hit until it is up: {spread(r['over_s'] for r in of_hits)}",
        "fault of messages until a module detects: "
        f"{spread(r['detected_s'] for r in effective)}",
        *map(str, growths(records)), *wrong(records)]


def wrong(records: Sequence[Record]) -> list[str]:
    """Return what was not as it has to be."""
    missions = of_kind(records, "mission")
    return [*(f"WRONG mission {m['mission']}: {m['safety']}: {'; '.join(m['reasons'])}; kept in "
              f"{m['kept']}" for m in missions if m["safety"] != "safe"),
            *(f"WRONG mission {m['mission']}: left over: {', '.join(m['left'])}"
              for m in missions if m["left"]),
            *(f"WRONG mission {h['mission']}, {h['into_s']:g} s: {h['name']} not back after "
              f"{h['way']}" for h in of_kind(records, "hit") if h["back_s"] is None),
            *(f"WRONG {one}" for one in growths(records) if one.verdict == "GROWS")]
