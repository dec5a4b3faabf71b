"""What verification finds about the shipped system, and that it finds what is broken on purpose."""

import json
import math
from collections import defaultdict
from itertools import combinations

import msgspec
import pytest

from rampart.cli.main import main
from rampart.manager.analysis import active_sets, transitions
from rampart.manager.analysis.active_sets import ActiveSets, order_agrees_with_tree
from rampart.manager.analysis.transitions import Transitions, explore
from rampart.manager.analysis.verification import MEANING, Report, TooLargeError, _askable, verify
from rampart.manager.arbitration.arbiter import Arbiter
from rampart.manager.model.mechanisms import RecoveryPhase
from rampart.manager.model.order import PartialOrder
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision
from rampart.manager.strategies.guarded_repair import GuardedRepair
from rampart.manager.strategies.registry import STRATEGIES, UnknownStrategyError
from rampart.manager.strategies.safety_first import SafetyFirst
from tests.manager.bench import Bench, edited, paper

SPEC = paper()
ARRANGEMENT = Arrangement(SPEC.build_mechanisms(), SPEC.build_ftm_tree(), SPEC.build_order())


@pytest.fixture(scope="module")
def report() -> Report:
    return verify(SPEC)


def failing(report: Report) -> dict[tuple[str, str], int]:
    return {(p.strategy, p.name): p.count for p in report.properties if not p.holds}


# ---- the shipped system -----------------------------------------------------------------------


def test_every_property_is_checked_for_every_strategy(report):
    checked = {(p.name, p.strategy) for p in report.properties}
    assert len(checked) == len(report.properties)
    assert checked == {("order-agrees-with-tree", "")} | {
        (name, strategy) for name in MEANING if name != "order-agrees-with-tree"
        for strategy in STRATEGIES}
    assert report.active_sets == 127
    assert report.states > 5000
    assert all(p.cases >= 6 for p in report.properties)


def test_exactly_these_properties_fail_on_the_papers_system(report):
    assert failing(report) == {
        ("safety-first", "monotone"): 2,
        ("safety-first", "repairs-run"): 32,
        ("mission-first", "safe-enough"): 178,
        ("mission-first", "monotone"): 70,
        ("mission-first", "repairs-run"): 240,
        ("simultaneous", "repairs-run"): 28,
    }


def test_guarded_repair_holds_everything(report):
    assert all(p.holds for p in report.properties if p.strategy == "guarded-repair")


def test_in_how_many_sets_the_robot_stops_for_good(report):
    assert report.permissiveness == {"safety-first": 90, "mission-first": 64,
                                     "simultaneous": 88, "guarded-repair": 88}


def test_repairs_that_starve_behind_the_last_resort_are_counted_apart(report):
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


def test_what_holds_has_no_counterexample_and_what_fails_has_the_shortest_first(report):
    for checked in report.properties:
        assert checked.holds == (checked.count == 0) == (not checked.counterexamples)
        assert len(checked.counterexamples) == min(checked.count, 3)
        sizes = [trace[0].split(" active")[0].count("FTM") for trace in checked.counterexamples]
        assert sizes == sorted(sizes)
        assert all(line and "\n" not in line for t in checked.counterexamples for line in t)


@pytest.mark.parametrize(("name", "trace"), [
    ("monotone", (
        "FTM4 and FTM7 active: runs RM1 (rule 4)",
        "FTM2, FTM4 and FTM7 active: runs RM2 (rule 3)",
        "with FTM2 active as well, RM2 runs instead of RM1, which is safer")),
    ("repairs-run", (
        "FTM2 and FTM4 active: runs RM2 (rule 2)",
        "RM3 never runs, so FTM4 stays active for ever")),
])
def test_the_counterexamples_of_safety_first_can_be_read(report, name, trace):
    found = next(p for p in report.properties
                 if (p.name, p.strategy) == (name, "safety-first"))
    assert found.counterexamples[0] == trace


# ---- a system of three recoveries, small enough to explore as a whole -------------------------


def three():
    """FTM1(RM1) above FTM2(RM2) above FTM4(RM3)."""
    return msgspec.structs.replace(
        SPEC, mechanisms=tuple(m for m in SPEC.mechanisms if m.name in {"FTM1", "FTM2", "FTM4"}),
        recoveries=tuple(r for r in SPEC.recoveries if r.name in {"RM1", "RM2", "RM3"}),
        orders={"safer": {"RM1": ("RM2",), "RM2": ("RM3",)}})


def test_two_recoveries_at_a_time_and_all_together_lead_to_the_same_verdicts():
    by_pairs, whole = (verify(three(), ["safety-first"], together) for together in (2, 3))
    assert whole.states > 3 * by_pairs.states / 2
    assert {(p.name, p.holds) for p in by_pairs.properties} == {
        (p.name, p.holds) for p in whole.properties}


def test_every_alternative_and_every_number_of_failures_is_explored():
    """RM5 is asked for when two alternatives before it fail, RM6 when all four fail."""
    first, _, _, crash, *_ = SPEC.mechanisms
    replace = msgspec.structs.replace
    recoveries = [replace(r, escalate_to="RM6" if r.name == "RM3" else "") for r in SPEC.recoveries]
    spec = replace(
        SPEC, recoveries=(*recoveries, replace(recoveries[1], name="RM6")),
        mechanisms=(first, replace(crash, recover="RM3 or RM4 or RM5 or RM2")),
        orders={"safer": {"RM1": tuple(f"RM{i}" for i in range(2, 7))}})
    arrangement = Arrangement(spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order())
    sets = ActiveSets(arrangement, arrangement.order, SafetyFirst())
    assert _askable(sets) == {frozenset({f"RM{i}"}) for i in range(1, 7)}


def test_the_start_of_a_manager_is_not_explored_and_holds_less():
    """If this fails, the limits in docs/explanation/arbitration.md can be narrowed."""
    bench = Bench(oriented=False)
    bench.active("DM6")
    bench.report("RM2", RecoveryPhase.DEGRADED, 41)  # ordered by the manager before this one
    assert bench.orders == "RM2 (RM5)"
    assert bench.arbiter.mechanisms.overlap("RM2", "RM5")
    assert not bench.state.oriented
    start = two("RM2", "RM5").initial().state
    assert start.oriented
    assert not any(track.adopted for track in start.recoveries)


# ---- broken arbiters --------------------------------------------------------------------------


class ForgetsReleases(Arbiter):
    """Takes a release for done when it is sent: the rule before this verification was written."""

    def _blocks(self, other, name, chosen):
        return super()._blocks(msgspec.structs.replace(other, letting_go=False), name, chosen)


class ForgetsClaims(Arbiter):
    """Lets nobody wait."""

    def _blocks(self, other, name, chosen):
        return False


class MakesAllWait(Arbiter):
    """Lets everybody wait for whatever is at work, the last resort included."""

    def _blocks(self, other, name, chosen):
        return other.name != name and (super()._blocks(other, name, chosen) or other.unfinished)


class ForgetsDeadlines(Arbiter):
    """Waits for ever."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.mechanisms.contracts = {
            name: msgspec.structs.replace(contract, deadline_s=math.inf)
            for name, contract in self.mechanisms.contracts.items()}


class CutsOff(Arbiter):
    """Releases at once what is in the middle of its action."""

    def _release(self, track, chosen, number, now):
        return super()._release(msgspec.structs.replace(
            track, acknowledged=True, phase=RecoveryPhase.DONE), chosen, number, now)


class NeverReleases(Arbiter):
    """Keeps under orders whatever was started."""

    def _release(self, track, chosen, number, now):
        return track


@pytest.mark.parametrize(("mutant", "properties"), [
    (Arbiter, set()),
    (ForgetsReleases, {"no-conflicting-claims"}),
    (ForgetsClaims, {"no-conflicting-claims"}),
    (MakesAllWait, {"emergency-stop-at-once"}),
    (ForgetsDeadlines, {"recovery-ends"}),
    (CutsOff, {"none-cut-off"}),
    (NeverReleases, {"one-decision"}),
])
def test_a_broken_arbiter_is_found_out(monkeypatch, mutant, properties):
    monkeypatch.setattr(transitions, "Arbiter", mutant)
    found = {p.name for p in verify(SPEC, ["safety-first"]).properties if not p.holds}
    assert properties <= found - {"monotone", "repairs-run"}
    if not properties:
        assert found == {"monotone", "repairs-run"}


def two(*names: str, with_modules: bool = False, deaths: bool = True) -> Transitions:
    contracts = ARRANGEMENT.mechanisms.contracts
    asked = [frozenset(part) for n in range(2) for part in combinations(names, n)]
    return Transitions([contracts[n] for n in names], ARRANGEMENT.order, asked, ["RM1"],
                       exclusive=True, with_modules=with_modules, deaths=deaths)


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
    excused = dict(system.successors(stopped))["what excuses is found"]
    assert excused.state.latched == ()
    assert dict(system.successors(excused))["the excuse ends"].state.latched == ("RM1",)


def test_a_release_that_is_forgotten_has_the_shortest_trace(monkeypatch):
    monkeypatch.setattr(transitions, "Arbiter", ForgetsReleases)
    _, found = explore(two("RM2", "RM5"))
    assert found["no-conflicting-claims"] == (
        "asked for: RM2", "asked for: RM5", "RM2 reports done",
        "RM2 and RM5 may both hold what they claim")


def test_a_recovery_that_is_cut_off_has_the_shortest_trace(monkeypatch):
    monkeypatch.setattr(transitions, "Arbiter", CutsOff)
    _, found = explore(two("RM3", with_modules=True, deaths=False))
    assert found["none-cut-off"] == (
        "asked for: RM3", "RM3 obeys", "asked for: nothing", "RM3 is released half-way")


def test_an_emergency_stop_that_waits_has_the_shortest_trace(monkeypatch):
    monkeypatch.setattr(transitions, "Arbiter", MakesAllWait)
    _, found = explore(two("RM1", "RM2"))
    assert found["emergency-stop-at-once"] == (
        "asked for: RM2", "asked for: RM1", "RM1 was decided on and has to wait")


def test_the_decomposition_finds_the_same_in_a_broken_arbiter_as_the_whole(monkeypatch):
    for mutant in (CutsOff, MakesAllWait):
        monkeypatch.setattr(transitions, "Arbiter", mutant)
        verdicts = [{(p.name, p.holds) for p in verify(
            three(), ["safety-first"], together).properties} for together in (2, 3)]
        assert verdicts[0] == verdicts[1]


# ---- broken strategies ------------------------------------------------------------------------


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


def test_a_strategy_that_takes_nothing_is_found_out():
    found = found_in(Mutant(lambda d: ()))
    assert found["one-decision"] == (
        "FTM1 active: runs nothing (rule 1)", "that is not a set of known recoveries, each once")
    assert {"safe-enough", "emergency-stop-at-once", "repairs-run"} <= found.keys()


def test_a_strategy_that_takes_what_there_is_not_or_one_twice_is_found_out():
    for taken in (("RM9",), ("RM2", "RM2")):
        answers = defaultdict(lambda: None, {("FTM3",): taken})
        strategy = Mutant(lambda d, answers=answers: answers[d.active])
        verdict = next(ActiveSets(ARRANGEMENT, ARRANGEMENT.order, strategy).check())
        assert (verdict.name, verdict.count) == ("one-decision", 1)


def test_a_strategy_that_changes_its_mind_is_found_out():
    asked = []

    def moody(decision: Decision):
        asked.append(decision)
        return ("RM1",) if len(asked) > 127 else None

    assert found_in(Mutant(moody))["one-decision"][-1] == "asked again, it decides otherwise"


def test_an_exclusive_strategy_that_takes_two_is_found_out():
    strategy = Mutant(lambda d: ("RM3", "RM4") if d.active == ("FTM4", "FTM5") else None)
    strategy.exclusive = True
    assert found_in(strategy)["one-decision"][-1] == (
        "a strategy that runs one at a time has to take one")


def test_a_strategy_that_runs_recoveries_in_conflict_is_found_out():
    found = found_in(Mutant(lambda d: ("RM2", "RM5") if d.active == ("FTM2", "FTM6") else None))
    assert found["no-conflicting-claims"] == (
        "FTM2 and FTM6 active: runs RM2 and RM5 (rule 4)", "RM2 and RM5 claim the same resource")


def test_a_strategy_that_disables_what_it_needs_is_found_out():
    found = found_in(Mutant(lambda d: ("RM1", "RM5") if d.active == ("FTM1", "FTM6") else None))
    assert found["no-harm"] == ("FTM1 and FTM6 active: runs RM1 and RM5 (rule 2)",
                                "RM1 disables motion, which RM5 needs")


def test_a_recovery_that_disables_what_it_needs_itself_is_found_out():
    spec = edited(RM5={"disables": frozenset({"motion"})})
    arrangement = Arrangement(spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order())
    assert found_in(SafetyFirst(), arrangement)["no-harm"] == (
        "FTM6 active: runs RM5 (rule 1)", "RM5 disables motion, which RM5 needs")


def test_a_strategy_that_does_less_than_is_asked_for_is_found_out():
    found = found_in(Mutant(lambda d: ("RM3",) if d.active == ("FTM2", "FTM4") else None))
    assert found["safe-enough"] == (
        "FTM2 and FTM4 active: runs RM3 (rule 2)",
        "FTM2 asks for RM2, and nothing that runs is as safe")


def test_a_strategy_that_keeps_the_last_resort_waiting_is_found_out():
    found = found_in(Mutant(lambda d: ("RM2",) if d.active == ("FTM1", "FTM2") else None))
    assert found["emergency-stop-at-once"] == (
        "FTM1 and FTM2 active: runs RM2 (rule 2)",
        "FTM1 asks for RM1, the last resort, and it is not run")


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
        "RM3 never runs, so FTM4 stays active for ever")


def test_an_order_that_contradicts_the_tree_is_found_out():
    upside_down = PartialOrder(ARRANGEMENT.order.names, {"RM3": ["RM2"]})
    verdict = order_agrees_with_tree(ARRANGEMENT, upside_down)
    assert not verdict.holds
    assert verdict.counterexamples[0] == (
        "FTM2 is above FTM4 in the FTMTree, but RM3 of FTM4 is safer than RM2 of FTM2",)
    assert order_agrees_with_tree(ARRANGEMENT, ARRANGEMENT.order).holds


# ---- limits, and the command ------------------------------------------------------------------


def large(count: int):
    first, *others = SPEC.mechanisms
    return msgspec.structs.replace(SPEC, mechanisms=(first, *others, *(
        msgspec.structs.replace(first, name=f"FTM{i}") for i in range(8, count + 1))))


def test_a_system_too_large_to_look_at_every_set_is_refused():
    with pytest.raises(TooLargeError) as caught:
        verify(large(17))
    assert str(caught.value) == ("paper: 17 mechanisms have 131071 active sets; at most 16 "
                                 "mechanisms can be verified exhaustively")


def test_an_unknown_strategy_is_refused():
    with pytest.raises(UnknownStrategyError, match="unknown strategy 'bold'; known: guarded"):
        verify(SPEC, ["bold"])


def refused(capsys, *arguments: str) -> str:
    assert main(["verify", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_the_command_refuses_nonsense_in_one_line(capsys, monkeypatch):
    assert "unknown strategy 'bold'; known: guarded-repair" in refused(
        capsys, "--strategy", "bold")
    assert "--together 0: a number from 1 up is right" in refused(capsys, "--together", "0")
    monkeypatch.setattr("rampart.cli.systems.load", lambda name: large(17))
    assert "at most 16 mechanisms can be verified" in refused(capsys)


def test_the_command_prints_json_of_the_promised_shape(capsys):
    assert main(["verify", "paper", "--strategy", "safety-first", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"states", "permissiveness", "stuck_behind_last_resort", "properties"} <= told.keys()
    assert told["permissiveness"] == {"safety-first": 90}
    assert told["stuck_behind_last_resort"] == {"safety-first": 66}
    assert told["states"] > 1000
    for row in told["properties"]:
        assert {"name", "strategy", "holds", "count", "counterexamples"} <= row.keys()
    assert {row["name"] for row in told["properties"] if not row["holds"]} == {
        "monotone", "repairs-run"}


@pytest.mark.parametrize(("strategy", "code"), [("safety-first", 1), ("guarded-repair", 0)])
def test_strict_the_exit_code_tells_whether_all_holds(capsys, strategy, code):
    assert main(["verify", "paper", "--strategy", strategy, "--strict"]) == code


def test_the_command_prints_a_table_the_states_and_the_traces(capsys):
    assert main(["verify", "paper", "--strategy", "safety-first"]) == 0
    told = capsys.readouterr().out
    assert "active sets in which a repair" in told
    assert "\\u000a" not in told
    assert "127 active sets, " in told
    assert "FAILS in 32" in told
    assert "90 of 127" in told
    assert "66 of 127" in told
    assert "not explored: the start of a manager" in told
    assert "  2. RM3 never runs, so FTM4 stays active for ever" in told
