"""What a soak came to: figures, what grows, and what was not as it has to be. Pure."""

from __future__ import annotations

import statistics
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from tests.whole.chaos_pairs import LAUNCHER
from tests.whole.soak_growth import Growth, Sample, growth

Record = dict[str, Any]
OWN, SHARE, DESCRIPTORS, THREADS = range(4)

TOTALS = (("memory of their own, all", "MB", OWN, 1e-3, 30.0),
          ("shares of memory, all", "MB", SHARE, 1e-3, 30.0),
          ("descriptors, all", "", DESCRIPTORS, 1.0, 60.0),
          ("threads, all", "", THREADS, 1.0, 20.0))
"""Figure, unit, its place in a sample, its scale, and how much in an hour counts."""

SINGLE = (("memory of its own", "MB", OWN, 1e-3, 5.0), ("descriptors", "", DESCRIPTORS, 1.0, 6.0),
          ("threads", "", THREADS, 1.0, 2.0))
RECORD_MB = 15.0
"""In an hour, of the launcher: it keeps the record of the run until its report, some 5 MB an hour
under faults, and 10,000 entries of a kind at most."""

WORST = 6
"""Roles that are shown one by one, of all but the launcher."""


def of_kind(records: Iterable[Record], kind: str) -> list[Record]:
    """Return the records of a kind."""
    return [record for record in records if record["kind"] == kind]


def totals(records: Sequence[Record], place: int, scale: float,
           without: Collection[str] = frozenset()) -> list[Sample]:
    """Return the sum over all processes of a run, or all but some, sample by sample."""
    return [Sample(r["at_s"], r["mission"], r["into_s"], scale * sum(
        used[place] for name, used in r["used"].items() if name not in without))
            for r in of_kind(records, "sample")]


def of_role(records: Sequence[Record], names: Collection[str], place: int, scale: float
            ) -> list[Sample]:
    """Return the sum over processes that share a role, over all their incarnations."""
    return [Sample(r["at_s"], r["mission"], r["into_s"],
                   scale * sum(r["used"][name][place] for name in names))
            for r in of_kind(records, "sample") if r["used"].keys() >= set(names)]


def growths(records: Sequence[Record]) -> list[Growth]:
    """Return how the sums grow, the launcher, which nobody replaces, and the worst of the others.

    Once without the launcher and the routers, too: it keeps a record, and they keep something of
    each client that was killed, so that these grow is known, and the rest is not hidden by it.

    A process that is replaced now and then begins anew each time: its role is looked at as a whole.
    The two routers have one between them: all clients are of one, which has 12 MB for it and the
    other 8, and when that one is killed they change over.
    """
    found = [growth(what, unit, totals(records, place, scale), counts)
             for what, unit, place, scale, counts in TOTALS]
    found += [growth(f"{what}, {LAUNCHER}", unit, of_role(records, [LAUNCHER], place, scale),
                     RECORD_MB if place == OWN else counts)
              for what, unit, place, scale, counts in SINGLE]
    _, unit, place, scale, counts = TOTALS[0]
    found.append(growth("memory of their own, the others", unit, totals(
        records, place, scale, without={LAUNCHER, *ROUTERS}), counts))
    names = {name for r in of_kind(records, "sample") for name in r["used"]}
    roles = {name: (name,) for name in sorted(names - {LAUNCHER, *ROUTERS})}
    what, unit, place, scale, counts = SINGLE[0]
    others = [growth(f"{what}, {role}", unit, of_role(records, members, place, scale), counts)
              for role, members in {"routers": ROUTERS, **roles}.items()]
    return [*found, *sorted(others, key=lambda one: -one.low)[:WORST]]


def spread(values: Sequence[float]) -> str:
    """Return median, 95th percentile and maximum, milliseconds."""
    if len(values) < 2:
        return "too few"
    return (f"median {1e3 * statistics.median(values):.0f} ms, 95 % within "
            f"{1e3 * statistics.quantiles(values, n=20, method='inclusive')[-1]:.0f} ms, at most "
            f"{1e3 * max(values):.0f} ms ({len(values)})")


def summary(records: Sequence[Record]) -> list[str]:
    """Return the figures, what grows, and what was wrong; each a line."""
    missions, blows = of_kind(records, "mission"), of_kind(records, "blow")
    latencies = of_kind(records, "latency")
    by_message = [r for r in latencies if "affected" in r]
    effective = [r for r in by_message if r["affected"]]
    hit = [r for r in blows if not r["absent"]]
    lasted_s = max((r["at_s"] for r in records if "at_s" in r), default=0.0)
    lines = [
        f"{lasted_s / 3600:.2f} hours, {len(of_kind(records, 'begin'))} missions: "
        f"{sum(m['safety'] == 'safe' for m in missions)} of {len(missions)} safe, "
        f"{sum(m['verdict'] == 'success' for m in missions)} successful, "
        f"{sum(m['cut'] for m in missions)} cut, {sum(m['resets'] for m in missions)} resets of "
        "the emergency stop",
        f"{len(hit) + len(by_message)} faults: {len(hit)} of processes, {len(by_message)} of "
        f"messages, sensors and actuators, of which {len(effective)} changed anything",
        "process hit until it is replaced: " + spread(
            [r["back_s"] for r in hit if r["back_s"] is not None]),
        "node hit until it is known to be down: " + spread(
            [r["detected_s"] for r in latencies if "affected" not in r]),
        "node hit until it is up: " + spread(
            [r["over_s"] for r in latencies if "affected" not in r]),
        "fault of messages until a module detects: " + spread(
            [r["detected_s"] for r in effective if r["detected_s"] is not None])]
    return [*lines, *map(str, growths(records)), *wrong(records)]


def wrong(records: Sequence[Record]) -> list[str]:
    """Return what was not as it has to be."""
    missions = of_kind(records, "mission")
    found = [f"WRONG mission {m['mission']}: {m['safety']}: {'; '.join(m['reasons'])}; kept in "
             f"{m['kept']}" for m in missions if m["safety"] != "safe"]
    found += [f"WRONG mission {m['mission']}: left over: {', '.join(m['left'])}"
              for m in missions if m["left"]]
    found += [f"WRONG mission {r['mission']}, {r['into_s']:g} s: {r['name']} not back after "
              f"{r['way']}" for r in of_kind(records, "blow")
              if r["back_s"] is None and not r["absent"]]
    return found + [f"WRONG {one}" for one in growths(records) if one.verdict == "GROWS"]
