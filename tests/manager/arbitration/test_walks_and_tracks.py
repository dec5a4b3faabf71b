"""Random walks over the arbiter: modules report, obey, finish, fail and die in any sequence."""

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rampart.manager.arbitration.arbiter_state import Command, DecisionMade
from rampart.manager.arbitration.detection_track import (
    DetectionHeard,
    DetectionRules,
    DetectionTrack,
    hear,
    overdue,
    pass_time,
)
from rampart.manager.model.mechanisms import RecoveryPhase
from tests.manager.bench import DMS, RMS, Bench, paper

MECHANISMS = paper().build_mechanisms()
ORDER = paper().build_order()
FINISHED = (RecoveryPhase.DONE, RecoveryPhase.DEGRADED)


class Modules:
    """Recovery modules that keep their contract, with the bus between them and the arbiter.

    Commands lie in `inbox` until the walk delivers them; a module reports on every change.
    """

    def __init__(self) -> None:
        self.inbox = {rm: [] for rm in RMS}
        self.phase = dict.fromkeys(RMS, RecoveryPhase.IDLE)
        self.decision = dict.fromkeys(RMS, 0)

    def deliver(self, rm: str) -> bool:
        """Obey the oldest command. Returns whether the module was cut off half-way by it."""
        if not self.inbox[rm]:
            return False
        command = self.inbox[rm].pop(0)
        if command.activate and command.decision != self.decision[rm]:
            self.phase[rm], self.decision[rm] = RecoveryPhase.ACTING, command.decision
        elif not command.activate:
            cut_off = self.phase[rm] is RecoveryPhase.ACTING
            self.phase[rm] = RecoveryPhase.IDLE
            return cut_off
        return False


ACTIONS = st.one_of(
    st.tuples(st.just("rise"), st.sampled_from(DMS)),
    st.tuples(st.just("fall"), st.sampled_from(DMS)),
    st.tuples(st.just("deliver"), st.sampled_from(RMS)),
    st.tuples(st.just("report"), st.sampled_from(RMS)),
    st.tuples(st.just("finish"), st.sampled_from(RMS)),
    st.tuples(st.just("fail"), st.sampled_from(RMS)),
    st.tuples(st.just("crash"), st.sampled_from(RMS)),
    st.tuples(st.just("reset"), st.sampled_from(RMS)),
    st.tuples(st.just("wait"), st.sampled_from([0.05, 0.3, 1.0])),
)


class Walk:
    def __init__(self) -> None:
        self.bench, self.modules = Bench(), Modules()
        self.crashed = self.failed = False

    def take(self, action: str, subject) -> None:
        bench, modules = self.bench, self.modules
        before, start, latched = bench.state, len(bench.log), set(bench.state.latched)
        granted = set()
        if action == "rise":
            bench.active(subject, "hmi")
        elif action == "fall":
            bench.idle(subject)
        elif action == "deliver":
            cut_off = modules.deliver(subject)
            track = before.recoveries[RMS.index(subject)]
            assert not cut_off or self.crashed or track.failure or self.failed, \
                f"{subject} was cut off"
        elif action == "finish" and modules.phase[subject] is RecoveryPhase.ACTING:
            modules.phase[subject] = RecoveryPhase.DONE
        elif action == "fail" and modules.phase[subject] is RecoveryPhase.ACTING:
            modules.phase[subject], self.failed = RecoveryPhase.FAILED, True
        elif action == "crash":
            modules.phase[subject], modules.decision[subject] = RecoveryPhase.IDLE, 0
            self.crashed = True
        elif action == "reset" and bench.reset(subject).granted:
            granted = {subject}
        elif action == "wait":
            bench.wait(subject)
            self.failed |= any(t.failure for t in bench.state.recoveries)
        if action in {"report", "finish", "fail", "crash"}:
            bench.report(subject, modules.phase[subject], modules.decision[subject])
        outputs = bench.log[start:]
        for output in outputs:
            if isinstance(output, Command):
                modules.inbox[output.recovery].append(output)
        self.check(before, outputs, latched - granted, one_step=action != "wait")
        if (action, subject) == ("rise", "DM1"):
            assert bench.state.desired["RM1"].activate  # in this very step

    def check(self, before, outputs, latched, *, one_step: bool) -> None:
        state = self.bench.state
        in_force = [t for t in state.recoveries if t.wanted and not t.draining]
        assert len(in_force) <= 1
        assert len(state.decision.recoveries) <= 1
        assert [t.name for t in in_force] in ([], list(state.decision.recoveries))
        for other in state.recoveries:
            if other.draining and in_force:
                assert not MECHANISMS.overlap(other.name, in_force[0].name)
                assert ORDER.is_above(in_force[0].name, other.name) or other.failure \
                    or before.recoveries[RMS.index(in_force[0].name)].wanted
        assert latched <= set(state.latched)
        assert not latched or state.decision.recoveries
        made = [o.number for o in outputs if isinstance(o, DecisionMade)]
        assert made == sorted(set(made))
        assert all(number > before.number for number in made)
        released = [i for i, o in enumerate(outputs) if isinstance(o, Command) and not o.activate]
        activated = [i for i, o in enumerate(outputs) if isinstance(o, Command) and o.activate]
        if one_step:
            assert not released or not activated or max(released) < min(activated)

    def calm_down(self) -> None:
        """Everybody goes on and does what they are told; the actor repeats what it wants."""
        for _ in range(200):
            for rm in RMS:
                self.modules.inbox[rm] = [self.bench.state.desired[rm]]
                self.take("deliver", rm)
                self.take("finish", rm)
                self.take("report", rm)
            self.take("wait", 0.05)


@given(st.lists(ACTIONS, min_size=20, max_size=80))
def test_invariants_hold_in_every_step(actions):
    walk = Walk()
    for action, subject in actions:
        walk.take(action, subject)


@settings(max_examples=10, deadline=None)
@given(st.lists(ACTIONS, max_size=40), st.sets(st.sampled_from(DMS)))
@example([*[("rise", "DM1")] * 3, ("fail", "RM1"), ("wait", 1.0), ("wait", 0.3), ("deliver", "RM1"),
          ("fail", "RM1")], {"DM7"})
def test_in_the_end_there_is_one_decision_and_it_is_carried_out(actions, remaining):
    walk = Walk()
    for action, subject in actions:
        walk.take(action, subject)
    walk.crashed = True  # the inbox is overwritten below, which is no fault of the arbiter
    for dm in DMS:
        walk.take("rise" if dm in remaining else "fall", dm)
    walk.calm_down()
    state = walk.bench.state
    assert {dm for name in state.active for dm in MECHANISMS.detect[name]} == remaining
    assert list(state.activated) == list(state.decision.recoveries)
    assert not any(track.draining for track in state.recoveries)
    assert bool(state.activated) == bool(remaining or state.latched)
    # One that has failed and stays in force has no stronger one to hand over to.
    ended = (*FINISHED, RecoveryPhase.FAILED) if walk.failed else FINISHED
    for rm in RMS:
        assert (walk.modules.phase[rm] in ended) == (rm in state.activated)
    if not remaining:
        for rm in state.latched:
            assert walk.bench.reset(rm).granted
        walk.calm_down()
        assert walk.bench.orders == ""
        assert walk.bench.state.decision.rule == 0


# -- belief in a detection module, as timelines: one character per 100 ms, report in,


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
    # never heard: the grace of two seconds, then silent
    ("-----------------------",
     ".....................SS"),
])
def test_timeline(reports, beliefs):
    assert beliefs == play(reports)


def heard(name: str, at_s: float, **changes) -> DetectionTrack:
    track = hear(DetectionTrack(name, heard_s=0.0), DetectionHeard(name, False), RULES, at_s)
    return msgspec.structs.replace(track, **changes)


def test_a_report_is_as_old_as_what_it_says_not_as_its_arrival():
    def said(stamp_s: float, active: bool = False) -> DetectionHeard:
        return DetectionHeard("DM", active, stamp_s=stamp_s)

    track = heard("DM", 10.0)
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
    tracks = tuple(heard(f"DM{i}", 10.0 - age_s) for i, age_s in enumerate(ages_s))
    which = overdue(tracks, RULES, 10.0)
    assert (which.name if which else None) == found


def test_one_that_was_never_heard_or_counts_as_silent_is_not_overdue():
    assert overdue((DetectionTrack("DM", heard_s=0.0),), RULES, 10.0) is None
    assert overdue((heard("DM", 9.0, silent=True),), RULES, 10.0) is None


@given(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 30)), min_size=1, max_size=20))
def test_however_it_flaps_it_is_released_within_the_bound(flaps):
    """No starvation: idle for `release_hold_max_s`, it is believed."""
    beliefs = play("".join("A" * a + "i" * i for a, i in flaps) + "i" * 31)
    assert beliefs.endswith(".")
    # And no thrashing: between two rises of belief lies at least one hold.
    assert ".A" in "." + beliefs


@given(st.text("Ai", min_size=1, max_size=80))
def test_an_active_report_is_always_believed_at_once(reports):
    for report, belief in zip(reports, play(reports), strict=True):
        assert report == "i" or belief == "A"


def test_without_hold_belief_follows_the_reports():
    rules = DetectionRules(1.0, 2.0, 0.0, 0.0)
    assert play("iAiAAiiA", rules) == ".A.AA..A"
