"""The arbiter when recoveries fail, and when the manager itself is killed, as timelines."""

from rampart.manager.arbitration.arbiter import build_arbiter
from rampart.manager.arbitration.arbiter_memory import Memory, objection, recall, remember
from rampart.manager.model.mechanisms import RecoveryPhase as Phase
from tests.manager.bench import DMS, RMS, Bench, commands, edited, paper

ACTING, DONE, IDLE, FAILED = Phase.ACTING, Phase.DONE, Phase.IDLE, Phase.FAILED


# ---- failures ---------------------------------------------------------------------------------


def test_a_failed_respawn_escalates_to_the_one_it_names():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert commands(bench.report("RM3", FAILED)) == [("RM3", False), ("RM2", True)]
    assert any(name == "RM3" and "failed: " in why and "escalated to RM2" in why
               for name, why in bench.decisions[-1].decision.rejected)
    bench.wait(30.0)
    bench.report("RM3", IDLE)
    assert bench.orders.startswith("RM")
    assert "RM3" not in bench.orders


def test_without_a_name_the_recovery_of_the_mechanism_above_follows():
    """RM4 names nobody: FTM7's parent is FTM6, hence RM5; FTM5's is FTM2, hence RM2."""
    for dm, following in (("DM7", "RM5"), ("DM5", "RM2")):
        bench = Bench()
        bench.active(dm, "hmi")
        assert commands(bench.report("RM4", FAILED)) == sorted(
            [("RM4", False), (following, True)], key=lambda c: c[1])
        assert ("RM4", f"failed: it reports failure; escalated to {following}") \
            in bench.decisions[-1].decision.rejected


def test_escalation_of_a_shared_recovery_goes_above_all_its_mechanisms():
    bench = Bench()
    bench.active("DM5", "hmi")
    bench.active("DM7", "localization")
    bench.report("RM4", FAILED)
    assert bench.orders == "RM1"  # FTM1 is the closest above FTM5 and FTM7


def test_a_recovery_that_is_not_done_by_its_deadline_escalates():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", ACTING)
    bench.wait(1.95)
    assert bench.orders == "RM2"
    bench.wait(0.1)
    assert bench.orders == "RM1 (RM2)"
    assert ("RM2", "failed: not done within 2 s; escalated to RM1") \
        in bench.decisions[-1].decision.rejected


def test_a_dead_recovery_module_is_noticed_by_the_deadline():
    bench = Bench()
    bench.active("DM2")
    bench.wait(2.1)
    assert bench.orders == "RM1"


def test_new_causes_do_not_excuse_a_deaf_recovery_module():
    bench = Bench()
    for _ in range(8):
        bench.active("DM4", "osmosis_control")
        bench.wait(0.2)
        bench.idle("DM4")
        bench.wait(0.2)
    assert "RM2" in bench.orders


def test_a_dead_recovery_module_that_is_no_longer_needed_is_released_at_its_deadline():
    bench = Bench()
    bench.active("DM2")
    bench.idle("DM2")
    bench.wait(1.9)
    assert bench.orders == "(RM2)"
    bench.wait(0.2)
    assert bench.orders == ""


def test_a_repair_that_is_escalated_to_is_told_the_nodes():
    bench = Bench(edited(RM3={"escalate_to": "RM4"}))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", FAILED)
    assert bench.state.desired["RM4"].activate
    assert bench.state.desired["RM4"].nodes == ("osmosis_control",)


def test_a_late_respawn_is_let_be_and_its_late_success_counts():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    bench.wait(3.1)
    assert bench.orders == "RM2 (RM3)"
    bench.report("RM2", DONE)
    bench.report("RM3", DONE)
    assert bench.orders == "RM2"
    bench.idle("DM4")
    bench.wait(1.0)
    assert bench.orders == ""


def test_a_late_one_in_the_way_is_released():
    spec = edited(RM5={"escalate_to": "RM2"}, RM2={"escalate_to": ""})
    bench = Bench(spec)
    bench.active("DM6")
    bench.report("RM5", ACTING)
    bench.wait(2.1)
    assert bench.orders == "RM2"


def test_a_respawn_that_is_done_but_cured_nothing_has_failed():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", DONE)
    bench.wait(2.9)
    assert bench.orders == "RM3"
    bench.wait(0.2)
    assert bench.orders == "RM2"
    assert any("done, but DM4 still active after 3 s" in why
               for _, why in bench.decisions[-1].decision.rejected)


def test_a_stop_whose_cause_persists_has_not_failed():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", DONE)
    bench.wait(60.0)
    assert bench.orders == "RM2"


def test_a_last_resort_that_fails_stays_in_force():
    bench = Bench()
    bench.active("DM1")
    bench.report("RM1", FAILED)
    bench.wait(10.0)
    assert bench.orders == "RM1"


def test_failures_are_forgiven_when_their_cause_is_gone():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", FAILED)
    bench.report("RM2", DONE)
    bench.idle("DM4")
    bench.wait(1.0)
    assert bench.orders == ""
    assert commands(bench.active("DM4", "osmosis_control")) == [("RM3", True)]


def test_a_failure_is_forgiven_with_its_own_cause_whatever_else_is_active():
    bench = Bench()
    bench.active("DM4", "osmosis_control")
    bench.active("DM5", "hmi")
    bench.report("RM3", ACTING)
    bench.report("RM3", FAILED)
    assert bench.state.recoveries[2].failed_for == ("FTM4",)
    bench.idle("DM4")
    bench.report("RM2", IDLE)
    bench.wait(20.0, hearing=DMS)
    assert not bench.state.recoveries[2].failure


def test_a_repair_whose_detection_blames_one_life_after_the_other_has_failed():
    bench = Bench()
    life = 1
    bench.active("DM4", f"osmosis_control#{life}")
    deadline_s = bench.arbiter.mechanisms.contracts["RM3"].deadline_s
    while bench.orders == "RM3" and bench.now < 10 * deadline_s:
        bench.report("RM3", ACTING)
        bench.report("RM3", DONE)
        bench.wait(deadline_s / 3)
        life += 1
        bench.active("DM4", f"osmosis_control#{life}")
    assert "RM2" in bench.orders
    assert bench.now <= 2 * deadline_s


def test_a_repair_of_one_node_after_the_other_has_not_failed():
    bench = Bench()
    deadline_s = bench.arbiter.mechanisms.contracts["RM3"].deadline_s
    for node in ("osmosis_control#1", "graph_planner#1", "mission_manager#1"):
        bench.active("DM4", node)
        bench.report("RM3", ACTING)
        bench.report("RM3", DONE)
        bench.wait(0.8 * deadline_s)
    assert bench.orders == "RM3"


def test_a_respawned_recovery_module_is_commanded_again():
    bench = Bench()
    bench.active("DM2")
    bench.report("RM2", DONE)
    assert commands(bench.report("RM2", IDLE, decision=0)) == [("RM2", True)]
    assert bench.orders == "RM2"


def test_a_recovery_module_in_a_crash_loop_escalates():
    bench = Bench()
    bench.active("DM2")
    for _ in range(30):
        bench.report("RM2", ACTING)
        bench.wait(0.05)
        bench.report("RM2", IDLE, decision=0)
        bench.wait(0.05)
    assert "RM1" in bench.orders


# ---- the manager itself is respawned ----------------------------------------------------------


def test_a_new_manager_adopts_a_latched_emergency_stop():
    bench = Bench(oriented=False)
    bench.report("RM1", DONE, decision=41)
    for dm in DMS:
        bench.idle(dm)
    for rm in RMS[1:]:
        bench.report(rm, IDLE)
    bench.wait(20.0)
    assert bench.orders == "RM1"
    assert bench.state.latched == ("RM1",)
    assert bench.state.number >= 41
    assert bench.reset("RM1").granted
    assert bench.orders == ""


def test_a_new_manager_keeps_a_stop_until_it_has_heard_everybody():
    bench = Bench(oriented=False)
    bench.report("RM2", DONE, decision=41)
    bench.active("DM5", "hmi")  # RM4 alone would let the robot go
    for dm in ("DM1", "DM3", "DM4", "DM6", "DM7"):
        bench.idle(dm)
    for rm in ("RM1", "RM3", "RM4", "RM5"):
        bench.report(rm, IDLE)
    assert bench.orders == "RM2"
    bench.active("DM2")
    assert bench.orders == "RM2"
    assert bench.decisions[-1].number > 41


def test_a_new_manager_releases_a_stop_whose_cause_is_gone():
    bench = Bench(oriented=False)
    bench.report("RM2", DONE, decision=41)
    for rm in ("RM1", "RM3", "RM4", "RM5"):
        bench.report(rm, IDLE)
    for dm in DMS[:-1]:
        bench.idle(dm)
    assert bench.orders == "RM2"
    assert commands(bench.idle(DMS[-1])) == [("RM2", False)]


def test_a_new_manager_lets_an_adopted_respawn_finish():
    bench = Bench(oriented=False)
    bench.report("RM3", ACTING, decision=41)
    for rm in ("RM1", "RM2", "RM4", "RM5"):
        bench.report(rm, IDLE)
    for dm in DMS:
        bench.idle(dm)
    assert bench.orders == "(RM3)"
    assert commands(bench.report("RM3", DONE, decision=41)) == [("RM3", False)]


def test_an_emergency_needs_no_orientation():
    bench = Bench(oriented=False)
    bench.report("RM2", DONE, decision=41)
    assert commands(bench.active("DM1")) == [("RM2", False), ("RM1", True)]


def test_the_wait_for_orientation_ends_with_the_grace():
    bench = Bench(oriented=False)
    bench.report("RM2", DONE, decision=41)
    bench.wait(4.9, hearing=DMS)
    assert bench.orders == "RM2"
    for dm in DMS:
        bench.idle(dm)
    bench.wait(0.2)
    assert bench.orders == ""


def respawned() -> Bench:
    """The arbiter of a manager that was respawned: modules run already."""
    bench = Bench(oriented=False)
    bench.arbiter = build_arbiter(paper(), first_start=False)
    return bench


def test_a_respawned_manager_waits_for_a_module_no_longer_than_for_any_silent_one():
    bench = respawned()
    for rm in RMS:
        bench.report(rm, IDLE)
    others = tuple(dm for dm in DMS if dm != "DM1")
    for dm in others:
        bench.idle(dm)
    silence_s = paper().timing.detection_silence_timeout_s
    bench.wait(silence_s - 0.1, hearing=others)
    assert bench.orders == ""
    bench.wait(0.2, hearing=others)
    assert bench.orders == "RM1"


def test_what_was_adopted_is_not_let_go_in_between_if_its_module_stays_silent():
    bench = respawned()
    bench.report("RM2", DONE, decision=41)
    for rm in ("RM1", "RM3", "RM4", "RM5"):
        bench.report(rm, IDLE)
    others = tuple(dm for dm in DMS if dm != "DM2")
    for dm in others:
        bench.idle(dm)
    outputs = bench.wait(3.0, hearing=others)
    assert ("RM2", False) not in commands(outputs)
    assert bench.orders == "RM2"


def test_nothing_is_reset_before_all_modules_have_been_heard():
    bench = respawned()
    bench.report("RM1", DONE, decision=41)
    answer = bench.reset("RM1")
    assert not answer.granted
    assert answer.reason == "not all modules have been heard yet"
    for rm in RMS[1:]:
        bench.report(rm, IDLE)
    for dm in DMS:
        bench.idle(dm)
    assert bench.reset("RM1").granted


def test_a_number_that_was_never_given_is_not_counted_on_from():
    for number in (2**64 - 1, 2**63, -5):
        bench = respawned()
        bench.report("RM2", DONE, decision=number)
        bench.active("DM1")
        assert 0 < bench.state.number < 100
        assert objection(Memory(bench.state.number)) == ""
    assert "decision number" in objection(Memory(2**64 - 1))
    bench = Bench()
    bench.report("RM2", DONE, decision=10**6)  # nobody asks
    bench.active("DM1")
    assert bench.state.number < 100


def test_a_latch_beneath_a_safer_recovery_survives_the_manager():
    spec = edited(RM2={"latched": True})
    bench = Bench(spec)
    bench.active("DM2")
    bench.report("RM2", DONE)
    bench.active("DM1")
    assert bench.orders == "RM1"
    memory = remember(bench.state, bench.arbiter)
    assert {latch.command.recovery for latch in memory.latches} == {"RM1", "RM2"}
    assert objection(memory) == ""
    state = recall(bench.arbiter, memory, 100.0, 0)
    assert set(state.latched) == {"RM1", "RM2"}
    assert [t.wanted for t in state.recoveries[:2]] == [True, False]


def test_a_later_report_of_activation_is_not_adopted():
    bench = Bench()
    bench.report("RM2", DONE, decision=0)
    assert bench.orders == ""
