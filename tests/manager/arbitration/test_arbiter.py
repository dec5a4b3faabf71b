"""The arbiter as timelines: what is reported, what is ordered, and when."""

import msgspec
import pytest

from rampart.manager.actor import forgive_absence
from rampart.manager.arbitration.arbiter_memory import Memory, recall, remember
from rampart.manager.arbitration.arbiter_state import Command
from rampart.manager.model.mechanisms import RecoveryPhase as Phase
from tests.manager.bench import DMS, Bench, edited, paper

ACTING, DONE, IDLE, DEGRADED = Phase.ACTING, Phase.DONE, Phase.IDLE, Phase.DEGRADED


CONTROL = "osmosis_control"
EXCUSED = edited(RM1={"excused_by": frozenset({"DM5"})})
"""RM1 is not latched by what DM5 explains."""

EXPLAINED = msgspec.structs.replace(EXCUSED, mechanisms=tuple(
    msgspec.structs.replace(m, recover="RM2", explains=frozenset({"FTM2", "FTM4", "FTM6"}))
    if m.name == "FTM5" else m for m in EXCUSED.mechanisms))
"""FTM5 stops the robot and explains FTM2, FTM4 and FTM6; RM1 is excused by its DM5."""

STOPPED = "RM2 done; -DM2; wait 0.6 ="
"""RM2 was asked to let go, and has not said yet that it has."""

TIMELINES = {
    # one recovery at a time
    "a crash is answered by a respawn and control handed back":
        f"DM4 {CONTROL} > +RM3; RM3 acting; RM3 done; -DM4 > -RM3 =",
    "a stop starts at once while the respawn drains, its success clears both causes": f"""
        DM4 {CONTROL}; RM3 acting; DM2 > +RM2 = RM2 (RM3); RM2 acting; RM2 done = RM2 (RM3)
        RM3 done > -RM3; -DM4; -DM2; wait 1.0 > -RM2""",
    "an order on its way counts as acting": f"""
        DM4 {CONTROL}; DM2 = RM2 (RM3); RM3 idle 0 = RM2 (RM3); RM3 acting; RM3 degraded > -RM3""",
    "a draining recovery that is respawned has nothing left to finish":
        f"DM4 {CONTROL}; RM3 acting; DM2; RM3 idle 0 > -RM3",
    "the trap of safety-first leaves the robot standing safely, by the paper": f"""
        DM2; RM2 acting; RM2 done; DM4 {CONTROL} >; wait 60 > = RM2
        rejected: RM3 FTM4 is dominated by FTM2""",
    "what claims the same waits until the other has finished": """
        DM2; RM2 acting; -DM2; wait 0.4; RM2 acting; wait 0.2 = (RM2); DM6 > = (RM2)
        RM2 done > -RM2; RM2 idle > +RM5""",
    "who lets go keeps its claim until it says so":
        f"DM2; {STOPPED}; DM6 =; RM2 done 1 =; RM2 idle 1 =; RM2 idle = RM5",
    "who is asked to let go and was respawned is told again at once":
        f"DM2; {STOPPED}; RM2 idle 0 > -RM2",
    "nobody waits longer than the deadline for one that never lets go":
        f"DM2; {STOPPED}; DM6; wait 1.8 =; wait 0.3 = RM5",
    "an emergency stop waits for nobody to let go": f"DM2; {STOPPED}; DM1 > +RM1",
    "a less safe recovery waits even if it claims something else": """
        DM2; RM2 acting; -DM2; DM4 hmi; wait 0.6 = (RM2); RM2 done > -RM2 +RM3""",
    "a recovery that is chosen again while draining just goes on": f"""
        DM4 {CONTROL} > +RM3; RM3 acting; DM3 > +RM2 = RM2 (RM3); RM2 acting; RM2 done; -DM3
        wait 0.6 > -RM2 = RM3""",
    # latch and reset
    "an emergency stop stays until it is reset, which is refused while the cause persists": """
        DM1; RM1 acting; RM1 done; refused RM1; -DM1; refused RM1; wait 60 = RM1; latched: RM1
        reset RM1 =""",
    "a reset of what is not latched is refused": "refused RM1; refused RM2; refused RM9",
    "a less safe recovery does not replace a latched one": """
        DM1; RM1 done; -DM1; wait 1.0; DM5 hmi >; rejected: RM4 RM1 is latched until reset
        reset RM1 = RM4""",
    # silence, flapping, repeated causes
    "a silent detection module counts as active":
        "wait 0.95 without DM1 =; wait 0.1 without DM1 = RM1; silent: DM1",
    "a second crash during the respawn is ordered too": f"""
        DM4 {CONTROL}; RM3 acting; DM4 {CONTROL} graph_planner > +RM3; RM3 done 1
        DM2 = RM2 (RM3); RM3 done 2 > -RM3""",
    "the same node crashing again is respawned again": f"""
        DM4 {CONTROL}; RM3 done; -DM4 > -RM3; wait 0.2; DM4 {CONTROL} > +RM3""",
    "a repair that is not done is held like a stop": f"""
        DM4 {CONTROL}; RM3 acting; -DM4; RM3 degraded >; wait 0.45 >; wait 0.1 > -RM3""",
    "two crashes a second apart are two repairs and no emergency": """
        DM4 node > +RM3; RM3 acting; RM3 done; -DM4; wait 0.5
        DM7 node > +RM4; RM4 acting; RM4 done; -DM7; wait 0.5""" * 10,
    "a crash long after the order is a new cause and no failure of the old": f"""
        DM4 {CONTROL}; RM3 done; wait 2.8; -DM4; wait 0.4; DM4 {CONTROL} > +RM3""",
    "one node fewer is no new order": f"DM4 {CONTROL} graph_planner; DM4 graph_planner >",
    "a module of another system is ignored, and nothing happens without a reason":
        "DM77 > =; wait 20 > =",
}


EDITED = {
    **{name: (paper(), script) for name, script in TIMELINES.items()},
    "a safer recovery waits for one that claims the same": (
        edited(RM2={"claims": frozenset({"actuation", "control_nodes"})}), f"""
        DM4 {CONTROL}; RM3 acting; DM2 > = (RM3); RM3 done > -RM3; RM3 idle > +RM2"""),
    "an interruptible recovery is released at once": (
        edited(RM2={"interruptible": True}), "DM2; RM2 acting; -DM2; DM6 > -RM2 +RM1"),
    "a safer recovery replaces a latched one, which then comes back": (
        edited(RM1={"latched": False}, RM2={"latched": True}), """
        DM2; RM2 done; -DM2; wait 1.0; DM1 > -RM2 +RM1; RM1 done; -DM1
        wait 1.0 > -RM1 +RM2; reset RM2"""),
    "what is explained before it stops is not latched": (EXCUSED, """
        DM5; wait 1.0; DM1; RM1 acting; RM1 done; latched:; -DM1; wait 1.0; -DM5; wait 1.0
        latched:"""),
    "nor what is explained meanwhile": (EXCUSED, """
        DM1; wait 1.0; DM5; RM1 acting; RM1 done = RM1; latched:; -DM1; wait 1.0; -DM5
        wait 1.0 = (RM4)"""),
    "what outlasts its explanation is latched": (EXCUSED, """
        DM5; DM1; RM1 acting; RM1 done; -DM5; wait 0.3; latched:; wait 1.0; latched: RM1; -DM1
        wait 30 = RM1"""),
    "an old latch is not excused by what comes later": (
        EXCUSED, "DM1; RM1 acting; RM1 done; wait 6.0; DM5; latched: RM1"),
    "what nothing explains is latched": (
        EXCUSED, "DM6; DM1; RM1 acting; RM1 done; latched: RM1"),
    "what is explained is not acted on and counts again afterwards": (EXPLAINED, f"""
        DM5 = RM2; RM2 done; DM4 {CONTROL} >; DM6 > = RM2; active: FTM5; -DM6; -DM5
        wait 1.0 = RM3; active: FTM4"""),
    "what was under way when it was explained is left to finish": (EXPLAINED, f"""
        DM4 {CONTROL}; RM3 acting; DM5 = RM2 (RM3); RM3 done = RM2"""),
    "the last barrier acts whatever explains the rest": (EXPLAINED, "DM5; DM1 > +RM1"),
    "one that is silent explains nothing": (
        EXPLAINED, f"DM4 {CONTROL}; wait 1.5 without DM5; active: FTM4 FTM5"),
    "unless many are": (
        EXPLAINED, f"DM4 {CONTROL}; wait 1.5 without DM5 DM6 DM3; active: FTM3 FTM5"),
    "what was reported before it fell silent explains on": (EXPLAINED, f"""
        DM5; DM4 {CONTROL}; wait 1.5 without DM5; silent: DM5; active: FTM5"""),
}


@pytest.mark.parametrize(("spec", "script"), EDITED.values(), ids=EDITED)
def test_timeline(spec, script):
    Bench(spec).play(script)


def test_a_command_says_for_which_nodes_why_and_of_which_decision():
    bench = Bench()
    (order,) = (o for o in bench.active("DM4", CONTROL) if isinstance(o, Command))
    assert (order.nodes, order.decision) == ((CONTROL,), 1)
    assert "DM4 says so" in order.reason
    bench.report("RM3", ACTING)
    (order,) = (o for o in bench.active("DM4", CONTROL, "graph_planner")
                if isinstance(o, Command))
    assert (order.nodes, order.decision) == ((CONTROL, "graph_planner"), 2)
    assert [d.decision.rule for d in bench.decisions] == [1, 1]


def test_a_reset_that_is_refused_is_told_why():
    bench = Bench().play("DM1; RM1 done")
    assert [bench.reset(rm).reason for rm in ("RM1", "RM2", "RM9")] == [
        "the cause persists: FTM1 active", "it is not latched", "the recovery module is unknown"]


@pytest.mark.parametrize("between_s", [0.0, 4.0])
@pytest.mark.parametrize("again", ["the manager", "the module", "the manager, after a standstill"])
def test_a_latch_does_not_become_younger_when_somebody_is_started_again(again, between_s):
    bench = Bench(EXCUSED)
    bench.play("DM1; RM1 acting; RM1 done")
    bench.idle("DM1")
    bench.wait(10.0)
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
        bench.state = forgive_absence(bench.state, 9.0, bench.now)
    bench.wait(between_s)
    assert bench.state.latched == ("RM1",)
    bench.active("DM5")
    bench.wait(1.0)
    bench.idle("DM5")
    bench.wait(10.0)
    assert bench.state.latched == ("RM1",)
    assert bench.orders == "RM1"


def test_an_arbiter_that_takes_over_does_not_latch_what_was_excused():
    bench = Bench(EXPLAINED).play("DM5; DM1; RM1 acting; RM1 done")
    memory = remember(bench.state, bench.arbiter)
    for cause, expected in (("", ()), ("DM1", ("RM1",))):
        after = Bench(EXPLAINED, oriented=False)
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
