"""What the operator orders from the page: faults, and what becomes of them."""

from __future__ import annotations

import math

import msgspec
import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.operator.injection import LATE_END_S, TAKE_HOLD_S, Injections, places_of
from rampart.actors.operator.requests import RefusedError
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.fault_watch import Order
from rampart.actors.runtime.injection import MODES, flaw
from rampart.actors.runtime.run_plan import RunPlan
from rampart.cli import systems
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.topic_faults import Disturbance, Fault, modes_of
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from tests.porter_actors import write_porter_system

OFFERED = OsmosisFaults().offered()
KEYS = places_of(systems.load("osmosis"))


@pytest.fixture
def faults() -> Injections:
    return Injections("r1/hmi.1", OFFERED, KEYS, topics.ROBOT)


def report(order, affected: int = 0, *, finished: bool = False) -> bm.InjectionReport:
    return bm.InjectionReport(order.injection, "localization", affected, finished, "")


def test_a_fault_is_sent_until_its_publisher_reports_and_its_effect_is_told_once(faults):
    ordered = faults.order("localization-not-updated", None, 5.0)
    (order,) = faults.due()
    assert order.topic is bus_topics.INJECT
    assert (order.message.topic, order.message.mode, order.message.duration_s) == (
        "localization/pose", "freeze", 10.0)
    assert faults.due() == [order]
    assert faults.take(report(order)) == ""
    assert faults.due() == []
    assert faults.take(report(order, 1)) == "fault localization-not-updated takes effect"
    assert faults.take(report(order, 1)) == ""
    told = faults.take(report(order, 200, finished=True))
    assert told == "fault localization-not-updated: over, 200 messages changed"
    assert (ordered.effective, faults.view()[0]["ended"]) == (True, True)


@pytest.mark.parametrize(("fault", "affected", "after_s", "words"), [
    ("freeze:plan/route", 0, None, "no effect: no message was sent"),
    ("drop:summit_xl/upper_scan", None, TAKE_HOLD_S,
     "no effect: no publisher of summit_xl/upper_scan answers"),
    ("gps-bias", 7, 3.0 + LATE_END_S,
     "over, 7 messages changed; its publisher was restarted and did not report")])
def test_a_fault_without_effect_answer_or_end_says_so(faults, fault, affected, after_s, words):
    faults.order(fault, 3.0, 0.0)
    (order,) = faults.due()
    if affected is not None:
        faults.take(report(order, affected))
    if after_s is None:
        told = faults.take(report(order, 0, finished=True))
    else:
        assert faults.expire(after_s - 0.1) == []
        (told,) = faults.expire(after_s + 0.1)
    assert f"fault {fault}: {words}" in told
    assert faults.due() == faults.expire(1e6) == []
    assert faults.take(report(order, 9, finished=True)) == ""  # it is concluded once


def test_a_permanent_fault_is_ended_on_request_and_the_order_repeated_until_that_is_reported(
        faults):
    ordered = faults.order("drop:localization/pose", math.inf, 0.0)
    (order,) = faults.due()
    assert math.isinf(order.message.duration_s)
    faults.take(report(order, 9))
    faults.expire(1e6)
    assert not faults.view()[0]["ended"]
    faults.end(ordered.injection, 50.0)
    (again,) = faults.due()
    assert (again.injection, again.message.duration_s) == (order.injection, 0.0)
    assert "over, 12 messages" in faults.take(report(again, 12, finished=True))
    with pytest.raises(RefusedError, match=r"no fault .* is active"):
        faults.end(ordered.injection, 51.0)


@pytest.mark.parametrize(("fault", "why"), [
    ("no-such", "no fault 'no-such'"), ("explode:localization/pose", "mode 'explode'"),
    ("drop:world/truth", "no such topic"), ("drop:inject/order", "no such topic"),
    ("corrupt:localization/pose", "mode 'corrupt'"), ("drop:", "no such topic"),
    ("drop:detection/DM99", "no such topic"), ("", "no fault ''"),
])
def test_what_cannot_be_injected_is_refused_by_name(faults, fault, why):
    with pytest.raises(RefusedError, match=why):
        faults.order(fault, None, 0.0)


class ForEver(Faults):
    """Both kinds of faults, and both last for ever unless told otherwise."""

    named = {"frozen": Fault("frozen", "", (Disturbance("localization/pose", "freeze"),), (),
                             math.inf, "sensor")}
    titled = {"no-brakes": ("actuator", "the brakes are gone")}

    def own(self, fault, injection, duration_s):
        lasts_s = math.inf if duration_s is None else duration_s
        return (Order(topics.ACTUATOR_FAULT, m.ActuatorFault(
            injection, m.ActuatorFaultKind.BRAKE_FAILURE, "", 0.0, lasts_s)),)


@pytest.mark.parametrize("offered", [OFFERED, ForEver().offered()], ids=["osmosis", "for ever"])
def test_all_that_is_offered_survives_the_plan_which_has_no_infinity_and_is_sound(offered):
    plan = msgspec.json.decode(msgspec.json.encode(RunPlan(faults=offered)), type=RunPlan)
    faults = Injections("r1", plan.faults, KEYS, topics.ROBOT)
    for fault in offered:
        own_s = math.inf if fault.duration_s is None else fault.duration_s
        for lasts_s, expected_s in ((None, own_s), (4.0, 4.0)):
            ordered = faults.order(fault.name, lasts_s, 0.0)
            assert ordered.duration_s == expected_s
            assert {order.message.duration_s for order in ordered.orders} == {expected_s}
            assert all(ordered.injection in order.injection for order in ordered.orders)
            assert not any(flaw(order.message) for order in ordered.orders
                           if isinstance(order.message, bm.Injection))
            faults.end(ordered.injection, 0.0)


def test_the_robot_s_own_topics_are_places_and_none_that_must_not_be_disturbed(tmp_path, faults):
    assert set(KEYS) >= {"localization/pose", "detection/DM1", "recovery/RM1/command",
                         "heartbeat/localization"}
    assert all(modes_of(key, topics.ALL) for key in KEYS)
    assert set(faults.choice()["modes"]) < set(MODES)
    own = places_of(systems.load(str(write_porter_system(tmp_path))))
    assert set(own) - set(KEYS) == {
        "heartbeat/platform", "heartbeat/display", "porter/load", "porter/axle/front",
        "porter/axle/rear"}


def test_the_list_of_faults_stays_short(faults):
    for now_s in range(0, 5000, 100):
        faults.order("gps-bias", 3.0, now_s)
        faults.expire(now_s + 50.0)
    assert len(faults.view()) <= 21
