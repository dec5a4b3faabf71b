"""The arbiter as timelines: what is reported, what is ordered, and when."""

from unittest import mock

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart import STRATEGIES, Arbiter, Command, RecoveryHeard, ResetAsked, Tick, build_arbiter
from rampart.manager.actor import forgive_absence
from rampart.manager.arbitration.arbiter_memory import Memory, objection, recall, remember
from rampart.manager.arbitration.arbiter_state import ShadowDiffered
from rampart.manager.arbitration.detection_track import (
    DetectionHeard,
    DetectionRules,
    DetectionTrack,
    hear,
    overdue,
    pass_time,
)
from rampart.manager.model.mechanisms import RecoveryPhase
from tests.manager.bench import DMS, RMS, Bench, commands, edited, paper

ACTING, DONE, IDLE = RecoveryPhase.ACTING, RecoveryPhase.DONE, RecoveryPhase.IDLE
CONTROL = "osmosis_control"
EXCUSED = {"RM1": {"excused_by": frozenset({"DM5"})}}
"""RM1 is not latched by what DM5 explains."""

EXPLAINED = {**EXCUSED, "FTM5": {
    "recover": "RM2", "explains": frozenset({"FTM2", "FTM4", "FTM6"})}}
"""FTM5 stops the robot and explains FTM2, FTM4 and FTM6; RM1 is excused by its DM5."""

STOPPED = "RM2 done; -DM2; wait 0.6 ="
"""RM2 was asked to let go, and has not said yet that it has."""


def work(*names: str) -> str:
    """They obey, and come to an end."""
    return ";".join(f"{name} {phase}" for phase in ("acting", "done") for name in names)


PLAIN = {
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
        DM1; RM1 acting; RM1 done; refused RM1 the cause persists: FTM1 active; -DM1; refused RM1
        refused RM2 it is not latched; refused RM9 the recovery module is unknown
        wait 60 = RM1; latched: RM1; reset RM1 =""",
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
    # recoveries that fail
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

EDITED = {
    "a safer recovery waits for one that claims the same": (
        {"RM2": {"claims": frozenset({"actuation", "control_nodes"})}}, f"""
        DM4 {CONTROL}; RM3 acting; DM2 > = (RM3); RM3 done > -RM3; RM3 idle > +RM2"""),
    "an interruptible recovery is released at once": (
        {"RM2": {"interruptible": True}}, "DM2; RM2 acting; -DM2; DM6 > -RM2 +RM1"),
    "a safer recovery replaces a latched one, which then comes back": (
        {"RM1": {"latched": False}, "RM2": {"latched": True}}, """
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
    "a late one in the way is released": (
        {"RM5": {"escalate_to": "RM2"}, "RM2": {"escalate_to": ""}},
        "DM6; RM5 acting; wait 2.1 = RM2"),
}

EITHER = {"FTM7": {"recover": "RM4 or RM3"}}
NEEDS_HMI = {**EITHER, "RM4": {"needs": frozenset({"hmi"})}}
NOT_DM7 = {"FTM6": {"detect": "DM6 and not DM7"}}
ALL_OF = {"FTM2": {"recover": "RM2 or (RM3 and RM4)"}}

GUARDED = {
    "a guarded repair walks out of the trap": ({}, f"""
        DM2 > +RM2; DM4 {CONTROL} > +RM3 = RM2 RM3; {work("RM2", "RM3")} = RM2 RM3
        -DM4 > -RM3 = RM2; -DM2 >; wait 1.0 > -RM2 ="""),
    "a guard joins a repair that is at work, which is wanted": (
        {}, f"DM4 {CONTROL}; RM3 acting; DM2 > +RM2 = RM2 RM3"),
    "two crashes at once are repaired under a controlled stop": ({}, f"""
        DM4 {CONTROL}; DM7 localization > +RM2 +RM4 = RM2 RM3 RM4; latched:
        {work("RM2", "RM3", "RM4")}; -DM4 > -RM2 -RM3; -DM7 > -RM4"""),
    "repairs run beneath an emergency stop": ({}, f"""
        DM1; DM4 {CONTROL} = RM1 RM3; {work("RM1", "RM3")}; -DM4 = RM1"""),
    "and beneath one that is only latched, but no stop that is less safe": ({}, f"""
        DM1; {work("RM1")}; -DM1; wait 1.0 = RM1; DM7 localization > +RM4; {work("RM4")}
        -DM7 > -RM4; DM2 >; rejected: RM2 RM1 is latched until reset; reset RM1 = RM2"""),
    "a repair that claims what the guard claims waits": (
        {"RM3": {"claims": frozenset({"actuation"})}}, f"""
        DM2; {work("RM2")}; DM4 {CONTROL} > = RM2
        rejected: RM3 waits, another recovery claims the same"""),
    "a repair that fails beneath its guard leaves the guard": ({}, f"""
        DM2; DM4 {CONTROL}; {work("RM2")}; RM3 acting; RM3 failed > -RM3 = RM2
        rejected: RM3 escalated to RM2"""),
    "a guard that fails gives way to a safer one and the repair goes on": ({}, f"""
        DM2; DM4 {CONTROL}; RM2 acting; RM3 acting; RM2 failed > -RM2 +RM1 = RM1 RM3"""),
    "a guard of nobody's own escalates to the common dominant": (
        {"RM2": {"escalate_to": ""}}, f"""
        DM4 {CONTROL}; DM7 localization; RM2 acting; RM2 failed > -RM2 +RM1 = RM1 RM3 RM4"""),
}
SIMULTANEOUS = {
    "independent repairs run at the same time": ({}, f"""
        DM4 {CONTROL}; DM5 hmi > +RM4 = RM3 RM4; {work("RM3", "RM4")}; -DM5 > -RM4 = RM3"""),
    "a compound recovery runs all its parts": ({"FTM7": {"recover": "RM2 and RM4"}}, f"""
        DM7 localization = RM2 RM4; {work("RM2", "RM4")}; -DM7; wait 1.0 ="""),
    "stops in conflict give way to their common dominant":
        ({}, f"DM2; {work('RM2')}; DM6 > -RM2 +RM1"),
    "what is no longer maximal drains beside the safer one": ({}, f"""
        DM4 {CONTROL}; RM3 acting; DM2 > +RM2 = RM2 (RM3); RM3 done > -RM3"""),
}
MISSION_FIRST = {
    "it forgets that a mechanism was late": ({}, f"""
        DM4 {CONTROL}; RM3 acting; wait 1.0; {work("RM2", "RM3")}; -DM4; wait 1.0; RM2 idle
        RM3 idle; DM4 {CONTROL} > +RM3 = RM3"""),
    "it climbs no further when the stop is in force": ({}, f"DM2; {work('RM2')}; wait 30 = RM2"),
    "it climbs to the top when nothing helps":
        ({}, f"DM2; DM4 {CONTROL}; RM3 acting; wait 10; latched: RM1"),
    "it lets a repair go before the stop above it": ({}, f"""
        DM4 {CONTROL}; RM3 acting; DM2 > = RM3; rejected: RM2 FTM4 is deeper and comes first"""),
    "it stops at once at the root": ({}, f"DM4 {CONTROL}; RM3 acting; DM1 > +RM1"),
    "who waited for a deeper one has its whole patience when its turn comes": ({}, f"""
        DM4 {CONTROL}; DM2; RM3 acting; wait 0.3; RM3 done; -DM4 = RM2; RM2 degraded
        wait 0.3 = RM2; -DM2; wait 1.0 ="""),
}
SAFETY_FIRST = {
    "a mechanism with a gate needs both its detections": (
        {"FTM6": {"detect": "DM6 and DM7"}},
        "DM6 > =; DM7 localization = RM5; active: FTM6 FTM7"),
    "one that is active rules it out": (NOT_DM7, """
        DM6; active: FTM6; DM7 localization; active: FTM7"""),
    "a silent module does not vouch that all is well":
        (NOT_DM7, "DM6; wait 1.2 without DM7; active: FTM6 FTM7"),
    "an alternative is taken when the first has failed, and forgiven": (EITHER, f"""
        DM7 localization > +RM4; RM4 acting; RM4 failed > -RM4 +RM3; rejected: RM4 escalated to RM3
        {work("RM3")}; -DM7; wait 1.0 > -RM3; DM7 localization > +RM4"""),
    "when both alternatives have failed it escalates beyond them": (EITHER, """
        DM7 localization; RM4 acting; RM4 failed; RM3 acting; RM3 failed = RM5"""),
    "all of an alternative is run and not only its first recovery": (ALL_OF, f"""
        DM2 > +RM2; RM2 acting; RM2 failed > -RM2 +RM3 +RM4; rejected: RM2 escalated to RM3
        {work("RM3", "RM4")}; -DM2; wait 1.0 > -RM3 -RM4"""),
    "a recovery whose node is reported failed is passed over and comes back": ({}, f"""
        DM2; {work("RM2")}; DM5 safety_pilot; {work("RM1")}
        rejected: RM2 needs safety_pilot, which DM5 reports failed
        -DM5; wait 1.0 = RM1; RM2 idle; reset RM1 = RM2"""),
    "a node that is not needed changes nothing": ({}, "DM2; DM5 hmi = RM2"),
    "what the first alternative needs is there": (NEEDS_HMI, "DM7 localization = RM4"),
    "it is not": (NEEDS_HMI, "DM7 localization hmi = RM3"),
}
TIMELINES = {
    **{name: ({}, script) for name, script in PLAIN.items()}, **EDITED,
    **{f"{strategy}: {name}": ({"strategy": strategy, **changes}, script)
       for strategy, table in (("guarded-repair", GUARDED), ("simultaneous", SIMULTANEOUS),
                               ("mission-first", MISSION_FIRST), ("safety-first", SAFETY_FIRST))
       for name, (changes, script) in table.items()}}


@pytest.mark.parametrize(("changes", "script"), TIMELINES.values(), ids=TIMELINES)
def test_timeline(changes, script):
    Bench(edited(**changes)).play(script)


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


def test_another_node_crashing_right_at_the_deadline_is_no_failure_either():
    bench = Bench(edited(RM3={"deadline_s": 0.5})).play(f"DM4 {CONTROL}; RM3 done")
    bench.now = 0.6
    assert commands(bench.active("DM4", "graph_planner")) == [("RM3", True)]
    assert bench.state.desired["RM3"].nodes == ("graph_planner",)


@pytest.mark.parametrize("between_s", [0.0, 4.0])
@pytest.mark.parametrize("again", ["the manager", "the module", "the manager, after a standstill"])
def test_a_latch_does_not_become_younger_when_somebody_is_started_again(again, between_s):
    bench = Bench(edited(**EXCUSED)).play("DM1; RM1 acting; RM1 done; -DM1; wait 10")
    if again == "the manager":
        memory = msgspec.json.decode(msgspec.json.encode(
            remember(bench.state, bench.arbiter)), type=Memory)
        bench.state = recall(bench.arbiter, memory, bench.now, bench.state.number)
        for track in bench.state.detections:
            bench.idle(track.name)
        for track in bench.state.recoveries:
            bench.report(track.name, DONE if track.name == "RM1" else IDLE)
    elif again == "the module":
        bench.play("RM1 idle; RM1 done")
    else:
        bench.state = forgive_absence(bench.state, 9.0, bench.now)
    bench.play(f"wait {between_s}; latched: RM1; DM5; wait 1; -DM5; wait 10 = RM1; latched: RM1")


def test_an_arbiter_that_takes_over_does_not_latch_what_was_excused():
    bench = Bench(edited(**EXPLAINED)).play("DM5; DM1; RM1 acting; RM1 done")
    memory = remember(bench.state, bench.arbiter)
    for cause, expected in (("", ()), ("DM1", ("RM1",))):
        after = Bench(edited(**EXPLAINED), oriented=False)
        after.state = recall(after.arbiter, memory, 0.0, 10_000)
        for dm in DMS:
            (after.active if dm == cause else after.idle)(dm)
        assert "RM1" in after.orders  # until all have been heard
        after.play("RM2 idle; RM3 idle; RM4 idle; RM5 idle; RM1 done; wait 1")
        assert after.state.latched == expected
        assert ("RM1" in after.orders) == bool(cause)


def test_a_repair_that_is_escalated_to_is_told_the_nodes():
    bench = Bench(edited(RM3={"escalate_to": "RM4"})).play(f"DM4 {CONTROL}; RM3 failed")
    assert bench.state.desired["RM4"].activate
    assert bench.state.desired["RM4"].nodes == (CONTROL,)


def test_a_failure_is_forgiven_with_its_own_cause_whatever_else_is_active():
    bench = Bench().play(f"DM4 {CONTROL}; DM5 hmi; RM3 acting; RM3 failed")
    assert bench.state.recoveries[2].failed_for == ("FTM4",)
    bench.play("-DM4; RM2 idle; wait 20")
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


def test_a_latch_beneath_a_safer_recovery_survives_the_manager():
    bench = Bench(edited(RM2={"latched": True})).play("DM2; RM2 done; DM1 = RM1")
    memory = remember(bench.state, bench.arbiter)
    assert {latch.command.recovery for latch in memory.latches} == {"RM1", "RM2"}
    assert objection(memory) == ""
    state = recall(bench.arbiter, memory, 100.0, 0)
    assert set(state.latched) == {"RM1", "RM2"}
    assert [t.wanted for t in state.recoveries[:2]] == [True, False]


def differences(outputs) -> list[ShadowDiffered]:
    return [o for o in outputs if isinstance(o, ShadowDiffered)]


def test_a_shadow_tells_where_it_would_have_run_something_else():
    bench = Bench(edited(shadow="guarded-repair"))
    assert differences(bench.active("DM2")) == []
    bench.play(work("RM2"))
    (differed,) = differences(bench.active("DM4", "osmosis_control"))
    assert differed.strategy == "guarded-repair"
    assert differed.taken == ("RM2",)
    assert set(differed.decision.recoveries) == {"RM2", "RM3"}
    assert differed.number == bench.state.number
    bench.wait(5.0)
    assert len(differences(bench.log)) == 1  # once a decision
    assert bench.orders == "RM2"  # it does nothing itself


def test_a_patient_shadow_is_told_who_is_late():
    """Nothing new is decided, but the shadow would have climbed to RM2."""
    bench = Bench(edited(shadow="mission-first", RM3={"deadline_s": 60.0}))
    bench.active("DM4", "osmosis_control")
    bench.report("RM3", ACTING)
    assert differences(bench.log) == []
    (differed,) = differences(bench.wait(5.0))
    assert (differed.taken, differed.decision.recoveries) == (("RM3",), ("RM2",))
    assert bench.orders == "RM3"


# ---- the short way through the inputs of a system in which nothing is wrong

INPUTS = st.one_of(
    st.just(Tick()),
    st.builds(DetectionHeard, st.sampled_from(DMS), st.booleans(), st.sampled_from(["", "why"])),
    # Calm far more often than not, or the short way would hardly be taken.
    st.builds(DetectionHeard, st.sampled_from(DMS), st.just(False)),
    st.builds(RecoveryHeard, st.sampled_from(RMS), st.booleans(), st.sampled_from(RecoveryPhase),
              st.integers(0, 4)),
    st.builds(RecoveryHeard, st.sampled_from(RMS), st.just(False), st.just(RecoveryPhase.IDLE),
              st.integers(0, 4)),
    st.builds(ResetAsked, st.sampled_from(RMS)),
)
EVERYBODY = [*(DetectionHeard(name, False) for name in DMS),
             *(RecoveryHeard(name, False, RecoveryPhase.IDLE, 0) for name in RMS)]


@given(st.sampled_from(sorted(STRATEGIES)),
       st.lists(st.tuples(INPUTS, st.sampled_from([0.0, 0.05, 0.4, 3.0])), max_size=25))
def test_the_short_way_leads_where_the_long_way_does(strategy, walk):
    arbiter = build_arbiter(edited(strategy=strategy))
    state, now = arbiter.initial(0.0), 0.0
    for event, wait_s in [*((event, 0.0) for event in EVERYBODY), *walk]:
        now += wait_s
        short = arbiter.step(state, event, now)
        with mock.patch.object(Arbiter, "_is_quiet", return_value=False):
            assert arbiter.step(state, event, now) == short
        state = short[0]


# -- belief in a detection module, as timelines: one character per 100 ms, report in, belief out


RULES = DetectionRules(silence_timeout_s=0.95, startup_grace_s=2.0, release_hold_s=0.5,
                       release_hold_max_s=3.0)


def play(reports: str, rules: DetectionRules = RULES) -> str:
    """A: reports active, i: reports idle, -: says nothing.

    Out: A believed active, S active because silent, . believed idle.
    """
    track, beliefs = DetectionTrack("DM", heard_s=0.0), ""
    for tick, report in enumerate(reports):
        now = tick / 10
        if report in "Ai":
            track = hear(track, DetectionHeard("DM", report == "A", since_s=now), rules, now)
        track = pass_time(track, rules, now)
        beliefs += "S" if track.silent else "A" if track.active else "."
    return beliefs


@pytest.mark.parametrize(("reports", "beliefs"), [
    # active at once; idle after half a second
    ("iiAAAiiiiiiiii",
     "..AAAAAAAA...."),
    # the second flap soon after the first is held for nearly twice as long
    ("iiAiiAiiiiiiiiiiiiii",
     "..AAAAAAAAAAAAAA...."),
    # silence after 0.95 s is activity; a report ends it, after the hold
    ("i----------iiiiiii",
     ".........." "SAAAAA.."),
    # activity that falls silent stays active
    ("iA----------AAii",
     ".AAAAAAAAAASAAAA"),
    # never track_heard: the grace of two seconds, then silent
    ("-----------------------",
     ".....................SS"),
])
def test_belief(reports, beliefs):
    assert beliefs == play(reports)


def track_heard(name: str, at_s: float, **changes) -> DetectionTrack:
    track = hear(DetectionTrack(name, heard_s=0.0), DetectionHeard(name, False), RULES, at_s)
    return msgspec.structs.replace(track, **changes)


def test_a_report_is_as_old_as_what_it_says_not_as_its_arrival():
    def said(stamp_s: float, active: bool = False) -> DetectionHeard:
        return DetectionHeard("DM", active, stamp_s=stamp_s)

    track = track_heard("DM", 10.0)
    assert hear(track, said(9.0), RULES, 10.5).heard_s == 10.0
    assert hear(track, said(10.2), RULES, 10.5).heard_s == 10.2
    assert hear(track, said(10.55), RULES, 10.5).heard_s == 10.5  # a clock that is ahead
    silent = pass_time(track, RULES, 11.0)
    assert silent.silent
    assert hear(silent, said(10.1), RULES, 11.1).silent
    assert not hear(silent, said(10.9), RULES, 11.1).silent
    assert hear(silent, said(9.0, active=True), RULES, 11.1).reported


@pytest.mark.parametrize(("ages_s", "found"), [
    ((0.1, 0.2, 0.1), None), ((0.1, 0.55, 0.1), None), ((0.1, 0.6, 0.1), "DM1"),
    ((0.6, 0.6, 0.1), None), ((0.1, 0.6, 0.3), None), ((0.1, 0.3, 0.6), None),
    ((0.2, 0.2, 0.9), "DM2"), ((0.6, 0.6, 0.6), None)])
def test_one_is_overdue_only_if_all_others_are_in_time(ages_s, found):
    tracks = tuple(track_heard(f"DM{i}", 10.0 - age_s) for i, age_s in enumerate(ages_s))
    which = overdue(tracks, RULES, 10.0)
    assert (which.name if which else None) == found


def test_one_that_was_never_heard_or_counts_as_silent_is_not_overdue():
    assert overdue((DetectionTrack("DM", heard_s=0.0),), RULES, 10.0) is None
    assert overdue((track_heard("DM", 9.0, silent=True),), RULES, 10.0) is None


@given(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 30)), min_size=1, max_size=20))
def test_however_it_flaps_it_is_believed_at_once_and_released_within_the_bound(flaps):
    """No starvation: idle for `release_hold_max_s`, it is believed."""
    reports = "".join("A" * a + "i" * i for a, i in flaps) + "i" * 31
    beliefs = play(reports)
    assert all(belief == "A" for report, belief in zip(reports, beliefs, strict=True)
               if report == "A")  # at once
    assert beliefs.endswith(".")
    # And no thrashing: between two rises of belief lies at least one hold.
    assert ".A" in "." + beliefs


def test_without_hold_belief_follows_the_reports():
    rules = DetectionRules(1.0, 2.0, 0.0, 0.0)
    assert play("iAiAAiiA", rules) == ".A.AA..A"
