"""What verification finds about the shipped system and broken ones; the table of all pairs."""

import asyncio
import gc
import json
import math
import weakref
from itertools import combinations

import msgspec
import pytest

from rampart import STRATEGIES, Arbiter, Decision
from rampart.cli.analyse import decide_verbs
from rampart.cli.main import main
from rampart.manager.analysis import active_sets
from rampart.manager.analysis.active_sets import ActiveSets, order_agrees_with_tree
from rampart.manager.analysis.pairs import Pair, causes_of, pairs
from rampart.manager.analysis.transitions import Transitions, explore
from rampart.manager.analysis.verification import MEANING, Report, verify
from rampart.manager.model.mechanisms import RecoveryPhase
from rampart.manager.model.order import PartialOrder
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.guarded_repair import GuardedRepair
from rampart.manager.strategies.safety_first import SafetyFirst
from rampart.testing import run
from tests import ROOT
from tests.manager.bench import Managed, edited, full_system, paper

SPEC = paper()
ARRANGEMENT = Arrangement(SPEC.build_mechanisms(), SPEC.build_ftm_tree(), SPEC.build_order())


@pytest.fixture(scope="module")
def report() -> Report:
    return verify(SPEC)


def failing(report: Report) -> dict[tuple[str, str], int]:
    return {(p.strategy, p.name): p.count for p in report.properties if not p.holds}


def test_every_property_is_checked_for_every_strategy(report):
    checked = {(p.name, p.strategy) for p in report.properties}
    assert len(checked) == len(report.properties)
    assert checked == {("order-agrees-with-tree", "")} | {
        (name, strategy) for name in MEANING if name != "order-agrees-with-tree"
        for strategy in STRATEGIES}
    assert report.active_sets == 127
    assert report.states > 5000
    for found in report.properties:
        assert found.cases >= 6
        assert found.holds == (found.count == 0) == (not found.counterexamples)
        assert len(found.counterexamples) == min(found.count, 3)
        sizes = [trace[0].split(" active")[0].count("FTM") for trace in found.counterexamples]
        assert sizes == sorted(sizes), "the shortest first"


def test_exactly_these_properties_fail_on_the_papers_system(report):
    assert failing(report) == {
        ("safety-first", "monotone"): 2,
        ("safety-first", "repairs-run"): 32,
        ("mission-first", "safe-enough"): 178,
        ("mission-first", "monotone"): 70,
        ("mission-first", "repairs-run"): 240,
        ("simultaneous", "repairs-run"): 28,
    }
    assert report.permissiveness == {"safety-first": 90, "mission-first": 64,
                                     "simultaneous": 88, "guarded-repair": 88}
    assert report.stuck_behind_last_resort == {"safety-first": 66, "mission-first": 56,
                                               "simultaneous": 62, "guarded-repair": 0}


@pytest.mark.parametrize(("strategy", "failing", "stuck"), [
    ("safety-first", 98, 0), ("simultaneous", 90, 0), ("guarded-repair", 0, 0)])
def test_a_last_resort_that_does_not_latch_excuses_no_repair_from_running(
        strategy, failing, stuck):
    spec = edited(RM1={"latched": False})
    arrangement = Arrangement(spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order())
    sets = ActiveSets(arrangement, arrangement.order, STRATEGIES[strategy])
    counts = {p.name: p.count for p in sets.check()}
    assert (counts["repairs-run"], sets.stuck_behind_last_resort) == (failing, stuck)


def three():
    """FTM1(RM1) above FTM2(RM2) above FTM4(RM3)."""
    return msgspec.structs.replace(
        SPEC, mechanisms=tuple(m for m in SPEC.mechanisms if m.name in {"FTM1", "FTM2", "FTM4"}),
        recoveries=tuple(r for r in SPEC.recoveries if r.name in {"RM1", "RM2", "RM3"}),
        orders={"safer": {"RM1": ("RM2",), "RM2": ("RM3",)}})


@pytest.mark.nightly
def test_two_recoveries_at_a_time_and_all_together_lead_to_the_same_verdicts():
    by_pairs, whole = (verify(three(), ["safety-first"], together) for together in (2, 3))
    assert whole.states > 3 * by_pairs.states / 2
    assert {(p.name, p.holds) for p in by_pairs.properties} == {
        (p.name, p.holds) for p in whole.properties}


BLOCKS, RELEASE, INIT = Arbiter._blocks, Arbiter._release, Arbiter.__init__


def forgets_releases(self, other, name, chosen):
    """Takes a release for done when it is sent: the rule before this verification was written."""
    return BLOCKS(self, msgspec.structs.replace(other, letting_go=False), name, chosen)


def makes_all_wait(self, other, name, chosen):
    """Lets everybody wait for whatever is at work, the last resort included."""
    return other.name != name and (BLOCKS(self, other, name, chosen) or other.unfinished)


def forgets_deadlines(self, *arguments):
    INIT(self, *arguments)
    self.mechanisms.contracts = {
        name: msgspec.structs.replace(contract, deadline_s=math.inf)
        for name, contract in self.mechanisms.contracts.items()}


def cuts_off(self, track, chosen, number, now):
    """Releases at once what is in the middle of its action."""
    track = msgspec.structs.replace(track, acknowledged=True, phase=RecoveryPhase.DONE)
    return RELEASE(self, track, chosen, number, now)


def two(*names: str, with_modules: bool = False, deaths: bool = True) -> Transitions:
    contracts = ARRANGEMENT.mechanisms.contracts
    asked = [frozenset(part) for n in range(2) for part in combinations(names, n)]
    return Transitions([contracts[n] for n in names], ARRANGEMENT.order, asked, ["RM1"],
                       exclusive=True, with_modules=with_modules, deaths=deaths)


PAIR = ("RM2", "RM5")


@pytest.mark.parametrize(("mutant", "names", "name", "trace"), [
    ({"_blocks": forgets_releases}, PAIR, "no-conflicting-claims", (
        "asked for: RM2", "asked for: RM5", "RM2 reports done",
        "RM2 and RM5 may both hold what they claim")),
    ({"_blocks": lambda *_: False}, PAIR, "no-conflicting-claims", ()),
    ({"_blocks": makes_all_wait}, ("RM1", "RM2"), "emergency-stop-at-once", (
        "asked for: RM2", "asked for: RM1", "RM1 was decided on and has to wait")),
    ({"__init__": forgets_deadlines}, PAIR, "recovery-ends", ()),
    ({"_release": cuts_off}, ("RM3",), "none-cut-off", (
        "asked for: RM3", "RM3 obeys", "asked for: nothing", "RM3 is released half-way")),
    ({"_release": lambda _self, track, *_: track}, PAIR, "one-decision", ())])
def test_a_broken_arbiter_is_found_out_by_the_shortest_trace(
        monkeypatch, mutant, names, name, trace):
    one = len(names) == 1
    assert name not in explore(two(*names, with_modules=one, deaths=not one))[1]
    for method, function in mutant.items():
        monkeypatch.setattr(Arbiter, method, function)
    _, found = explore(two(*names, with_modules=one, deaths=not one))
    assert found[name][-len(trace):] == trace if trace else found[name]


def test_a_latch_is_explored_with_what_excuses_it_and_without():
    plain = ARRANGEMENT.mechanisms.contracts
    contracts = [msgspec.structs.replace(plain["RM1"], excused_by=frozenset({"DM5"})), plain["RM2"]]
    asked = [frozenset({"RM1"}), frozenset({"RM2"})]
    system = Transitions(contracts, ARRANGEMENT.order, asked, ["RM1"], exclusive=True)
    states, found = explore(system)
    assert found == {}
    assert states > explore(two("RM1", "RM2"))[0]
    stopped = dict(system.successors(system.initial()))["asked for: RM1"]
    assert stopped.state.latched == ("RM1",)
    excused = dict(system.successors(stopped))["an excuse is detected"]
    assert excused.state.latched == ()
    assert dict(system.successors(excused))["the excuse ends"].state.latched == ("RM1",)


class Mutant(SafetyFirst):
    """Safety-first, but for some sets."""

    name = "mutant"
    exclusive = False

    def __init__(self, answer) -> None:
        self.answer = answer

    def choose(self, active, arrangement, late):
        decision = super().choose(active, arrangement, late)
        taken = self.answer(decision)
        return decision if taken is None else msgspec.structs.replace(decision, recoveries=taken)


def found_in(strategy, arrangement=ARRANGEMENT) -> dict[str, tuple[str, ...]]:
    """The properties that fail, with the first counterexample of each."""
    return {p.name: p.counterexamples[0]
            for p in ActiveSets(arrangement, arrangement.order, strategy).check() if not p.holds}


@pytest.mark.parametrize(("active", "taken", "name", "trace"), [
    ("FTM3", ("RM2", "RM2"), "one-decision", (
        "FTM3 active: runs RM2 and RM2 (rule 1)",
        "this is not a set of known recoveries, each listed once")),
    ("FTM1", (), "one-decision", (
        "FTM1 active: runs nothing (rule 1)",
        "this is not a set of known recoveries, each listed once")),
    ("FTM2 FTM6", ("RM2", "RM5"), "no-conflicting-claims", (
        "FTM2 and FTM6 active: runs RM2 and RM5 (rule 4)", "RM2 and RM5 claim the same resource")),
    ("FTM1 FTM6", ("RM1", "RM5"), "no-harm", (
        "FTM1 and FTM6 active: runs RM1 and RM5 (rule 2)", "RM1 disables motion, which RM5 needs")),
    ("FTM2 FTM4", ("RM3",), "safe-enough", (
        "FTM2 and FTM4 active: runs RM3 (rule 2)",
        "FTM2 asks for RM2, and nothing that runs is as safe")),
    ("FTM1 FTM2", ("RM2",), "emergency-stop-at-once", (
        "FTM1 and FTM2 active: runs RM2 (rule 2)",
        "FTM1 asks for RM1, the last resort, and it is not run"))])
def test_a_broken_strategy_is_found_out(active, taken, name, trace):
    strategy = Mutant(lambda d: taken if d.active == tuple(active.split()) else None)
    assert found_in(strategy)[name] == trace
    strategy.exclusive = True
    assert len(set(taken)) < 2 or found_in(strategy)["one-decision"][-1] == (
        "an exclusive strategy must run exactly one")


def test_a_strategy_that_changes_its_mind_is_found_out():
    asked = []

    def moody(decision: Decision):
        asked.append(decision)
        return ("RM1",) if len(asked) > 127 else None

    assert found_in(Mutant(moody))["one-decision"][-1] == "the same question gets another answer"
    sets = ActiveSets(ARRANGEMENT, ARRANGEMENT.order, Mutant(lambda _decision: ("RM9",)))
    assert next(sets.check()).count == 127, "there is no such recovery"


def test_an_escalation_that_never_reaches_the_root_is_found_out(monkeypatch):
    def named_only(recovery, sakes, failures, arrangement):
        following = arrangement.mechanisms.contracts[recovery].escalate_to
        return [recovery, *(named_only(following, sakes, failures, arrangement)
                            if following else [])]

    assert "escalation-ends" not in found_in(SafetyFirst())
    monkeypatch.setattr(active_sets, "succession", named_only)
    assert found_in(SafetyFirst())["escalation-ends"] == (
        "FTM5 active: runs RM4 (rule 1)",
        "if all fail: RM4, and the last resort is never tried")


def test_a_strategy_that_never_repairs_is_found_out():
    class OnlyGuards(GuardedRepair):
        def choose(self, active, arrangement, late):
            decision = super().choose(active, arrangement, late)
            return msgspec.structs.replace(decision, recoveries=decision.recoveries[:1])

    assert "repairs-run" not in found_in(GuardedRepair())
    assert found_in(OnlyGuards())["repairs-run"][-1] == (
        "RM3 never runs, so FTM4 stays active forever")


def test_millions_of_cases_go_when_they_are_checked_and_not_when_the_process_ends():
    gc.disable()
    try:
        sets = ActiveSets(ARRANGEMENT, ARRANGEMENT.order, STRATEGIES["safety-first"])
        list(sets.check())
        alive = weakref.ref(sets)
        del sets
        assert alive() is None
    finally:
        gc.enable()


def test_an_order_that_contradicts_the_tree_is_found_out():
    upside_down = PartialOrder(ARRANGEMENT.order.names, {"RM3": ["RM2"]})
    verdict = order_agrees_with_tree(ARRANGEMENT, upside_down)
    assert not verdict.holds
    assert verdict.counterexamples[0] == (
        "FTM2 is above FTM4 in the FTMTree, but RM3 of FTM4 is safer than RM2 of FTM2",)
    assert order_agrees_with_tree(ARRANGEMENT, ARRANGEMENT.order).holds


def test_nonsense_is_refused_in_one_line(refused, monkeypatch):
    assert "unknown strategy 'bold'; known: guarded-re" in refused("verify", "--strategy", "bold")
    first, *others = SPEC.mechanisms
    large = msgspec.structs.replace(SPEC, mechanisms=(first, *others, *(
        msgspec.structs.replace(first, name=f"FTM{i}") for i in range(8, 18))))
    monkeypatch.setattr("rampart.cli.systems.load", lambda _name: large)
    assert "at most 16 mechanisms can be verified" in refused("verify")


def test_the_command_prints_json_of_the_promised_shape(capsys, monkeypatch):
    monkeypatch.setattr(decide_verbs, "verify", lambda *asked, **_: verify(*asked, 1))
    assert main(["verify", "paper", "--strategy", "guarded-repair", "--strict", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["permissiveness"] == {"guarded-repair": 88}
    assert told["stuck_behind_last_resort"] == {"guarded-repair": 0}
    assert told["states"] > 100
    for row in told["properties"]:
        assert {"name", "strategy", "holds", "count", "counterexamples"} <= row.keys()
        assert row["holds"]


def test_the_command_prints_a_table_and_the_traces_of_the_system_s_strategy(
        report, capsys, monkeypatch):
    monkeypatch.setattr(decide_verbs, "verify", lambda *_, **__: report)
    assert main(["verify", "paper", "--strict"]) == 1
    told = capsys.readouterr().out
    for words in ("127 active sets, ", "FAILS in 32", "90 of 127", "66 of 127",
                  "  2. RM3 never runs, so FTM4 stays active forever",
                  "mission-first and simultaneous: --strategy NAME", "fails under safety-first"):
        assert words in told
    assert "fails under mission-first" not in told
    assert main(["verify", "paper", *(f"--strategy={name}" for name in STRATEGIES)]) == 0
    told = capsys.readouterr().out
    assert "fails under mission-first" in told
    assert "--strategy NAME" not in told


# -- the table of all ordered pairs is what the running manager does


SOON_S = 0.05


async def become(system: Managed, *mechanisms: str) -> tuple[str, ...]:
    """Make exactly these mechanisms active; return the recoveries that are in force then."""
    spec = system.run.system
    system.detect(*(cause for name in mechanisms for cause in causes_of(spec, name)))
    await asyncio.sleep(SOON_S)
    return tuple(r.name for r in spec.recoveries if system.actors[r.name].activated)


async def played(system: Managed, first: str, second: str) -> Pair:
    found = []
    for remaining in (second, first):
        await become(system, first)
        both = await become(system, first, second)
        found += [await become(system, remaining), await become(system)]
        for latched in system.status.latched:
            await system.reset(latched)
        assert await become(system) == ()
    return Pair(first, second, both, found[0], found[2], found[1])


@pytest.mark.parametrize("system", [full_system, paper])
def test_the_running_manager_does_what_the_table_lists_for_each_ordered_pair(system):
    spec = system()
    timing = msgspec.structs.replace(spec.timing, release_hold_s=0.0, release_hold_max_s=0.0)
    spec = msgspec.structs.replace(spec, timing=timing)
    table = pairs(spec)
    count = len(spec.mechanisms)
    assert len(table) == count * (count - 1)

    async def scenario() -> None:
        async with Managed(spec) as managed:
            for pair in table:
                assert await played(managed, pair.first, pair.second) == pair

    run(scenario)


def test_the_page_has_what_the_command_prints(capsys):
    assert main(["explain", "--pairs"]) == 0
    page = (ROOT / "docs/case-study/pairs.md").read_text(encoding="utf-8")
    assert f"```\n{capsys.readouterr().out}```\n" in page, (
        "make it anew: `rampart explain --pairs`")


def test_the_rows_as_json(capsys):
    assert main(["explain", "paper", "--pairs", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 42
    assert {"first": "FTM4", "second": "FTM6", "both": ["RM5"], "first_clears": ["RM5"],
            "second_clears": ["RM3"], "both_clear": []} in rows


def test_a_mechanism_with_a_gate_is_made_active_by_the_fewest_modules():
    spec = msgspec.structs.replace(paper(), mechanisms=tuple(
        msgspec.structs.replace(each, detect="(DM1 and DM3) or (DM2 and DM3 and DM6)")
        if each.name == "FTM1" else each for each in paper().mechanisms))
    assert causes_of(spec, "FTM1") == ("DM1", "DM3")
