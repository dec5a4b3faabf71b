"""What a page may say, and how much of it."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.operator.limits import BURST, PATIENCE, RATE_HZ, MessageBudget, Verdict
from rampart.actors.operator.requests import (
    InjectRequest,
    RequestError,
    RequestReader,
    StickRequest,
)
from rampart.actors.osmosis.page.requests import OSMOSIS_REQUESTS

READ = RequestReader(OSMOSIS_REQUESTS).read
BUSY = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


def test_a_page_that_drives_and_draws_is_never_stopped():
    budget = MessageBudget(0.0)
    assert {budget.spend(i / 45) for i in range(5000)} == {Verdict.READ}


def test_a_page_may_send_a_burst_after_a_pause():
    budget = MessageBudget(0.0)
    assert [budget.spend(0.0) for _ in range(BURST)] == [Verdict.READ] * BURST
    assert budget.spend(0.0) is Verdict.TELL
    assert budget.spend(10.0) is Verdict.READ


def test_a_page_that_floods_is_told_once_and_closed_if_it_goes_on():
    budget = MessageBudget(0.0)
    got = [budget.spend(0.0) for _ in range(BURST + PATIENCE + 1)]
    assert got == [Verdict.READ] * BURST + [Verdict.TELL] + [Verdict.DROP] * (PATIENCE - 1) + [
        Verdict.CLOSE]


def test_a_page_that_stops_flooding_is_forgiven_and_told_again_the_next_time():
    budget = MessageBudget(0.0)
    for at_s in (0.0, 100.0):
        got = [budget.spend(at_s) for _ in range(BURST + 10)]
        assert got.count(Verdict.TELL) == 1
        assert Verdict.CLOSE not in got


@BUSY
@given(st.lists(st.floats(0, 0.1), max_size=400))
def test_no_more_is_read_than_the_rate_allows(pauses):
    budget, now_s, read = MessageBudget(0.0), 0.0, 0
    for pause in pauses:
        now_s += pause
        read += budget.spend(now_s) is Verdict.READ
    assert read <= BURST + RATE_HZ * now_s + 1


@BUSY
@given(st.binary(max_size=200) | st.text(max_size=200))
def test_garbage_is_no_request_and_nothing_worse(garbage):
    with pytest.raises(RequestError, match="not understood"):
        READ(garbage)


SCALARS = st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=10)


@BUSY
@given(st.dictionaries(st.sampled_from(
    ["held", "ticket", "forward", "left", "extra"]), SCALARS))
def test_a_stick_message_of_any_content_is_a_sound_request_or_none(fields):
    clean = {k: v for k, v in fields.items() if not (isinstance(v, float) and not math.isfinite(v))}
    try:
        request = READ(msgspec.json.encode({"type": "stick", "panel": "Drive", **clean}) if all(
            not isinstance(v, int) or abs(v) < 2**63 for v in clean.values()) else b"")
    except RequestError:
        return
    assert isinstance(request, StickRequest)
    assert type(request.held) is bool
    assert math.isfinite(request.forward + request.left)


@pytest.mark.parametrize("text", [
    '{"type":"stick","panel":"Drive","held":true,"forward":NaN}',
    '{"type":"stick","panel":"Drive","held":true,"forward":1e999}',
    '{"type":"stick","panel":7,"held":true}', '{"type":"stick","held":true}',
    '{"type":"stick","panel":"Drive","held":1}', '{"type":"stick"}',
    '{"type":"inject","fault":"x","delay_s":-1}',
    '{"type":"inject","fault":"x","duration_s":0}',
    '{"type":"inject","fault":"x","duration_s":1e9}',
    '{"type":"signal","node":"hmi"}', '{"type":"strategy","name":7}',
    '{"type":"signal","node":"' + "x" * 201 + '","signal":"KILL"}',
    '{"type":"end-fault"}', '{"type":"sudo"}',
])
def test_a_request_with_a_wrong_field_is_refused(text):
    with pytest.raises(RequestError):
        READ(text)


def test_what_is_left_out_of_a_fault_is_its_own():
    assert READ('{"type":"inject","fault":"gps-bias"}') == InjectRequest("gps-bias", 0.0, None)
