"""Strategies that run several recoveries, on the real arbiter, as timelines."""

import msgspec
import pytest

from rampart.manager.arbitration.arbiter_state import ShadowDiffered
from rampart.manager.model.mechanisms import RecoveryPhase as Phase
from tests.manager.bench import Bench, commands, paper

ACTING, DONE, IDLE, FAILED = Phase.ACTING, Phase.DONE, Phase.IDLE, Phase.FAILED


def system(*, mechanisms=None, recoveries=None, **fields):
    """The shipped system with another strategy, other gates, other contracts."""
    def edit(tables, changes):
        return tuple(msgspec.structs.replace(t, **(changes or {}).get(t.name, {}))
                     for t in tables)

    spec = paper()
    return msgspec.structs.replace(
        spec, mechanisms=edit(spec.mechanisms, mechanisms),
        recoveries=edit(spec.recoveries, recoveries), **fields)


def guarded(**changes) -> Bench:
    return Bench(system(strategy="guarded-repair", **changes))


def work(bench: Bench, *names: str) -> None:
    """They obey, and come to an end."""
    for phase in (ACTING, DONE):
        for name in names:
            bench.report(name, phase)


# ---- guarded-repair ---------------------------------------------------------------------------


def test_a_guarded_repair_walks_out_of_the_trap():
    """DM2, then DM4: RM2 guards while RM3 repairs; both causes go, both are released."""
    bench = guarded()
    assert commands(bench.active("DM2")) == [("RM2", True)]
    assert commands(bench.active("DM4", "osmosis_control")) == [("RM3", True)]
    assert bench.orders == "RM2 RM3"
    work(bench, "RM2", "RM3")
    assert bench.orders == "RM2 RM3"
    assert commands(bench.idle("DM4")) == [("RM3", False)]
    assert bench.orders == "RM2"
    assert commands(bench.idle("DM2")) == []  # held for a while, against flapping
    assert commands(bench.wait(1.0)) == [("RM2", False)]
    assert bench.orders == ""


def test_a_guard_joins_a_repair_that_is_at_work():
    bench = guarded()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.active("DM2")) == [("RM2", True)]
    assert bench.orders == "RM2 RM3"  # not draining: it is wanted


def test_two_crashes_at_once_are_repaired_under_a_controlled_stop():
    bench = guarded()
    bench.active("DM4", "osmosis_control")
    assert commands(bench.active("DM7", "localization")) == [("RM2", True), ("RM4", True)]
    assert bench.orders == "RM2 RM3 RM4"
    assert bench.state.latched == ()
    work(bench, "RM2", "RM3", "RM4")
    assert commands(bench.idle("DM4")) == [("RM2", False), ("RM3", False)]
    assert commands(bench.idle("DM7")) == [("RM4", False)]


def test_repairs_run_beneath_an_emergency_stop():
    bench = guarded()
    bench.active("DM1")
    bench.active("DM4", "osmosis_control")
    assert bench.orders == "RM1 RM3"
    work(bench, "RM1", "RM3")
    bench.idle("DM4")
    assert bench.orders == "RM1"


def test_repairs_run_beneath_a_stop_that_is_only_latched():
    """The cause of RM1 is gone, nobody has reset it: that is no reason to leave nodes dead."""
    bench = guarded()
    bench.active("DM1")
    work(bench, "RM1")
    bench.idle("DM1")
    bench.wait(1.0)
    assert bench.orders == "RM1"
    assert commands(bench.active("DM7", "localization")) == [("RM4", True)]
    work(bench, "RM4")
    assert commands(bench.idle("DM7")) == [("RM4", False)]
    assert commands(bench.active("DM2")) == []  # a stop that is less safe does wait
    assert ("RM2", "RM1 is latched until reset") in bench.decisions[-1].decision.rejected
    assert bench.reset("RM1").granted
    assert bench.orders == "RM2"


def test_a_repair_that_claims_what_the_guard_claims_waits():
    bench = guarded(recoveries={"RM3": {"claims": frozenset({"actuation"})}})
    bench.active("DM2")
    work(bench, "RM2")
    assert commands(bench.active("DM4", "osmosis_control")) == []
    assert bench.orders == "RM2"
    assert ("RM3", "waits, another recovery claims the same") \
        in bench.decisions[-1].decision.rejected


def test_a_repair_that_fails_beneath_its_guard_leaves_the_guard():
    bench = guarded()
    bench.active("DM2")
    bench.active("DM4", "osmosis_control")
    work(bench, "RM2")
    bench.report("RM3", ACTING)
    assert commands(bench.report("RM3", FAILED)) == [("RM3", False)]  # it escalates to RM2
    assert bench.orders == "RM2"
    assert any(name == "RM3" and why.endswith("escalated to RM2")
               for name, why in bench.decisions[-1].decision.rejected)


def test_a_guard_that_fails_gives_way_to_a_safer_one_and_the_repair_goes_on():
    bench = guarded()
    bench.active("DM2")
    bench.active("DM4", "osmosis_control")
    bench.report("RM2", ACTING)
    bench.report("RM3", ACTING)
    assert commands(bench.report("RM2", FAILED)) == [("RM2", False), ("RM1", True)]
    assert bench.orders == "RM1 RM3"


def test_a_guard_of_nobodys_own_escalates_to_the_common_dominant():
    """For {FTM4, FTM7} the guard is RM2, which neither they nor FTM1 above them have."""
    bench = guarded(recoveries={"RM2": {"escalate_to": ""}})
    bench.active("DM4", "osmosis_control")
    bench.active("DM7", "localization")
    bench.report("RM2", ACTING)
    assert commands(bench.report("RM2", FAILED)) == [("RM2", False), ("RM1", True)]
    assert bench.orders == "RM1 RM3 RM4"


# ---- simultaneous -----------------------------------------------------------------------------


def test_independent_repairs_run_at_the_same_time():
    bench = Bench(system(strategy="simultaneous"))
    bench.active("DM4", "osmosis_control")
    assert commands(bench.active("DM5", "hmi")) == [("RM4", True)]
    assert bench.orders == "RM3 RM4"
    work(bench, "RM3", "RM4")
    assert commands(bench.idle("DM5")) == [("RM4", False)]
    assert bench.orders == "RM3"


def test_stops_in_conflict_give_way_to_their_common_dominant():
    bench = Bench(system(strategy="simultaneous"))
    bench.active("DM2")
    work(bench, "RM2")
    assert commands(bench.active("DM6")) == [("RM2", False), ("RM1", True)]
    assert bench.decisions[-1].decision.rule == 3


def test_what_is_no_longer_maximal_drains_beside_the_safer_one():
    bench = Bench(system(strategy="simultaneous"))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.active("DM2")) == [("RM2", True)]
    assert bench.orders == "RM2 (RM3)"
    assert commands(bench.report("RM3", DONE)) == [("RM3", False)]


# ---- mission-first ----------------------------------------------------------------------------


def test_mission_first_climbs_when_the_respawn_has_used_up_its_patience():
    bench = Bench(system(strategy="mission-first"))
    patience_s = bench.arbiter.mechanisms.by_name["FTM4"].patience_s
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.wait(patience_s - 0.05)) == []
    assert bench.state.late == frozenset()
    assert commands(bench.wait(0.15)) == [("RM2", True)]
    assert bench.state.late == {"FTM4"}
    assert bench.orders == "RM2 (RM3)"
    work(bench, "RM2")
    bench.report("RM3", DONE)
    bench.idle("DM4")
    bench.wait(1.0)
    assert bench.orders == ""
    assert bench.state.late == frozenset()


def test_mission_first_forgets_that_a_mechanism_was_late():
    bench = Bench(system(strategy="mission-first"))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.wait(1.0)
    work(bench, "RM2", "RM3")
    bench.idle("DM4")
    bench.wait(1.0)
    bench.report("RM2", IDLE)
    bench.report("RM3", IDLE)
    assert commands(bench.active("DM4", "osmosis_control")) == [("RM3", True)]
    assert bench.orders == "RM3"


def test_mission_first_climbs_no_further_when_the_stop_is_in_force():
    bench = Bench(system(strategy="mission-first"))
    bench.active("DM2")
    work(bench, "RM2")
    bench.wait(30.0)
    assert bench.orders == "RM2"


def test_mission_first_climbs_to_the_top_when_nothing_helps():
    bench = Bench(system(strategy="mission-first"))
    bench.active("DM2")
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.wait(10.0)
    assert "RM1" in bench.orders.split()
    assert bench.state.latched == ("RM1",)


def test_mission_first_lets_a_repair_go_before_the_stop_above_it():
    bench = Bench(system(strategy="mission-first"))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.active("DM2")) == []  # the cause is being dealt with
    assert bench.orders == "RM3"
    assert "FTM4 is deeper and comes first" in dict(bench.decisions[-1].decision.rejected)["RM2"]


def test_mission_first_stops_at_once_at_the_root():
    bench = Bench(system(strategy="mission-first"))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.active("DM1")) == [("RM1", True)]


# ---- compound mechanisms ----------------------------------------------------------------------


BOTH = {"FTM7": {"recover": "RM2 and RM4"}}


@pytest.mark.parametrize("strategy", ["safety-first", "simultaneous", "mission-first",
                                      "guarded-repair"])
def test_a_compound_recovery_runs_all_its_parts(strategy):
    bench = Bench(system(strategy=strategy, mechanisms=BOTH))
    assert set(commands(bench.active("DM7", "localization"))) == {("RM2", True), ("RM4", True)}
    assert bench.orders == "RM2 RM4"
    work(bench, "RM2", "RM4")
    bench.idle("DM7")
    bench.wait(1.0)
    assert bench.orders == ""


def test_a_mechanism_with_a_gate_needs_both_its_detections():
    bench = Bench(system(mechanisms={"FTM6": {"detect": "DM6 and DM7"}}))
    assert commands(bench.active("DM6")) == []
    assert bench.orders == ""
    bench.active("DM7", "localization")
    assert bench.state.active == ("FTM6", "FTM7")
    assert bench.orders == "RM5"


def test_a_silent_module_does_not_vouch_that_all_is_well():
    """FTM6 on `DM6 and not DM7`: DM7 active rules it out, DM7 silent does not."""
    gate = {"FTM6": {"detect": "DM6 and not DM7"}}
    bench = Bench(system(mechanisms=gate))
    bench.active("DM6")
    assert bench.state.active == ("FTM6",)
    bench.active("DM7", "localization")
    assert bench.state.active == ("FTM7",)
    bench = Bench(system(mechanisms=gate))
    bench.active("DM6")
    bench.wait(1.2, hearing=("DM1", "DM2", "DM3", "DM4", "DM5", "DM6"))
    assert bench.state.active == ("FTM6", "FTM7")


# ---- alternatives -----------------------------------------------------------------------------


EITHER = {"FTM7": {"recover": "RM4 or RM3"}}


def test_an_alternative_is_taken_when_the_first_has_failed():
    bench = Bench(system(mechanisms=EITHER))
    assert commands(bench.active("DM7", "localization")) == [("RM4", True)]
    bench.report("RM4", ACTING)
    assert commands(bench.report("RM4", FAILED)) == [("RM4", False), ("RM3", True)]
    assert any(name == "RM4" and why.endswith("escalated to RM3")
               for name, why in bench.decisions[-1].decision.rejected)
    work(bench, "RM3")
    bench.idle("DM7")
    assert commands(bench.wait(1.0)) == [("RM3", False)]
    assert commands(bench.active("DM7", "localization")) == [("RM4", True)]  # forgiven


def test_when_both_alternatives_have_failed_it_escalates_beyond_them():
    bench = Bench(system(mechanisms=EITHER))
    bench.active("DM7", "localization")
    for name in ("RM4", "RM3"):
        bench.report(name, ACTING)
        bench.report(name, FAILED)
    assert not {"RM3", "RM4"} & set(bench.orders.split())
    assert bench.orders in {"RM2", "RM5"}


def test_all_of_an_alternative_is_run_and_not_only_its_first_recovery():
    bench = Bench(system(mechanisms={"FTM2": {"recover": "RM2 or (RM3 and RM4)"}}))
    assert commands(bench.active("DM2")) == [("RM2", True)]
    bench.report("RM2", ACTING)
    assert sorted(commands(bench.report("RM2", FAILED))) == [
        ("RM2", False), ("RM3", True), ("RM4", True)]
    assert any(name == "RM2" and why.endswith("escalated to RM3")
               for name, why in bench.decisions[-1].decision.rejected)
    work(bench, "RM3", "RM4")
    bench.idle("DM2")
    assert sorted(commands(bench.wait(1.0))) == [("RM3", False), ("RM4", False)]


# ---- needs ------------------------------------------------------------------------------------


def test_a_recovery_whose_node_is_reported_failed_is_passed_over_and_comes_back():
    """RM2 needs the Safety Pilot: while DM5 reports that dead, RM1 stands in for it."""
    bench = Bench()
    bench.active("DM2")
    work(bench, "RM2")
    bench.active("DM5", "safety_pilot")
    work(bench, "RM1")
    assert "RM1" in bench.orders.split()
    assert any(name == "RM2" and "needs safety_pilot, which DM5 reports failed" in why
               for name, why in bench.decisions[-1].decision.rejected)
    bench.idle("DM5")
    bench.wait(1.0)
    assert bench.orders == "RM1"  # latched
    bench.report("RM2", IDLE)
    assert bench.reset("RM1").granted
    assert bench.orders == "RM2"


def test_a_node_that_is_not_needed_changes_nothing():
    bench = Bench()
    bench.active("DM2")
    bench.active("DM5", "hmi")
    assert bench.orders == "RM2"


def test_an_alternative_is_taken_when_what_the_first_needs_is_not_there():
    bench = Bench(system(mechanisms=EITHER, recoveries={"RM4": {"needs": frozenset({"hmi"})}}))
    bench.active("DM7", "localization")
    assert bench.orders == "RM4"
    bench = Bench(system(mechanisms=EITHER, recoveries={"RM4": {"needs": frozenset({"hmi"})}}))
    bench.active("DM7", "localization", "hmi")
    assert bench.orders == "RM3"


# ---- shadow -----------------------------------------------------------------------------------


def differences(outputs) -> list[ShadowDiffered]:
    return [o for o in outputs if isinstance(o, ShadowDiffered)]


def test_a_shadow_tells_where_it_would_have_run_something_else():
    bench = Bench(system(shadow="guarded-repair"))
    assert differences(bench.active("DM2")) == []
    work(bench, "RM2")
    (differed,) = differences(bench.active("DM4", "osmosis_control"))
    assert differed.strategy == "guarded-repair"
    assert differed.taken == ("RM2",)
    assert set(differed.decision.recoveries) == {"RM2", "RM3"}
    assert differed.number == bench.state.number
    bench.wait(5.0)
    assert len(differences(bench.log)) == 1  # once a decision
    assert bench.orders == "RM2"  # it does nothing itself


@pytest.mark.parametrize("strategy", ["safety-first", "guarded-repair"])
def test_a_shadow_that_agrees_is_silent(strategy):
    bench = Bench(system(strategy=strategy, shadow=strategy))
    for dm in ("DM2", "DM4", "DM7", "DM1"):
        bench.active(dm, "localization")
    assert differences(bench.log) == []


def test_a_patient_shadow_is_told_who_is_late():
    """Nothing new is decided, but the shadow would have climbed to RM2."""
    bench = Bench(system(shadow="mission-first", recoveries={"RM3": {"deadline_s": 60.0}}))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert differences(bench.log) == []
    (differed,) = differences(bench.wait(5.0))
    assert (differed.taken, differed.decision.recoveries) == (("RM3",), ("RM2",))
    assert bench.orders == "RM3"


def test_who_waited_for_a_deeper_one_has_its_whole_patience_when_its_turn_comes():
    """A respawn that succeeds must not end in the stop of the barrier two steps up."""
    bench = Bench(msgspec.structs.replace(paper(), strategy="mission-first"))
    bench.active("DM4", "osmosis_control")
    bench.active("DM2")
    bench.report("RM3", Phase.ACTING)
    bench.wait(0.3)
    bench.report("RM3", Phase.DONE)
    bench.idle("DM4")
    assert bench.orders == "RM2"
    bench.report("RM2", Phase.DEGRADED)
    bench.wait(0.3)
    assert bench.orders == "RM2"
    bench.idle("DM2")
    bench.wait(1.0)
    assert bench.orders == ""
