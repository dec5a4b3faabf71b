"""What the operator orders from the page: faults and strategies, and what becomes of them."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.operator.adaptation import GIVE_UP_S, StrategyChoice
from rampart.actors.operator.injection import (
    LATE_END_S,
    MAX_WAITING,
    TAKE_HOLD_S,
    Injections,
    places_of,
)
from rampart.actors.operator.requests import RefusedError
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.fault_watch import Order
from rampart.actors.runtime.injection import MODES, flaw
from rampart.actors.runtime.run_plan import RunPlan
from rampart.cli import systems
from rampart.sim.faults.disturbance import Disturbance, Fault
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.topic_faults import modes_of
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from tests.porter_actors import write_porter_system

BUSY = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
OFFERED = OsmosisFaults().offered()
KEYS = places_of(systems.load("osmosis"))


def injections() -> Injections:
    return Injections("r1/hmi.1", OFFERED, KEYS, topics.ROBOT)


def report(order, affected: int = 0, *, finished: bool = False, reason: str = "",
           node: str = "localization") -> bm.InjectionReport:
    return bm.InjectionReport(order.injection, node, affected, finished, reason)


def test_a_fault_is_sent_until_its_publisher_reports_and_its_effect_is_told_once():
    faults = injections()
    ordered = faults.order("localization-not-updated", 0.0, None, 5.0)
    (order,) = faults.due(5.0)
    assert order.topic is bus_topics.INJECT
    assert (order.message.topic, order.message.mode, order.message.duration_s) == (
        "localization/pose", "freeze", 10.0)
    assert faults.due(5.5) == [order]
    assert faults.take(report(order)) == ""
    assert faults.due(6.0) == []
    assert faults.take(report(order, 1)) == "fault localization-not-updated takes effect"
    assert faults.take(report(order, 1)) == ""
    told = faults.take(report(order, 200, finished=True))
    assert told == "fault localization-not-updated: over, 200 messages changed"
    assert (ordered.effective, faults.view(16.0)[0]["ended"]) == (True, True)


def test_a_fault_that_changes_nothing_is_called_without_effect():
    faults = injections()
    faults.order("freeze:plan/route", 0.0, 2.0, 0.0)
    (order,) = faults.due(0.0)
    faults.take(report(order))
    assert faults.take(report(order, 0, finished=True)) == (
        "fault freeze:plan/route: no effect: no message was sent")


def test_a_fault_that_nobody_takes_says_so():
    faults = injections()
    faults.order("drop:summit_xl/upper_scan", 0.0, 5.0, 0.0)
    assert faults.expire(TAKE_HOLD_S - 0.1) == []
    (told,) = faults.expire(TAKE_HOLD_S + 0.1)
    assert "no effect: no publisher of summit_xl/upper_scan answers" in told
    assert faults.due(TAKE_HOLD_S + 0.2) == []


def test_a_fault_whose_publisher_is_restarted_ends_all_the_same():
    faults = injections()
    faults.order("gps-bias", 0.0, 3.0, 0.0)
    (order,) = faults.due(0.0)
    faults.take(report(order, 7))
    assert faults.expire(3.0 + LATE_END_S - 0.1) == []
    (told,) = faults.expire(3.0 + LATE_END_S + 0.1)
    assert "over, 7 messages changed; its publisher was restarted and did not report" in told


def test_a_planned_fault_waits_for_its_time_and_can_be_withdrawn():
    faults = injections()
    ordered = faults.order("gps-bias", 20.0, None, 5.0)
    assert faults.due(24.9) == []
    assert faults.view(10.0)[0]["state"] == "begins at 25 s"
    withdrawn = faults.order("gps-bias", 20.0, None, 5.0)
    assert faults.end(withdrawn.injection, 6.0)[0].message.duration_s == 0.0
    with pytest.raises(RefusedError, match=r"no fault .* is active"):
        faults.end(withdrawn.injection, 7.0)
    (order,) = faults.due(25.0)
    assert order.place == "summit_xl/gps"
    assert order.injection.startswith(ordered.injection)


def test_a_permanent_fault_is_ended_on_request_and_the_order_repeated_until_that_is_reported():
    faults = injections()
    ordered = faults.order("drop:localization/pose", 0.0, math.inf, 0.0)
    (order,) = faults.due(0.0)
    assert math.isinf(order.message.duration_s)
    faults.take(report(order, 9))
    faults.expire(1e6)
    assert not faults.view(1e6)[0]["ended"]
    faults.end(ordered.injection, 50.0)
    (again,) = faults.due(50.5)
    assert (again.injection, again.message.duration_s) == (order.injection, 0.0)
    assert "over, 12 messages" in faults.take(report(again, 12, finished=True))


@pytest.mark.parametrize(("fault", "why"), [
    ("no-such", "no fault 'no-such'"), ("explode:localization/pose", "mode 'explode'"),
    ("drop:world/truth", "no such topic"), ("drop:inject/order", "no such topic"),
    ("corrupt:localization/pose", "mode 'corrupt'"), ("drop:", "no such topic"),
    ("drop:detection/DM99", "no such topic"), ("", "no fault ''"),
])
def test_what_cannot_be_injected_is_refused_by_name(fault, why):
    with pytest.raises(RefusedError, match=why):
        injections().order(fault, 0.0, None, 0.0)


def test_only_so_many_faults_wait_at_once_and_the_list_stays_short():
    faults = injections()
    for _ in range(MAX_WAITING):
        faults.order("gps-bias", 100.0, None, 0.0)
    with pytest.raises(RefusedError, match="16 faults are active"):
        faults.order("gps-bias", 0.0, None, 0.0)
    for i in range(100):
        faults.expire(1000.0 * (i + 1))
        faults.order("gps-bias", 0.0, None, 1000.0 * (i + 1))
    assert len(faults.view(0.0)) <= 21


def test_all_that_is_offered_survives_the_plan_and_is_sound():
    assert msgspec.json.decode(msgspec.json.encode(OFFERED), type=tuple[fm.NamedFault, ...]) == (
        OFFERED)
    faults = injections()
    assert {f.group for f in OFFERED} == {"paper", "sensor", "frozen", "actuator"}
    for offered in OFFERED:
        ordered = faults.order(offered.name, 0.0, None, 0.0)
        for order in ordered.orders:
            assert ordered.injection in order.injection
            if isinstance(order.message, bm.Injection):
                assert flaw(order.message) == ""
        faults.end(ordered.injection, 0.0)


class ForEver(Faults):
    """Both kinds of faults, and both last for ever unless told otherwise."""

    named = {"frozen": Fault("frozen", "", (Disturbance("localization/pose", "freeze"),), (),
                             math.inf, "sensor")}
    titled = {"no-brakes": ("actuator", "the brakes are gone")}

    def own(self, fault, injection, duration_s):
        lasts_s = math.inf if duration_s is None else duration_s
        return (Order(topics.ACTUATOR_FAULT, m.ActuatorFault(
            injection, m.ActuatorFaultKind.BRAKE_FAILURE, "", 0.0, lasts_s)),)


def test_a_fault_that_lasts_for_ever_survives_the_plan_which_has_no_infinity():
    plan = msgspec.json.decode(msgspec.json.encode(RunPlan(faults=ForEver().offered())),
                               type=RunPlan)
    faults = Injections("r1", plan.faults, KEYS, topics.ROBOT)
    assert [fault["duration_s"] for fault in faults.choice()["faults"]] == [None, None]
    for name in ("frozen", "no-brakes"):
        for lasts_s, expected_s in ((None, math.inf), (4.0, 4.0)):
            ordered = faults.order(name, 0.0, lasts_s, 0.0)
            assert ordered.duration_s == expected_s
            assert [order.message.duration_s for order in ordered.orders] == [expected_s]


def test_no_place_is_offered_that_must_not_be_disturbed():
    assert set(KEYS) >= {"localization/pose", "detection/DM1", "recovery/RM1/command",
                         "heartbeat/localization"}
    assert all(modes_of(key, topics.ALL) for key in KEYS)
    assert set(injections().choice()["modes"]) < set(MODES)


def test_the_robot_s_own_topics_are_offered(tmp_path):
    shipped = places_of(systems.load("osmosis"))
    own = places_of(systems.load(str(write_porter_system(tmp_path))))
    assert set(own) - set(shipped) == {
        "heartbeat/platform", "heartbeat/display", "porter/load", "porter/axle/front",
        "porter/axle/rear"}
    assert not [key for key in shipped if key.startswith("porter/")]


@BUSY
@given(st.lists(st.tuples(st.sampled_from(["report", "order", "expire", "end"]),
                          st.integers(0, 5), st.floats(0, 5)), max_size=30))
def test_each_fault_is_concluded_once_whatever_is_reported(events):
    faults, now_s, told = injections(), 0.0, []
    names: list[str] = []
    for kind, number, pause_s in events:
        now_s += pause_s
        if kind == "order" and len(names) < MAX_WAITING:
            names.append(faults.order("gps-bias", 0.0, 3.0, now_s).injection)
        elif kind == "report" and names:
            name = names[number % len(names)]
            told.append(faults.take(bm.InjectionReport(
                f"{name}.1", "simulator", number, number > 3, "")))
        elif kind == "end" and names:
            try:
                faults.end(names[number % len(names)], now_s)
            except RefusedError:
                continue
        else:
            told += faults.expire(now_s)
    faults.expire(now_s + 100.0)
    assert all(fault["ended"] for fault in faults.view(now_s + 100.0))
    assert sum("over" in text or "no effect" in text for text in told) <= len(names)


# ---- strategies ---------------------------------------------------------------------------------

NAMES = ("safety-first", "mission-first")


def test_a_strategy_that_nobody_sets_is_withdrawn():
    choice = StrategyChoice("p", "operator", NAMES)
    choice.ask("mission-first", "", 0.0)
    assert choice.expire(GIVE_UP_S - 0.1) == ""
    assert "no answer from the FTM Manager" in choice.expire(GIVE_UP_S)
    assert choice.pending is None
