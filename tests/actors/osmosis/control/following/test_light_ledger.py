"""Which light is measured, who knows of it, and what is gone back for."""

from __future__ import annotations

import random

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.control.following.light_ledger import LightLedger
from rampart.actors.osmosis.control.polyline import Polyline

LIGHTS = tuple(Light(f"L{i}", "L", 4.0 * i, 0.0, 100.0) for i in range(1, 6))
ROW = Polyline([(0.0, 0.0), (24.0, 0.0)])


def measured(name: str) -> m.LightMeasurement:
    return m.LightMeasurement(name, 100.0, 1.0, m.LightVerdict.OK)


def shown(*names: str, mission_id: str = "x") -> m.MissionStatus:
    return m.MissionStatus(mission_id, "", m.MissionPhase.RUNNING, 0, (), (),
                           tuple(map(measured, names)), "")


@pytest.fixture
def ledger() -> LightLedger:
    made = LightLedger(LIGHTS)
    made.begin("x")
    return made


def test_the_lights_of_a_row_are_those_that_it_passes_over():
    lights = (*LIGHTS, Light("aside", "L", 8.0, 0.5, 1.0), Light("before", "L", -1.0, 0.0, 1.0),
              Light("beyond", "L", 24.3, 0.0, 1.0))
    row = LightLedger(lights).on_row(ROW)
    assert [name for _, name in row] == ["L1", "L2", "L3", "L4", "L5"]
    assert [s for s, _ in row] == pytest.approx([4, 8, 12, 16, 20])
    assert LightLedger(()).on_row(ROW) == ()


def test_a_measurement_is_sent_again_until_it_is_shown(ledger):
    ledger.add(measured("L1"), 0.0)
    ledger.confirm(shown("L2", mission_id="y"))
    assert ledger.judged == {"L1"}
    assert ledger.to_send_again(9.0) == []  # nobody has been heard of this mission
    assert ledger.detour(ledger.on_row(ROW), 10.0, ended=False) is None
    ledger.confirm(shown())
    assert ledger.to_send_again(0.4) == []  # it is on its way
    assert ledger.to_send_again(0.5) == [measured("L1")]
    assert ledger.to_send_again(0.6) == []
    assert ledger.to_send_again(1.0) == [measured("L1")]
    ledger.confirm(shown("L1"))
    assert ledger.to_send_again(9.0) == []


def test_a_light_passed_without_a_measurement_is_gone_back_for_and_then_given_up(ledger):
    row = ledger.on_row(ROW)
    ledger.confirm(shown())
    ledger.add(measured("L1"), 0.0)
    assert ledger.detour(row, 8.0, ended=False) is None  # the sensor is still over L2
    detour = ledger.detour(row, 9.0, ended=False)
    assert (detour.light, detour.to_s_m) == ("L2", pytest.approx(8 - 0.8 - 0.45 - 1.0))
    assert ledger.detour(row, 9.0, ended=False) is None  # passed for the second time
    assert ledger.kept.given_up == ("L2",)
    assert ledger.detour(row, 13.0, ended=False) is None  # blind: L3 is not gone back for
    assert ledger.kept.given_up == ("L2", "L3")
    assert ledger.add(measured("L4"), 0.0)
    assert ledger.detour(row, 22.0, ended=False).light == "L5"  # it sees again
    assert not ledger.is_complete(row)
    ledger.add(measured("L5"), 0.0)
    assert ledger.is_complete(row)


def test_lights_that_it_drives_round_are_left_out_without_taking_the_sensor_for_blind(ledger):
    row = ledger.on_row(ROW)
    ledger.confirm(shown())
    for step in range(40):
        ledger.leave_out(row, 6.0 + 0.1 * step)
    assert ledger.kept.given_up == ("L2",)
    assert ledger.detour(row, 14.0, ended=False).light == "L1"


def test_a_blind_sensor_costs_one_detour_and_every_other_fault_ends(ledger):
    """Random rows, sensors and deaths: each light ends up measured or given up, in bounded time."""
    for seed in range(60):
        dice = random.Random(seed)
        works = {light.name: dice.random() < 0.8 for light in LIGHTS}
        book, manager, s_m, detours = LightLedger(LIGHTS), [], 0.0, 0
        book.begin("x")
        row = book.on_row(ROW)
        missed = {light.name: dice.random() < 0.5 for light in LIGHTS}  # in the first pass
        for _ in range(2000):
            s_m = min(s_m + 0.2, 24.0)
            if dice.random() < 0.002:
                kept, book = book.kept, LightLedger(LIGHTS)
                book.restore(kept)
            book.confirm(shown(*manager))
            for at_m, name in row:
                if 0.9 <= s_m + 0.45 - at_m < 1.1:
                    if works[name] and not missed[name] and book.add(measured(name), 0.0):
                        manager.append(name)
                    missed[name] = False
            detour = book.detour(row, s_m, ended=s_m == 24.0)
            if detour:
                s_m, detours = detour.to_s_m, detours + 1
            if s_m == 24.0 and book.is_complete(row):
                break
        else:
            pytest.fail("it never ended")
        assert len(set(manager)) == len(manager)
        assert set(manager) | set(book.kept.given_up) == set(works)
        assert detours <= len(LIGHTS) + 4
        if all(works.values()):
            assert set(manager) == set(works)
