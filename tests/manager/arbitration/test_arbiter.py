"""The arbiter as timelines: what is reported, what is ordered, and when."""

import msgspec
import pytest

from rampart.manager.actor import forgive_absence
from rampart.manager.arbitration.arbiter_memory import Memory, recall, remember
from rampart.manager.arbitration.arbiter_state import Command, State, Tick
from rampart.manager.model.mechanisms import RecoveryPhase as Phase
from rampart.manager.spec.schema import SystemSpec
from tests.manager.bench import DMS, Bench, commands, edited

ACTING, DONE, IDLE, DEGRADED = Phase.ACTING, Phase.DONE, Phase.IDLE, Phase.DEGRADED


# ---- one recovery at a time -------------------------------------------------------------------


def test_a_crash_is_answered_by_a_respawn_and_control_handed_back():
    bench = Bench()
    out = bench.active("DM4", "osmosis_control")
    assert commands(out) == [("RM3", True)]
    assert out[0].nodes == ("osmosis_control",)
    assert "DM4 says so" in out[0].reason
    bench.report("RM3", ACTING)
    bench.report("RM3", DONE)
    assert commands(bench.idle("DM4")) == [("RM3", False)]  # a repair that is done needs no hold
    assert bench.orders == ""
    assert [d.decision.rule for d in bench.decisions] == [1, 0]


def test_a_stop_starts_at_once_while_the_respawn_drains():
    """DM4 active, RM3 acting; DM2 active: RM2 starts at once, RM3 is left to finish."""
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.active("DM2")) == [("RM2", True)]
    assert bench.orders == "RM2 (RM3)"
    bench.report("RM2", ACTING)
    bench.report("RM2", DONE)
    assert bench.orders == "RM2 (RM3)"
    assert commands(bench.report("RM3", DONE)) == [("RM3", False)]
    bench.idle("DM4")
    bench.idle("DM2")
    assert commands(bench.wait(1.0)) == [("RM2", False)]  # its success cleared both causes


def test_an_order_on_its_way_counts_as_acting():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.active("DM2")
    assert bench.orders == "RM2 (RM3)"
    bench.report("RM3", IDLE, decision=0)  # sent before the order arrived
    assert bench.orders == "RM2 (RM3)"
    bench.report("RM3", ACTING)
    assert commands(bench.report("RM3", DEGRADED)) == [("RM3", False)]


def test_a_draining_recovery_that_is_respawned_has_nothing_left_to_finish():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.active("DM2")
    assert commands(bench.report("RM3", IDLE, decision=0)) == [("RM3", False)]


def test_the_trap_of_safety_first_leaves_the_robot_standing_safely():
    """FTM2 dominates FTM4, so RM3 never runs, so neither cause ever clears. By the paper."""
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", ACTING)
    bench.report("RM2", DONE)
    bench.active("DM4", "osmosis_control")
    bench.wait(60.0)
    assert bench.orders == "RM2"
    assert not any(isinstance(o, Command) and o.recovery == "RM3" for o in bench.log)
    assert ("RM3", "FTM4 is dominated by FTM2") in bench.decisions[-1].decision.rejected


def test_what_claims_the_same_waits_until_the_other_has_finished():
    """RM2 and RM5 both claim the actuation and neither is safer."""
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", ACTING)
    bench.idle("DM2")
    bench.wait(0.4)
    bench.report("RM2", ACTING)
    bench.wait(0.2)
    assert bench.orders == "(RM2)"
    assert commands(bench.active("DM6")) == []
    assert bench.orders == "(RM2)"
    assert commands(bench.report("RM2", DONE)) == [("RM2", False)]
    assert commands(bench.report("RM2", Phase.IDLE)) == [("RM5", True)]


def test_who_lets_go_keeps_its_claim_until_it_says_so():
    """A release is a message: until it has arrived, RM2 still holds the robot."""
    bench = Bench()
    bench.active("DM2")
    ordered = bench.state.desired["RM2"].decision
    bench.report("RM2", DONE)
    bench.idle("DM2")
    bench.wait(0.6)
    assert bench.orders == ""
    bench.active("DM6")
    assert bench.orders == ""
    bench.report("RM2", DONE, ordered)  # sent before the release arrived
    bench.report("RM2", Phase.IDLE, ordered)  # its word from before the order: proves nothing
    assert bench.orders == ""
    bench.report("RM2", Phase.IDLE)
    assert bench.orders == "RM5"


def test_who_is_asked_to_let_go_and_was_respawned_is_told_again_at_once():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", DONE)
    bench.idle("DM2")
    bench.wait(0.6)
    assert commands(bench.report("RM2", Phase.IDLE, 0)) == [("RM2", False)]


def test_nobody_waits_longer_than_the_deadline_for_one_that_never_lets_go():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", DONE)
    bench.idle("DM2")
    bench.wait(0.6)
    bench.active("DM6")
    bench.wait(1.8)
    assert bench.orders == ""
    bench.wait(0.3)
    assert bench.orders == "RM5"


def test_an_emergency_stop_waits_for_nobody_to_let_go():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", DONE)
    bench.idle("DM2")
    bench.wait(0.6)
    assert commands(bench.active("DM1")) == [("RM1", True)]


def test_a_less_safe_recovery_waits_even_if_it_claims_something_else():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", ACTING)
    bench.idle("DM2")
    bench.active("DM4", "hmi")
    bench.wait(0.6)
    assert bench.orders == "(RM2)"
    assert bench.decisions[-1].decision.recoveries == ("RM3",)
    assert commands(bench.report("RM2", DONE)) == [("RM2", False), ("RM3", True)]


def test_a_safer_recovery_waits_for_one_that_claims_the_same():
    bench = Bench(edited(RM2={"claims": frozenset({"actuation", "control_nodes"})}))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.active("DM2")) == []
    assert bench.orders == "(RM3)"
    assert commands(bench.report("RM3", DONE)) == [("RM3", False)]
    assert commands(bench.report("RM3", Phase.IDLE)) == [("RM2", True)]


def test_an_interruptible_recovery_is_released_at_once():
    bench = Bench(edited(RM2={"interruptible": True}))
    bench.active("DM2")
    bench.report("RM2", ACTING)
    bench.idle("DM2")
    assert commands(bench.active("DM6")) == [("RM1", True), ("RM2", False)][::-1]


def test_a_recovery_that_is_chosen_again_while_draining_just_goes_on():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.active("DM3")
    assert bench.orders == "RM2 (RM3)"
    bench.report("RM2", ACTING)
    bench.report("RM2", DONE)
    bench.idle("DM3")
    bench.wait(0.6)
    assert bench.orders == "RM3"
    assert [o.decision for o in bench.log
            if isinstance(o, Command) and o.recovery == "RM3"] == [1]


@pytest.mark.parametrize("phase", [None, ACTING, DONE])
@pytest.mark.parametrize("dm", DMS[1:])
def test_an_emergency_stop_never_waits_whatever_runs(dm, phase):
    bench = Bench()
    bench.active(dm, "hmi")
    if phase:
        for rm in bench.state.activated:
            bench.report(rm, phase)
    assert ("RM1", True) in commands(bench.active("DM1"))


# ---- latch and reset --------------------------------------------------------------------------


def test_an_emergency_stop_stays_until_it_is_reset():
    bench = Bench()
    bench.active("DM1")
    bench.report("RM1", ACTING)
    bench.report("RM1", DONE)
    bench.idle("DM1")
    bench.wait(60.0)
    assert bench.orders == "RM1"
    assert bench.state.latched == ("RM1",)
    answer = bench.reset("RM1")
    assert (answer.granted, answer.reason) == (True, "reset by the tower")
    assert bench.orders == ""


def test_a_reset_is_refused_while_the_cause_persists():
    bench = Bench()
    bench.active("DM1")
    bench.report("RM1", DONE)
    answer = bench.reset("RM1")
    assert (answer.granted, answer.reason) == (False, "the cause persists: FTM1 active")
    bench.idle("DM1")
    assert not bench.reset("RM1").granted  # held: not believed yet
    bench.wait(1.0)
    assert bench.reset("RM1").granted


@pytest.mark.parametrize(("rm", "why"), [
    ("RM1", "it is not latched"), ("RM2", "it is not latched"),
    ("RM9", "there is no such recovery module")])
def test_a_reset_of_what_is_not_latched_is_refused_with_the_reason(rm, why):
    answer = Bench().reset(rm)
    assert (answer.granted, answer.reason) == (False, why)


EXCUSED = edited(RM1={"excused_by": frozenset({"DM5"})})
"""RM1 is not latched by what DM5 explains."""


def stopped(bench: Bench) -> None:
    bench.report("RM1", ACTING)
    bench.report("RM1", DONE)


@pytest.mark.parametrize("first", ["DM5", "DM1"])
def test_what_is_explained_meanwhile_is_not_latched(first):
    bench = Bench(EXCUSED)
    bench.active(first)
    bench.wait(1.0)
    bench.active("DM1" if first == "DM5" else "DM5")
    stopped(bench)
    assert "RM1" in bench.orders.split()
    assert bench.state.latched == ()
    bench.idle("DM1")
    bench.wait(1.0)
    bench.idle("DM5")
    bench.wait(1.0)
    assert "RM1" not in bench.orders


def test_what_outlasts_its_explanation_is_latched():
    bench = Bench(EXCUSED)
    bench.active("DM5")
    bench.active("DM1")
    stopped(bench)
    bench.idle("DM5")
    bench.wait(0.3)
    assert bench.state.latched == ()  # the explanation is held
    bench.wait(1.0)
    assert bench.state.latched == ("RM1",)
    bench.idle("DM1")
    bench.wait(30.0)
    assert bench.orders == "RM1"


def test_an_old_latch_is_not_excused_by_what_comes_later():
    bench = Bench(EXCUSED)
    bench.active("DM1")
    stopped(bench)
    bench.wait(6.0)
    bench.active("DM5")
    assert bench.state.latched == ("RM1",)


@pytest.mark.parametrize("between_s", [0.0, 4.0])
@pytest.mark.parametrize("again", ["the manager", "the module", "the manager, after a standstill"])
def test_a_latch_does_not_become_younger_when_somebody_is_started_again(again, between_s):
    bench = Bench(EXCUSED)
    bench.active("DM1")
    stopped(bench)
    bench.idle("DM1")
    bench.wait(30.0)
    if again == "the manager":
        memory = msgspec.json.decode(msgspec.json.encode(
            remember(bench.state, bench.arbiter)), type=Memory)
        bench.state = recall(bench.arbiter, memory, bench.now, bench.state.number)
        for track in bench.state.detections:
            bench.idle(track.name)
        for track in bench.state.recoveries:
            bench.report(track.name, DONE if track.name == "RM1" else IDLE)
    elif again == "the module":
        bench.report("RM1", IDLE)
        bench.report("RM1", DONE)
    else:
        bench.state = forgive_absence(bench.state, 29.0, bench.now)
    bench.wait(between_s)
    assert bench.state.latched == ("RM1",)
    bench.active("DM5")
    bench.wait(1.0)
    bench.idle("DM5")
    bench.wait(30.0)
    assert bench.state.latched == ("RM1",)
    assert bench.orders == "RM1"


def test_what_nothing_explains_is_latched():
    bench = Bench(EXCUSED)
    bench.active("DM6")
    bench.active("DM1")
    stopped(bench)
    assert bench.state.latched == ("RM1",)


def test_a_less_safe_recovery_does_not_replace_a_latched_one():
    bench = Bench()
    bench.active("DM1")
    bench.report("RM1", DONE)
    bench.idle("DM1")
    bench.wait(1.0)
    assert commands(bench.active("DM5", "hmi")) == []
    assert bench.decisions[-1].decision.recoveries == ("RM1",)
    assert ("RM4", "RM1 is latched until reset") in bench.decisions[-1].decision.rejected
    assert bench.reset("RM1").granted  # FTM5 does not need RM1
    assert bench.orders == "RM4"


def test_a_safer_recovery_replaces_a_latched_one_which_then_comes_back():
    bench = Bench(edited(RM1={"latched": False}, RM2={"latched": True}))
    bench.active("DM2")
    bench.report("RM2", DONE)
    bench.idle("DM2")
    bench.wait(1.0)
    assert commands(bench.active("DM1")) == [("RM2", False), ("RM1", True)]
    bench.report("RM1", DONE)
    bench.idle("DM1")
    assert commands(bench.wait(1.0)) == [("RM1", False), ("RM2", True)]
    assert bench.reset("RM2").granted


# ---- detection: silence, flapping, repeated causes --------------------------------------------


def test_a_silent_detection_module_counts_as_active():
    bench = Bench()
    others = tuple(dm for dm in DMS if dm != "DM1")
    bench.wait(0.95, hearing=others)
    assert bench.orders == ""
    bench.wait(0.1, hearing=others)
    assert bench.orders == "RM1"
    assert bench.state.silent == ("DM1",)
    assert "silent" in bench.state.desired["RM1"].reason


def test_a_flapping_detection_module_does_not_thrash():
    bench = Bench()
    for _ in range(60):  # a flap a second for a minute
        bench.active("DM2")
        bench.report("RM2", DONE)
        bench.wait(0.2)
        bench.idle("DM2")
        bench.wait(0.8)
    rm2 = [o.activate for o in bench.log if isinstance(o, Command) and o.recovery == "RM2"]
    assert len(rm2) <= 4
    bench.wait(10.1)
    assert bench.orders == ""


def test_a_second_crash_during_the_respawn_is_ordered_too():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    out = bench.active("DM4", "osmosis_control", "graph_planner")
    assert commands(out) == [("RM3", True)]
    assert out[0].nodes == ("osmosis_control", "graph_planner")
    assert out[0].decision == 2
    bench.report("RM3", DONE, decision=1)
    bench.active("DM2")
    assert bench.orders == "RM2 (RM3)"  # done with the first order, but not with the second
    assert commands(bench.report("RM3", DONE, decision=2)) == [("RM3", False)]


def test_the_same_node_crashing_again_is_respawned_again():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", DONE)
    bench.idle("DM4")
    bench.wait(0.2)
    assert commands(bench.active("DM4", "osmosis_control")) == [("RM3", True)]
    assert bench.state.desired["RM3"].decision == 3  # 2 released it


def test_a_repair_that_is_not_done_is_held_like_a_stop():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.idle("DM4")
    assert commands(bench.report("RM3", DEGRADED)) == []
    assert commands(bench.wait(0.45)) == []
    assert commands(bench.wait(0.1)) == [("RM3", False)]


def test_two_crashes_a_second_apart_are_two_repairs_and_no_emergency():
    bench = Bench()
    for _ in range(10):
        for dm, rm in (("DM4", "RM3"), ("DM7", "RM4")):
            assert commands(bench.active(dm, "node")) == [(rm, True)]
            bench.report(rm, ACTING)
            bench.report(rm, DONE)
            bench.idle(dm)
            bench.wait(0.5)
    assert {r for d in bench.decisions for r in d.decision.recoveries} == {"RM3", "RM4"}


def test_a_crash_long_after_the_order_is_a_new_cause_and_no_failure_of_the_old():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", DONE)
    bench.wait(2.8)
    bench.idle("DM4")
    bench.wait(0.4)
    assert commands(bench.active("DM4", "osmosis_control")) == [("RM3", True)]


def test_another_node_crashing_right_at_the_deadline_is_no_failure_either():
    bench = Bench(edited(RM3={"deadline_s": 0.5}))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", DONE)
    bench.now = 0.6
    assert commands(bench.active("DM4", "graph_planner")) == [("RM3", True)]
    assert bench.state.desired["RM3"].nodes == ("graph_planner",)


def test_one_node_fewer_is_no_new_order():
    bench = Bench()
    bench.active("DM4", "osmosis_control", "graph_planner")
    assert commands(bench.active("DM4", "graph_planner")) == []


def test_modules_of_other_systems_are_ignored():
    bench = Bench()
    before = bench.state
    assert bench.active("DM77") == []
    assert before == bench.state


# ---- purity -----------------------------------------------------------------------------------


def test_a_step_changes_nothing_but_returns_a_new_state():
    bench = Bench()
    before = bench.state
    copy = msgspec.json.decode(msgspec.json.encode(before), type=State)
    bench.active("DM1")
    assert copy == before
    assert before != bench.state


def test_nothing_happens_without_a_reason():
    bench = Bench()
    assert bench.wait(20.0) == []
    assert bench.send(Tick()) == []


def test_the_same_inputs_lead_to_the_same_outputs():
    logs = []
    for _ in range(2):
        bench = Bench()
        bench.active("DM6")
        bench.active("DM2")
        bench.wait(3.0)
        logs.append(bench.log)
    assert logs[0] == logs[1]


def test_every_decision_has_a_number_of_its_own_and_commands_refer_to_them():
    bench = Bench()
    for dm in DMS:
        bench.active(dm, "hmi")
        bench.wait(0.3)
    numbers = [d.number for d in bench.decisions]
    assert numbers == sorted(set(numbers))
    assert {o.decision for o in bench.log if isinstance(o, Command)} <= set(numbers)




# ---- one cause of many symptoms ---------------------------------------------------------------


def explained_by_dm5() -> SystemSpec:
    """FTM5 stops the robot and explains FTM2, FTM4 and FTM6; RM1 is excused by its DM5."""
    spec = edited(RM1={"excused_by": frozenset({"DM5"})})
    return msgspec.structs.replace(spec, mechanisms=tuple(
        msgspec.structs.replace(m, recover="RM2", explains=frozenset({"FTM2", "FTM4", "FTM6"}))
        if m.name == "FTM5" else m for m in spec.mechanisms))


def test_what_is_explained_is_not_acted_on_and_counts_again_afterwards():
    bench = Bench(explained_by_dm5())
    bench.active("DM5")
    assert bench.orders == "RM2"
    bench.report("RM2", DONE)
    bench.active("DM4", "osmosis_control")
    bench.active("DM6")
    assert (bench.orders, bench.state.active) == ("RM2", ("FTM5",))
    assert len(bench.decisions) == 1
    bench.idle("DM6")
    bench.idle("DM5")
    bench.wait(1.0)
    assert (bench.orders, bench.state.active) == ("RM3", ("FTM4",))


def test_what_was_under_way_when_it_was_explained_is_left_to_finish():
    bench = Bench(explained_by_dm5())
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.active("DM5")
    assert bench.orders == "RM2 (RM3)"
    bench.report("RM3", DONE)
    assert bench.orders == "RM2"


def test_an_arbiter_that_takes_over_does_not_latch_what_was_excused():
    bench = Bench(explained_by_dm5())
    bench.active("DM5")
    bench.active("DM1")
    stopped(bench)
    memory = remember(bench.state, bench.arbiter)
    for cause, expected in (("", ()), ("DM1", ("RM1",))):
        after = Bench(explained_by_dm5(), oriented=False)
        after.state = recall(after.arbiter, memory, 0.0, 10_000)
        for dm in DMS:
            (after.active if dm == cause else after.idle)(dm)
        assert "RM1" in after.orders  # until all have been heard
        for rm in ("RM2", "RM3", "RM4", "RM5"):
            after.report(rm, IDLE)
        after.report("RM1", DONE)
        after.wait(1.0)
        assert after.state.latched == expected
        assert ("RM1" in after.orders) == bool(cause)


def test_the_last_barrier_acts_whatever_explains_the_rest():
    bench = Bench(explained_by_dm5())
    bench.active("DM5")
    assert ("RM1", True) in commands(bench.active("DM1"))


def test_silence_explains_nothing_unless_many_are_silent():
    for silent, expected in ((("DM5",), ("FTM4", "FTM5")),
                             (("DM5", "DM6", "DM3"), ("FTM3", "FTM5"))):
        bench = Bench(explained_by_dm5())
        bench.active("DM4", "osmosis_control")
        bench.wait(1.5, hearing=tuple(dm for dm in DMS if dm not in silent))
        assert bench.state.active == expected


def test_what_was_reported_before_it_fell_silent_explains_on():
    bench = Bench(explained_by_dm5())
    bench.active("DM5")
    bench.active("DM4", "osmosis_control")
    bench.wait(1.5, hearing=tuple(dm for dm in DMS if dm != "DM5"))
    assert (bench.state.silent, bench.state.active) == (("DM5",), ("FTM5",))
