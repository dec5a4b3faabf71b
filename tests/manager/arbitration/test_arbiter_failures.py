"""The arbiter when recoveries fail, and when the manager itself is killed, as timelines."""

import pytest

from rampart.manager.arbitration.arbiter import build_arbiter
from rampart.manager.arbitration.arbiter_memory import Memory, objection
from rampart.manager.model.mechanisms import RecoveryPhase as Phase
from tests.manager.bench import DMS, RMS, Bench, edited, paper

ACTING, DONE, IDLE, FAILED = Phase.ACTING, Phase.DONE, Phase.IDLE, Phase.FAILED


CONTROL = "osmosis_control"

TIMELINES = {
    "a failed respawn escalates to the one it names": f"""
        DM4 {CONTROL}; RM3 acting; RM3 failed > -RM3 +RM2; rejected: RM3 failed:
        rejected: RM3 escalated to RM2""",
    "without a name the recovery of the mechanism above follows":
        "DM7 hmi; RM4 failed > -RM4 +RM5; rejected: RM4 failed: it reports failure; "
        "rejected: RM4 escalated to RM5",
    "and this is that of FTM2 above FTM5": "DM5 hmi; RM4 failed > -RM4 +RM2",
    "escalation of a shared recovery goes above all its mechanisms":
        "DM5 hmi; DM7 localization; RM4 failed = RM1",
    "a recovery that is not done by its deadline escalates": """
        DM2; RM2 acting; wait 1.95 = RM2; wait 0.1 = RM1 (RM2)
        rejected: RM2 failed: not done within 2 s""",
    "new causes do not excuse a deaf recovery module":
        f"DM4 {CONTROL}; wait 0.2; -DM4; wait 0.2;" * 8 + "wait 0.05 = RM2",
    "a dead recovery module that is no longer needed is released at its deadline":
        "DM2; -DM2; wait 1.9 = (RM2); wait 0.2 =",
    "a late respawn is let be and its late success counts": f"""
        DM4 {CONTROL}; RM3 acting; wait 3.1 = RM2 (RM3); RM2 done; RM3 done = RM2; -DM4
        wait 1.0 =""",
    "a respawn that is done but cured nothing has failed": f"""
        DM4 {CONTROL}; RM3 done; wait 2.9 = RM3; wait 0.2 = RM2
        rejected: RM3 done, but DM4 still active after 3 s""",
    "a stop whose cause persists has not failed": "DM2; RM2 done; wait 10 = RM2",
    "a last resort that fails stays in force": "DM1; RM1 failed; wait 10 = RM1",
    "failures are forgiven when their cause is gone": f"""
        DM4 {CONTROL}; RM3 failed; RM2 done; -DM4; wait 1.0 =; DM4 {CONTROL} > +RM3""",
    "a repair of one node after the other has not failed": "".join(
        f"DM4 {node}#1; RM3 acting; RM3 done; wait 2.4;"
        for node in (CONTROL, "graph_planner", "mission_manager")) + "wait 0.05 = RM3",
    "one in a crash loop escalates":
        "DM2;" + "RM2 acting; wait 0.05; RM2 idle 0; wait 0.05;" * 21 + "RM2 idle 0 = RM1",
    "a respawned recovery module is commanded again": "DM2; RM2 done; RM2 idle 0 > +RM2 = RM2",
    "a later report of activation is not adopted": "RM2 done 0 =",
}


@pytest.mark.parametrize("script", TIMELINES.values(), ids=TIMELINES)
def test_when_recoveries_fail(script):
    Bench().play(script)


def test_a_repair_that_is_escalated_to_is_told_the_nodes():
    bench = Bench(edited(RM3={"escalate_to": "RM4"})).play(f"DM4 {CONTROL}; RM3 failed")
    assert bench.state.desired["RM4"].activate
    assert bench.state.desired["RM4"].nodes == (CONTROL,)


def test_a_failure_is_forgiven_with_its_own_cause_whatever_else_is_active():
    bench = Bench().play(f"DM4 {CONTROL}; DM5 hmi; RM3 acting; RM3 failed")
    assert bench.state.recoveries[2].failed_for == ("FTM4",)
    bench.play("-DM4; RM2 idle; wait 20")
    assert not bench.state.recoveries[2].failure


def test_a_late_one_in_the_way_is_released():
    Bench(edited(RM5={"escalate_to": "RM2"}, RM2={"escalate_to": ""})).play(
        "DM6; RM5 acting; wait 2.1 = RM2")


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


def heard(modules: str, *but: str) -> str:
    """All detection or recovery modules report that nothing is wrong or activated, but some."""
    return ";".join(f"-{one}" if modules == "DM" else f"{one} idle"
                    for one in (DMS if modules == "DM" else RMS) if one not in but)


BUT_RM1, BUT_RM2, BUT_RM3 = (heard("RM", one) for one in ("RM1", "RM2", "RM3"))

NEW = {
    "it adopts a latched emergency stop": f"""
        RM1 done 41; {heard("DM")}; {BUT_RM1}; wait 20 = RM1; latched: RM1; reset RM1 =""",
    "it keeps a stop until it has heard everybody, as RM4 alone would let the robot go": f"""
        RM2 done 41; DM5 hmi; {heard("DM", "DM2", "DM5")}; {BUT_RM2} = RM2; DM2 = RM2""",
    "it releases a stop whose cause is gone": f"""
        RM2 done 41; {BUT_RM2}; {heard("DM", "DM7")} = RM2; -DM7 > -RM2""",
    "it lets an adopted respawn finish": f"""
        RM3 acting 41; {BUT_RM3}; {heard("DM")} = (RM3); RM3 done 41 > -RM3""",
    "an emergency needs no orientation": "RM2 done 41; DM1 > -RM2 +RM1",
    "the wait for orientation ends with the grace":
        f"RM2 done 41; wait 4.9 = RM2; {heard('DM')}; wait 0.2 =",
}


@pytest.mark.parametrize("script", NEW.values(), ids=NEW)
def test_a_new_manager(script):
    bench = Bench(oriented=False).play(script)
    assert "41" not in script or bench.state.number >= 41


def respawned() -> Bench:
    """The arbiter of a manager that was respawned: modules run already."""
    bench = Bench(oriented=False)
    bench.arbiter = build_arbiter(paper(), first_start=False)
    return bench


RESPAWNED = {
    "it waits for a module no longer than for any silent one": f"""
        {heard("RM")}; {heard("DM", "DM1")}; wait 0.85 without DM1 =; wait 0.2 without DM1 = RM1""",
    "what was adopted is not let go in between if its module stays silent": f"""
        RM2 done 41; {BUT_RM2}; {heard("DM", "DM2")}; wait 3.0 without DM2 > = RM2""",
    "nothing is reset before all modules have been heard": f"""
        RM1 done 41; refused RM1; {BUT_RM1}; {heard("DM")}; reset RM1""",
}


@pytest.mark.parametrize("script", RESPAWNED.values(), ids=RESPAWNED)
def test_a_respawned_manager(script):
    """Whose modules run already."""
    respawned().play(script)


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
