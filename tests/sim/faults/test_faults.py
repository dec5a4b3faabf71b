"""The catalogue of faults: each has the named effect on a real message of its topic."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from dataclasses import replace
from random import Random
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import inspect

from rampart.actors.bus.envelope import Header, decode, encode
from rampart.actors.bus.messages import Injection, Message
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, Context, on
from rampart.actors.runtime.corruption import corrupt
from rampart.actors.runtime.injection import MODES, FaultGate
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.system.layout import published_keys
from rampart.cli import systems
from rampart.cli.look.topic_verbs import resolve
from rampart.manager.spec.specification import SpecificationError, parse_specification
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults import topic_faults
from rampart.sim.faults.faults import Faults, faults_of
from rampart.sim.faults.injector import Injector, can_be_hit
from rampart.sim.faults.scenario import OnProcess, PlannedFault, ScenarioError, parse_fault
from rampart.sim.faults.scenario import action_of as action_in
from rampart.sim.faults.topic_faults import Disturbance, Fault, UnknownFaultError
from rampart.sim.osmosis.trial.faults import PAPER_FAULTS, OsmosisFaults, SuddenObstacle
from rampart.testing import VirtualSystem, run
from tests import TANK
from tests.fuzz.message_extremes import filled
from tests.osmosis_system import shipped_system
from tests.porter_actors import AXLE, LOAD
from tests.two_hosts import two_hosts

KEYS = published_keys(shipped_system())
CATALOGUE = OsmosisFaults.named
SYSTEMATIC = {fault.name: fault for fault in topic_faults.systematic_faults(KEYS, topics.ALL)}


def find_fault(name: str, seed: int = 0, known: tuple[Topic[Any], ...] = topics.ALL) -> Fault:
    return OsmosisFaults().find(name, seed, known)


def topic_fault(mode: str, key: str, seed: int = 0) -> Fault:
    return topic_faults.topic_fault(mode, key, seed, topics.ALL, OsmosisFaults.sizes)


def sample(kind: Any, n: int) -> Any:
    """Return a message of a type; another one for each n, as a node that lives would publish."""
    array = np.array([1.0 + n, 2.0 + n, 3.0 + n], dtype="<f4").tobytes()
    return msgspec.convert(filled(inspect.type_info(kind), f"text {n}", 10 + n, 3, array), kind,
                           builtin_types=(bytes,), strict=False)


class Publisher:
    """Publishes sample after sample on the topic of a disturbance, four times a second."""

    def __init__(self, disturbance: Disturbance) -> None:
        self.topic, self.key = resolve(disturbance.topic, topics.ALL)
        self.gate = FaultGate()
        self.now_s = 0.0
        self.n = 0
        self.next()
        self.next()
        self.order = disturbance.order("i", math.inf)
        assert self.gate.order(self.order, self.now_s, self.topic.type) == ""

    def next(self) -> tuple[Any, Any]:
        """Return the message of the node, and the message that left it."""
        self.n += 1
        self.now_s += 0.25
        body = sample(self.topic.type, self.n)
        out = self.gate.apply(self.key, body, self.now_s, self.now_s)
        if out is not None:
            self.gate.last[self.key] = (out.body, out.stamp)
        return body, out


def travels(topic: Topic[Any], body: Any) -> bool:
    """Whether a reader would admit the body."""
    payload = encode(Header("n", 1, 1, 0.0), body)
    return type(decode(topic, payload)[1]) is topic.type


KINDS = {"named": list(CATALOGUE)}
for each in SYSTEMATIC:
    KINDS.setdefault(each.partition(":")[0], []).append(each)


@pytest.mark.parametrize("kind", KINDS)
def test_every_fault_changes_real_messages_of_its_topic_and_leaves_them_readable(kind):
    for name in KINDS[kind]:
        fault = find_fault(name)
        assert (fault.name, "\n" in fault.title, fault.group in OsmosisFaults.kinds) == (
            name, False, True)
        assert fault.title
        assert all(order.duration_s > 0 for order in fault.orders("i"))
        for disturbance in fault.disturbances:
            publisher = Publisher(disturbance)
            pairs = [publisher.next() for _ in range(4)]
            assert publisher.gate.expire("i") > 0, name
            for body, out in pairs:
                if disturbance.mode == "drop":
                    assert out is None
                    continue
                assert travels(publisher.topic, out.body), name
                if disturbance.mode in ("delay", "duplicate", "restamp"):
                    assert out.body == body
            assert [why for _, _, why in publisher.gate.take_news() if why] == []


# -- generic corruption --------------------------------------------------------------------------


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each plain value of a message by its place; an array is its numbers."""
    if isinstance(value, bytes):
        value = np.frombuffer(value, "<f4").tolist()
    if not isinstance(value, dict | list | tuple):
        yield place, value
        return
    for name, part in value.items() if isinstance(value, dict) else enumerate(value):
        yield from leaves(part, f"{place}.{name}")


def is_number(place: str, value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) \
        and not place.endswith(".pid")


def test_a_corrupted_message_is_wrong_in_every_number_and_in_nothing_else():
    for name in KINDS["corrupt"]:
        body, out = Publisher(SYSTEMATIC[name].disturbances[0]).next()
        before, after = (dict(leaves(msgspec.to_builtins(said, builtin_types=(bytes,))))
                         for said in (body, out.body))
        assert before.keys() == after.keys()
        numbers = {place for place, value in before.items() if is_number(place, value)}
        assert numbers, name
        assert {place for place in before if before[place] != after[place]} == numbers, name
        assert all(abs(after[place] - before[place]) >= 0.1 for place in numbers), name


def test_an_odd_seed_corrupts_one_number_and_all_have_their_turn():
    every = set(topic_fault("corrupt", "summit_xl/scan").disturbances[0].add_fields)
    alone = [topic_fault("corrupt", "summit_xl/scan", seed) for seed in range(1, 200, 2)]
    assert every == {path for fault in alone for path in fault.disturbances[0].add_fields}
    assert "ranges_f32" in every
    for fault in alone:
        (path,) = fault.disturbances[0].add_fields
        assert fault.title == f"{path} on summit_xl/scan is wrong by a constant"


def test_nonsense_comes_from_what_measures_and_not_from_what_decides():
    measured = {name.partition(":")[2] for name in SYSTEMATIC if name.startswith("zero:")}
    assert measured >= {t.key for t in (
        topics.SCAN, topics.UPPER_SCAN, topics.GPS, topics.IMU, topics.ODOMETRY, topics.LIGHT,
        topics.ABSOLUTE_POSE, topics.BASE_STATUS, topics.JOYSTICK, topics.POSE)}
    assert not measured & {"mission/goal", "plan/route", "manager/status", "supervisor/nodes"}
    with pytest.raises(UnknownFaultError, match="carries no readings"):
        find_fault("zero:plan/route")


def test_a_wrong_stamp_comes_from_its_seed_ahead_as_often_as_behind_small_as_often_as_large():
    errors_s, again_s = ([topic_fault("restamp", "summit_xl/scan", seed).disturbances[0].stamp_s
                          for seed in range(400)] for _ in range(2))
    assert errors_s == again_s
    assert all(0.02 <= abs(error_s) <= 5.0 for error_s in errors_s)
    assert 150 < sum(error_s > 0 for error_s in errors_s) < 250
    assert 150 < sum(abs(error_s) < 0.316 for error_s in errors_s) < 250


def test_a_stuck_sensor_has_fresh_stamps_and_a_frozen_one_has_not():
    for name, stamps in (("gps-stuck", [0.75, 1.0]), ("freeze:summit_xl/gps", [0.5, 0.5])):
        publisher = Publisher(find_fault(name).disturbances[0])
        outs = [publisher.next()[1] for _ in range(2)]
        assert [out.body for out in outs] == [sample(m.GpsFix, 2)] * 2
        assert [out.stamp for out in outs] == stamps


# -- finding and varying ---------------------------------------------------------------------------


def test_the_names_of_the_papers_faults_are_a_contract():
    assert list(PAPER_FAULTS) == [
        "command-not-updated", "command-out-of-bounds", "localization-not-updated",
        "prohibited-area", "wrong-graph"]


@pytest.mark.parametrize(("name", "words"), [
    ("gremlins", "`rampart inject --list`"), ("gps-biass", "did you mean gps-bias?"),
    ("melt:plan/route", "the mode must be one of drop"),
    ("drop:", "no topic has this key"), ("drop:detection/*", "no topic has this key"),
    ("drop:world/truth", "the judge"),
    ("drop:inject/order", "injections themselves"),
])
def test_a_fault_that_is_none_is_refused_in_one_line_that_says_why(name, words):
    with pytest.raises(UnknownFaultError, match=r"^[^\n]*$") as caught:
        find_fault(name)
    assert words in str(caught.value)
    assert repr(name) in str(caught.value)
    assert len(str(caught.value)) < 200


def test_a_varied_fault_differs_in_what_was_said_and_each_disturbance_has_a_seed_of_its_own():
    fault = Fault("both", "t", (Disturbance("a", "drop"), Disturbance("b", "drop", share=0.5)),
                  (), 5.0)
    varied = fault.varied(on_s=1.0, off_s=2.0, seed=7)
    first, second = varied.orders("i", math.inf)
    assert (first.injection, second.injection) == ("i.1", "i.2")
    assert (first.share, first.on_s, first.off_s, first.seed) == (1.0, 1.0, 2.0, 7)
    assert (second.share, second.on_s, second.off_s, second.seed) == (0.5, 1.0, 2.0, 8)
    assert first.duration_s == math.inf
    assert fault.varied() == fault


def test_a_topic_of_the_robot_s_own_fails_like_any_other_unless_its_numbers_have_no_names():
    known = (*topics.ALL, LOAD, AXLE)
    assert topic_faults.modes_of("porter/load", known) == (
        *MODES, "zero", "negative", "huge", "infinite", "nan")
    assert find_fault("drop:porter/axle/front", known=known).disturbances[0].topic == (
        "porter/axle/front")
    (disturbance,) = find_fault("corrupt:porter/load", 3, known).disturbances
    assert set(disturbance.add_fields) == {"mass_kg"}
    assert set(MODES) - set(topic_faults.modes_of("porter/axle/front", known)) == {"corrupt"}
    with pytest.raises(UnknownFaultError, match="Axle is array_like"):
        find_fault("corrupt:porter/axle/front", known=known)


# -- How wrong a number is follows from its field, and the faults that a specification names --


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
    drawn = [topic_faults.plausible_offsets(Joint, Random(seed)) for seed in range(60)]
    for field, (least, most) in EXPECTED.items():
        found = [offsets[field] for offsets in drawn]
        assert all(least <= abs(offset) <= most for offset in found), field
        assert len({abs(offset) for offset in found}) > 2, field
        assert (min(found) > 0) == (field in GROWS), field


def test_a_robot_that_knows_better_says_so():
    sizes = topic_faults.Sizes((("_v", 100.0, 200.0), ("torque", 1.0, 2.0)), ("_v",))
    for seed in range(20):
        offsets = topic_faults.plausible_offsets(Joint, Random(seed), sizes)
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
    (('["D_LEVEL"]', '["D_LEVLE"]'), "tank.toml: fault trigger-lost: detected_by[0] = 'D_LEVLE': "),
    (('"trigger-lost"', '"Lost"'), "tank.toml: $.fault[0].name = 'Lost': expected a name: "),
    (('mode = "stuck"', 'mode = "stuck"\nduration_s = 0'), "tank.toml: fault trigger-lost: dura"),
])
def test_a_fault_that_is_written_wrongly_or_makes_no_sense_in_the_system(change, line):
    with pytest.raises(ValueError, match=r".") as caught:
        faults_of(tank(change))
    assert str(caught.value).startswith(line)
    assert isinstance(caught.value, SpecificationError) is line.startswith("tank.toml")
    with pytest.raises(SpecificationError, match="duplicate name, already at"):
        tank(more=FAULT)


# -- Planned faults: how they are written, what they become, and what is refused --


SYSTEM = systems.load(None)
NODES = can_be_hit(SYSTEM)


def action_of(planned: PlannedFault, injection: str = "f1") -> object:
    return action_in(planned, injection, NODES, topics.ALL, OsmosisFaults())


@pytest.mark.parametrize(("text", "planned"), [
    ("gps-bias+5", PlannedFault("gps-bias", 10.0, duration_s=5.0)),
    ("laser-stuck@goal2:5+3", PlannedFault("laser-stuck", 5.0, 2, 3.0)),
    ("weak-wheel:rear-left:0.3@7", PlannedFault("weak-wheel:rear-left:0.3", 7.0)),
])
def test_what_is_typed_is_what_is_meant(text, planned):
    assert parse_fault(text) == planned


@pytest.mark.parametrize(("text", "words"), [
    ("@3", "must be FAULT"), ("x@-1", "WHEN '-1'"), ("x@inf", "WHEN 'inf'"), ("x@nan", "WHEN"),
    ("x@3+long", "DURATION 'long'"), ("x+", "DURATION ''"), ("x@goal0", "goals are counted from 1"),
    ("x@goalx", "goalx"), ("x@goal1:z", "WHEN 'z'"),
])
def test_what_makes_no_sense_is_refused_in_one_line(text, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        parse_fault(text)
    assert "\n" not in str(caught.value)


@given(st.sampled_from(["gps-bias", "kill:DM1", "drop:control/command"]),
       st.floats(0, 1e3).map(lambda x: round(x, 2)), st.integers(0, 5),
       st.none() | st.floats(0, 100).map(lambda x: round(x, 2)) | st.just(math.inf))
def test_text_and_plan_say_the_same(fault, at_s, goal, duration_s):
    planned = PlannedFault(fault, at_s, goal, duration_s)
    assert parse_fault(planned.text()) == planned


def test_every_fault_of_the_catalogue_becomes_an_action():
    groups = fault_groups(SYSTEM)
    kinds = {"paper": tuple, "sensor": tuple, "topic": tuple, "reading": tuple,
             "frozen": tuple, "process": OnProcess, "actuator": tuple, "world": SuddenObstacle}
    assert set(groups) == set(kinds)
    for group, names in groups.items():
        assert len(names) == len(set(names)) > 0
        for name in names:
            assert isinstance(action_of(PlannedFault(name)), kinds[group]), name


def test_faults_of_topics_carry_pattern_seed_and_duration():
    action = action_of(PlannedFault("gps-noise", 3.0, duration_s=math.inf, share=0.5, on_s=1.0,
                                    off_s=2.0, seed=9), "f7")
    order = action[0].message
    assert (order.injection, order.duration_s, order.share) == ("f7", math.inf, 0.5)
    assert (order.on_s, order.off_s, order.seed) == (1.0, 2.0, 9)


def test_all_processes_are_slow_at_once_and_none_is_killed_by_a_name_that_means_all():
    assert action_of(PlannedFault("slow:all:0.03", duration_s=5.0)) == OnProcess(
        "slow", "", 0.03, 5.0)
    assert action_of(PlannedFault("stop:all", duration_s=5.0)) == OnProcess("stop", "", 0.0, 5.0)
    with pytest.raises(ScenarioError, match="no node 'all'"):
        action_of(PlannedFault("kill:all"))


@pytest.mark.parametrize(("fault", "words"), [
    ("kill:nobody", "no node 'nobody' that a fault can hit; there are: supervisor, "),
    ("kill:simulator", "not the world"), ("slow:DM1:x", "must be one number between 0 and 60"),
    ("stuck-wheel:fifth", "unknown wheel 'fifth'; known: front-left"),
    ("brake-failure:0.1:2", "must be one number"), ("obstacle-ahead:far", "must be one number"),
])
def test_an_impossible_detail_is_refused(fault, words):
    with pytest.raises(ScenarioError, match=words):
        action_of(PlannedFault(fault))
    with pytest.raises(UnknownFaultError):
        action_of(PlannedFault("gremlins"))


# -- What runs on another host is hit by the supervisor there --


TWO_HOSTS = parse_specification(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}), "two.toml")


class Supervisor(Actor):
    """The supervisor of the other host, on which there is `hmi`, and `DM5` that may not be hit."""

    outputs = (ftm_topics.PROCESS_EVENT,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.orders: list[tuple[float, str, str]] = []

    @on(ftm_topics.SIGNAL)
    def signal(self, order: fm.SignalOrder, _header: Header) -> None:
        self.orders.append((round(self.clock.now(), 1), order.node, order.signal))
        if order.node in ("hmi", "DM5"):
            is_hit = order.node == "hmi"
            self.publish(ftm_topics.PROCESS_EVENT, fm.ProcessEvent(
                order.node, "signalled" if is_hit else "refused", 7 * is_hit, 1, order.order,
                "" if is_hit else "not permitted"))


@pytest.mark.parametrize(("fault", "orders", "affected", "reason"), [
    ("kill:hmi@1", [(1.0, "hmi", "KILL")], 1, ""),
    ("wedge:hmi@1", [(1.0, "hmi", "WEDGE")], 1, ""),
    ("stop:hmi@1+2", [(1.0, "hmi", "STOP"), (3.0, "hmi", "CONT")], 1, ""),
    ("kill:DM5@1", [(1.0, "DM5", "KILL")], 0, "DM5: not permitted"),
    ("kill:DM13@1", [(1.0, "DM13", "KILL")], 0, "no host has answered that it runs DM13"),
    ("kill:DM1@1", [], 1, ""),
])
def test_what_runs_on_another_host_is_hit_by_its_supervisor(fault, orders, affected, reason):
    async def scenario() -> None:
        async with VirtualSystem() as system:
            supervisor = system.start("supervisor_ground", Supervisor)
            context = replace(system.context("injector", {}), run=RunContext(system=TWO_HOSTS))
            injector = Injector(
                context, [parse_fault(fault)], lambda _what, node, _pace_s: node == "DM1",
                nodes=("hmi", "DM1", "DM5", "DM13"), known=(), faults=Faults())
            task = asyncio.create_task(injector.run())
            await asyncio.sleep(5.0)
            (outcome,) = injector.outcomes()
            assert (outcome.affected, outcome.reason) == (affected, reason)
            assert supervisor.orders == orders
            injector.stop()
            await task

    run(scenario)
