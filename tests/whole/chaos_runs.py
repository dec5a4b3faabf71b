"""The long chaos test, `make chaos`: every process in every way, 50 routers, 200 deaths.

`python -m tests.whole.chaos_runs [--seed N] [--rate R] [--only ways|routers|leaks] [--kills N]`,
about half an hour. One line for each hit, one for each count, a summary; exit code 1 if anything
was not as it has to be. Other load on the machine is part of what is tested, so keep it moderate.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.manager.spec.specification import SystemSpec, check_document, read_document
from rampart.testing import RealRun, free_base_port
from tests import ROOT
from tests.whole.chaos import (
    Chaos,
    Hit,
    Struck,
    complaints,
    each_in_every_way,
    so_many,
    targets,
)
from tests.whole.leak_counts import Counts, count, leaks, shared_memory

SYSTEM = ROOT / "systems" / "osmosis.toml"
SETTLE_S = 8.0
"""Wall seconds of quiet before a count that others are compared with."""

ROUTER_HITS = 50
COUNT_EVERY = 40
LAPS = 3
MINUTES = 10.0


def load() -> SystemSpec:
    """Return the full system."""
    return check_document(read_document(SYSTEM.read_text(encoding="utf-8"), SYSTEM.name),
                          SYSTEM.name)


def start(directory: Path, mission: str, rate: float) -> RealRun:
    """Return a run of the full system with the operator's page, not yet begun."""
    directory.mkdir()
    return RealRun(directory, str(SYSTEM), "--mission", mission, "--rate", f"{rate:g}",
                   "--hmi-port", str(free_base_port()), "--patience", "90", hmi=True)


def say(line: object) -> None:
    """Print a line at once."""
    print(line, flush=True)


def everybody_in_every_way(root: Path, seed: int, rate: float) -> list[str]:
    """Hit every process in every way during one mission; return what was wrong."""
    everybody = targets(load())
    hits = each_in_every_way(everybody, seed, (2.0 / rate, 5.0 / rate))
    return _in_one_mission("ways", root, rate, hits, LAPS, everybody.world)


def routers_in_turn(root: Path, seed: int, rate: float) -> list[str]:
    """Hit the two routers in turn during one mission; return what was wrong."""
    hits = so_many(ROUTERS, ROUTER_HITS, seed, (1.0 / rate, 4.0 / rate))
    return _in_one_mission("routers", root, rate, hits, 0)


def _in_one_mission(where: str, root: Path, rate: float, hits: Sequence[Hit],  # noqa: PLR0917
                    laps: int, world: Sequence[str] = ()) -> list[str]:
    with start(root / where, str(write_laps(root, laps)), rate) as run:
        run.wait_for("goal 1/")
        chaos = Chaos(run, world, say)
        left = chaos.carry_out(hits)
        code, result = run.result(1200)
    wrong = complaints(run, code, result, "AB", chaos.struck)
    if left:
        wrong.append(f"{len(left)} hits of {len(hits)} were left when the mission ended")
    say(f"{len(chaos.struck)} hits: {result['mission']}, {result['safety']}, "
        f"{result['duration_s']} s simulated")
    return _judged(where, run, chaos.struck, wrong)


def write_laps(directory: Path, laps: int = LAPS) -> Path:
    """Write mission AB and then its way again and again, without looking at the lights."""
    goals = load_airport("vallombre").missions["AB"].goals
    lines = [f"x={g.x_m},y={g.y_m},taxi={int(lap > 0 or g.mode == 'taxi')}"
             for lap in range(laps + 1) for g in goals]
    file = directory / "LAPS.miss"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def many_deaths(root: Path, seed: int, rate: float, kills: int) -> list[str]:
    """Let so many processes die in ten minutes of one run; return what was wrong or has leaked."""
    everybody = targets(load())
    survivors = (SUPERVISOR,)
    names = [name for name in everybody.mortal if name not in survivors]
    counted = (*survivors, *everybody.world)
    period_s = 60 * MINUTES / kills
    hits = so_many(names, kills, seed, (0.5 * period_s, 1.1 * period_s))
    memory_before = shared_memory()
    with start(root / "deaths", str(write_laps(root)), rate) as run:
        run.wait_for("goal 1/")
        time.sleep(SETTLE_S)
        counts: list[Counts] = [count(run, counted)]
        say(f"before: {counts[0]}")
        chaos = Chaos(run, (), say)
        for done in range(0, kills, COUNT_EVERY):
            undone = chaos.carry_out(hits[done:done + COUNT_EVERY])
            if undone:
                break
            say(f"after {done + COUNT_EVERY}: {count(run, counted)}")
        took_s = chaos.elapsed_s
        if run.process.poll() is None:
            time.sleep(SETTLE_S)
            counts.append(count(run, counted))
            say(f"after: {counts[-1]}")
        code, result = run.result(900)
    wrong = complaints(run, code, result, "AB", chaos.struck) + leaks(counts[0], counts[-1])
    if len(chaos.struck) < kills or took_s > 60 * MINUTES:
        wrong.append(f"{len(chaos.struck)} of {kills} deaths in {took_s:.0f} s")
    wrong += [f"shared memory: {name}" for name in sorted(shared_memory() - memory_before)]
    if f"rampart.{run.port}." in Path("/proc/net/unix").read_text(encoding="utf-8"):
        wrong.append("a unix socket is left")
    say(f"{len(chaos.struck)} deaths in {took_s:.0f} s: {result['mission']}, {result['safety']}")
    return _judged("deaths", run, chaos.struck, wrong)


def _judged(where: str, run: RealRun, struck: Sequence[Struck], wrong: list[str]) -> list[str]:
    back = sorted(done.back_s for done in struck if done.back_s is not None)
    if back:
        say(f"{where}: back after {back[len(back) // 2] * 1e3:.0f} ms (median), "
            f"{back[-1] * 1e3:.0f} ms at most")
    if wrong:
        say(run.story)
    return [f"{where}: {line}" for line in wrong]


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--only", choices=("ways", "routers", "leaks"))
    parser.add_argument("--kills", type=int, default=200, help="in ten minutes (default: 200)")
    options = parser.parse_args()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        if options.only in {None, "ways"}:
            wrong += everybody_in_every_way(root, options.seed, options.rate)
        if options.only in {None, "routers"}:
            wrong += routers_in_turn(root, options.seed, options.rate)
        if options.only in {None, "leaks"}:
            wrong += many_deaths(root, options.seed, options.rate, options.kills)
    for line in wrong:
        say(f"WRONG {line}")
    say("all as it has to be" if not wrong else f"{len(wrong)} things are wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
