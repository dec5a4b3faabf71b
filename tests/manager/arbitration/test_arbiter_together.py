"""Strategies that run several recoveries, on the real arbiter, as timelines."""

import msgspec
import pytest

from rampart.manager.arbitration.arbiter_state import ShadowDiffered
from rampart.manager.model.mechanisms import RecoveryPhase as Phase
from tests.manager.bench import Bench, paper

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


CONTROL = "osmosis_control"


def work(*names: str) -> str:
    """They obey, and come to an end."""
    return ";".join(f"{name} {phase}" for phase in ("acting", "done") for name in names)


EITHER = {"FTM7": {"recover": "RM4 or RM3"}}
BOTH = {"FTM7": {"recover": "RM2 and RM4"}}
NEEDS_HMI = {"mechanisms": EITHER, "recoveries": {"RM4": {"needs": frozenset({"hmi"})}}}
NOT_DM7 = {"mechanisms": {"FTM6": {"detect": "DM6 and not DM7"}}}
ALL_OF = {"mechanisms": {"FTM2": {"recover": "RM2 or (RM3 and RM4)"}}}

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
        {"recoveries": {"RM3": {"claims": frozenset({"actuation"})}}}, f"""
        DM2; {work("RM2")}; DM4 {CONTROL} > = RM2
        rejected: RM3 waits, another recovery claims the same"""),
    "a repair that fails beneath its guard leaves the guard": ({}, f"""
        DM2; DM4 {CONTROL}; {work("RM2")}; RM3 acting; RM3 failed > -RM3 = RM2
        rejected: RM3 escalated to RM2"""),
    "a guard that fails gives way to a safer one and the repair goes on": ({}, f"""
        DM2; DM4 {CONTROL}; RM2 acting; RM3 acting; RM2 failed > -RM2 +RM1 = RM1 RM3"""),
    "a guard of nobody's own escalates to the common dominant": (
        {"recoveries": {"RM2": {"escalate_to": ""}}}, f"""
        DM4 {CONTROL}; DM7 localization; RM2 acting; RM2 failed > -RM2 +RM1 = RM1 RM3 RM4"""),
}
SIMULTANEOUS = {
    "independent repairs run at the same time": ({}, f"""
        DM4 {CONTROL}; DM5 hmi > +RM4 = RM3 RM4; {work("RM3", "RM4")}; -DM5 > -RM4 = RM3"""),
    "a compound recovery runs all its parts": ({"mechanisms": BOTH}, f"""
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
        {"mechanisms": {"FTM6": {"detect": "DM6 and DM7"}}},
        "DM6 > =; DM7 localization = RM5; active: FTM6 FTM7"),
    "one that is active rules it out": (NOT_DM7, """
        DM6; active: FTM6; DM7 localization; active: FTM7"""),
    "a silent module does not vouch that all is well":
        (NOT_DM7, "DM6; wait 1.2 without DM7; active: FTM6 FTM7"),
    "an alternative is taken when the first has failed, and forgiven": ({"mechanisms": EITHER}, f"""
        DM7 localization > +RM4; RM4 acting; RM4 failed > -RM4 +RM3; rejected: RM4 escalated to RM3
        {work("RM3")}; -DM7; wait 1.0 > -RM3; DM7 localization > +RM4"""),
    "when both alternatives have failed it escalates beyond them": ({"mechanisms": EITHER}, """
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
    f"{strategy}: {name}": (strategy, changes, script)
    for strategy, table in (("guarded-repair", GUARDED), ("simultaneous", SIMULTANEOUS),
                            ("mission-first", MISSION_FIRST), ("safety-first", SAFETY_FIRST))
    for name, (changes, script) in table.items()}


@pytest.mark.parametrize(("strategy", "changes", "script"), TIMELINES.values(), ids=TIMELINES)
def test_timeline(strategy, changes, script):
    Bench(system(strategy=strategy, **changes)).play(script)


def differences(outputs) -> list[ShadowDiffered]:
    return [o for o in outputs if isinstance(o, ShadowDiffered)]


def test_a_shadow_tells_where_it_would_have_run_something_else():
    bench = Bench(system(shadow="guarded-repair"))
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
