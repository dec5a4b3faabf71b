"""How long the arbitration engine takes: loading, deciding, stepping, verifying.

    make bench        or        .venv/bin/python -m pytest benchmarks -q

Each round of a benchmark of decisions asks many questions; `each_us` in its extra information, and
the list at the end, is the time for one. None of them asserts a time: the figures are noted in
docs/log.
"""

from __future__ import annotations

import random
import statistics
import time
from itertools import combinations

import pytest

from benchmarks.synthetic_system import synthetic_system
from rampart import systems
from rampart.manager.analysis.verification import verify
from rampart.manager.arbitration.arbiter import build_arbiter
from rampart.manager.arbitration.arbiter_state import Tick
from rampart.manager.arbitration.detection_track import DetectionHeard
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import parse_specification
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.registry import STRATEGIES, Decider, find_strategy

OSMOSIS = (systems.SHIPPED / "paper.toml").read_text(encoding="utf-8")
NAMES = sorted(STRATEGIES)


@pytest.fixture(scope="module")
def osmosis() -> SystemSpec:
    return parse_specification(OSMOSIS, "paper.toml")


@pytest.fixture(scope="module")
def large() -> SystemSpec:
    return parse_specification(synthetic_system(1000, 200), "synthetic.toml")


@pytest.fixture(scope="session", autouse=True)
def summary():
    """Print the times for one decision, which the table of rounds does not show."""
    lines: list[str] = []
    yield lines
    if lines:
        print("\n\none decision, microseconds, median (min-max):\n  " + "\n  ".join(lines))


def arranged(spec: SystemSpec) -> Arrangement:
    return Arrangement(spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order())


def all_sets(spec: SystemSpec) -> list[tuple[str, ...]]:
    names = [m.name for m in spec.mechanisms]
    return [c for n in range(1, len(names) + 1) for c in combinations(names, n)]


def each(ask, questions, summary, label) -> None:
    """Time single questions, since the mean over a batch hides the slow ones."""
    times = []
    for _ in range(max(1, 2000 // len(questions))):
        for question in questions:
            start = time.perf_counter_ns()
            ask(question)
            times.append((time.perf_counter_ns() - start) / 1000)
    summary.append(f"{label:<56} {statistics.median(times):8.2f} "
                   f"({min(times):.2f}-{max(times):.2f})")


@pytest.mark.parametrize("strategy", NAMES)
def test_choose_osmosis(benchmark, osmosis, summary, strategy):
    arrangement, chosen, late = arranged(osmosis), find_strategy(strategy), frozenset()
    questions = all_sets(osmosis)
    each(lambda q: chosen.choose(q, arrangement, late), questions, summary,
         f"osmosis, 127 sets, {strategy}, choose")
    benchmark(lambda: [chosen.choose(q, arrangement, late) for q in questions])
    benchmark.extra_info["each_us"] = benchmark.stats.stats.median / len(questions) * 1e6


@pytest.mark.parametrize("strategy", NAMES)
def test_decide_with_certificate_osmosis(benchmark, osmosis, summary, strategy):
    arrangement, found, late = arranged(osmosis), find_strategy(strategy), frozenset()
    questions = all_sets(osmosis)

    def cold(question):
        return found.explain(found.choose(question, arrangement, late), arrangement)

    each(cold, questions, summary, f"osmosis, 127 sets, {strategy}, choose + explain, cold")
    decider = Decider(found, arrangement)

    def warm(question):
        return decider.explain(decider.choose(question))

    for question in questions:
        warm(question)
    each(decider.choose, questions, summary, f"osmosis, 127 sets, {strategy}, choose, warm")
    each(warm, questions, summary, f"osmosis, 127 sets, {strategy}, choose + explain, warm")
    benchmark(lambda: [cold(q) for q in questions])


@pytest.mark.parametrize("active", [1, 10, 100, 1000])
@pytest.mark.parametrize("strategy", NAMES)
def test_choose_of_a_thousand_mechanisms(benchmark, large, summary, strategy, active):
    arrangement, chosen, late = arranged(large), find_strategy(strategy), frozenset()
    chance = random.Random(7)
    names = arrangement.mechanisms.names
    questions = [arrangement.mechanisms.sort(chance.sample(names, active)) for _ in range(50)]
    each(lambda q: chosen.choose(q, arrangement, late), questions, summary,
         f"1000 FTMs, 200 RMs, {active} active, {strategy}, choose")
    benchmark(lambda: [chosen.choose(q, arrangement, late) for q in questions])


def test_load_osmosis(benchmark):
    benchmark(lambda: arranged(parse_specification(OSMOSIS, "paper.toml")))


def test_load_a_thousand_mechanisms(benchmark):
    text = synthetic_system(1000, 200)
    benchmark.pedantic(lambda: arranged(parse_specification(text, "synthetic.toml")), rounds=3)


@pytest.mark.parametrize("what", ["tick", "report"])
def test_step_osmosis(benchmark, osmosis, what):
    arbiter = build_arbiter(osmosis)
    state = arbiter.initial(0.0)
    for i in range(1, 8):
        state, _ = arbiter.step(state, DetectionHeard(f"DM{i}", False, "", (), 0.0), 0.0)
    event = Tick() if what == "tick" else DetectionHeard("DM4", True, "dead", ("hmi",), 0.1)
    benchmark(arbiter.step, state, event, 0.1)


def test_verify_osmosis(benchmark, osmosis):
    benchmark.pedantic(verify, (osmosis,), rounds=3)


@pytest.mark.timeout(600)
def test_verify_twelve_mechanisms(benchmark):
    spec = parse_specification(synthetic_system(12, 8), "synthetic.toml")
    benchmark.pedantic(verify, (spec,), rounds=1)
