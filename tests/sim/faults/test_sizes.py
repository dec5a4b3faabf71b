"""How wrong a number is follows from its field, and the faults that a specification names."""

from __future__ import annotations

from random import Random
from typing import Annotated

import msgspec
import pytest

from rampart.actors.bus.messages import Injection, Message
from rampart.actors.runtime.corruption import corrupt
from rampart.manager.spec.specification import SpecificationError, parse_specification
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.topic_faults import Sizes, plausible_offsets
from tests import TANK


class Joint(Message, frozen=True):
    """Message of an arm's joint, without units of Osmosis."""

    torque: Annotated[float, msgspec.Meta(ge=-40, le=40)]
    valve: Annotated[float, msgspec.Meta(ge=0, le=1)]
    teeth: Annotated[int, msgspec.Meta(ge=0, le=100)]
    heat: Annotated[float, msgspec.Meta(extra={"unit": "degC"})]
    supply_v: float
    width_mm: float
    age_s: float
    load: Annotated[float, msgspec.Meta(ge=0)]
    share: float
    turns: int


EXPECTED = {"torque": (4.0, 24.0), "valve": (0.05, 0.3), "teeth": (1, 30), "heat": (5.0, 40.0),
            "supply_v": (1.0, 10.0), "width_mm": (5.0, 50.0), "age_s": (1.0, 10.0),
            "load": (0.1, 0.5), "share": (0.1, 0.5), "turns": (1, 3)}
GROWS = {"age_s", "load", "turns"}


def test_how_wrong_a_number_is_follows_from_its_range_or_its_unit():
    drawn = [plausible_offsets(Joint, Random(seed)) for seed in range(60)]
    for field, (least, most) in EXPECTED.items():
        found = [offsets[field] for offsets in drawn]
        assert all(least <= abs(offset) <= most for offset in found), field
        assert len({abs(offset) for offset in found}) > 2, field
        assert (min(found) > 0) == (field in GROWS), field


def test_a_robot_that_knows_better_says_so():
    sizes = Sizes((("_v", 100.0, 200.0), ("torque", 1.0, 2.0)), ("_v",))
    for seed in range(20):
        offsets = plausible_offsets(Joint, Random(seed), sizes)
        assert 100 <= offsets["supply_v"] <= 200
        assert 1 <= abs(offsets["torque"]) <= 2
        assert 0.05 <= abs(offsets["valve"]) <= 0.3


JOINT = Joint(39.0, 0.0, 99, 20.0, 24.0, 3.0, 1.0, 1.0, 0.5, 3)


@pytest.mark.parametrize(("field", "by", "wrong"), [
    ("torque", 10.0, 29.0), ("torque", -10.0, 29.0), ("valve", -0.2, 0.2), ("teeth", 20, 79),
    ("supply_v", 500.0, 524.0)])
def test_a_number_stays_within_its_range_and_is_wrong_all_the_same(field, by, wrong):
    order = Injection("i", "arm/joint", "corrupt", 1.0, add_fields={field: by})
    assert getattr(corrupt(JOINT, order, 0.0, Random(1)), field) == wrong


FAULT = """
[[fault]]
name = "trigger-lost"
title = "Nobody can trigger D_LEVEL"
topic = "detection/D_LEVEL"
mode = "stuck"
kind = "sensor"
detected_by = ["D_LEVEL"]
"""


def tank(*changes: tuple[str, str], more: str = ""):
    text = FAULT
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    return parse_specification(TANK + text + more, "tank.toml")


def test_a_fault_that_the_specification_names_is_found_listed_and_drawn():
    spec = tank()
    faults = faults_of(spec)
    found = faults.find("trigger-lost", 3, ())
    assert [(d.topic, d.mode) for d in found.disturbances] == [("detection/D_LEVEL", "stuck")]
    assert (found.detected_by, found.duration_s, found.group) == (("D_LEVEL",), 10.0, "sensor")
    assert faults.kinds["sensor"] == "sensor faults"
    assert fault_groups(spec)["sensor"] == ("trigger-lost",)
    assert "trigger-lost" in {fault.name for fault in faults.offered()}
    assert "sensor" not in fault_groups(parse_specification(TANK, "tank.toml"))


@pytest.mark.parametrize(("change", "line"), [
    (('"stuck"', '"stcuk"'), "fault trigger-lost: mode = 'stcuk': expected one of drop, freeze, "
     "stuck, delay, duplicate, restamp, corrupt"),
    (('"detection/D_LEVEL"', '"detecton/D_LEVEL"'), "fault trigger-lost: topic = 'detecton/D_LEVEL'"
     ": no node publishes it; the nearest: detection/D_LEVEL, "),
    (('"detection/D_LEVEL"', '"inject/order"'), "fault trigger-lost: it carries the injections "
     "themselves"),
    (('mode = "stuck"', 'mode = "corrupt"\nadd = { levl_m = 1.0 }'), "fault trigger-lost: field "
     "'levl_m': unknown in DetectionReport; known: "),
])
def test_a_fault_that_makes_no_sense_in_the_system(change, line):
    with pytest.raises(ValueError, match=r".") as caught:
        faults_of(tank(change))
    assert str(caught.value).startswith(line)


@pytest.mark.parametrize(("change", "line"), [
    (('["D_LEVEL"]', '["D_LEVLE"]'), "tank.toml: fault trigger-lost: detected_by[0] = 'D_LEVLE': "),
    (('"trigger-lost"', '"Lost"'), "tank.toml: $.fault[0].name = 'Lost': expected a name: "),
    (('mode = "stuck"', 'mode = "stuck"\nduration_s = 0'), "tank.toml: fault trigger-lost: dura"),
])
def test_a_fault_that_is_written_wrongly(change, line):
    with pytest.raises(SpecificationError) as caught:
        tank(change)
    assert str(caught.value).startswith(line)
    with pytest.raises(SpecificationError, match="duplicate name, already at"):
        tank(more=FAULT)
