"""The arbiter's short way through the inputs of a system in which nothing is wrong."""

from __future__ import annotations

from unittest import mock

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.arbitration.arbiter import Arbiter, build_arbiter
from rampart.manager.arbitration.arbiter_state import RecoveryHeard, ResetAsked, Tick
from rampart.manager.arbitration.detection_track import DetectionHeard
from rampart.manager.model.mechanisms import RecoveryPhase
from tests.manager.bench import DMS, RMS, paper

STRATEGIES = ("safety-first", "mission-first", "simultaneous", "guarded-repair")
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


@given(st.sampled_from(STRATEGIES),
       st.lists(st.tuples(INPUTS, st.sampled_from([0.0, 0.05, 0.4, 3.0])), max_size=25))
def test_the_short_way_leads_where_the_long_way_does(strategy, walk):
    arbiter = build_arbiter(msgspec.structs.replace(paper(), strategy=strategy))
    state, now = arbiter.initial(0.0), 0.0
    for event, wait_s in [*((event, 0.0) for event in EVERYBODY), *walk]:
        now += wait_s
        short = arbiter.step(state, event, now)
        with mock.patch.object(Arbiter, "_is_quiet", return_value=False):
            assert arbiter.step(state, event, now) == short
        state = short[0]


def test_the_short_way_is_taken_while_all_is_well():
    arbiter = build_arbiter(paper())
    state = arbiter.initial(0.0)
    for event in EVERYBODY:
        state, _ = arbiter.step(state, event, 0.1)
    with mock.patch.object(Arbiter, "_settle", side_effect=AssertionError("the long way")):
        for event in EVERYBODY:
            state, outputs = arbiter.step(state, event, 0.2)
            assert outputs == ()
