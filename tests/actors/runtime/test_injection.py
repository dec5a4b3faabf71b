"""The fault gate: what each mode does to a message, when, and when that counts as an effect."""

import asyncio
import math
import random

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec import structs

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Injection
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, every
from rampart.actors.runtime.corruption import wrap
from rampart.actors.runtime.injection import FaultGate, flaw
from tests.osmosis_system import System
from tests.virtual_time import within

KEY = "rampart/localization/pose"
POSE = m.Pose(1.0, 2.0, 0.5)
ROUTE = m.Route("m", 0, m.Mode.TAXI, True, ((0.0, 0.0), (1.0, 5.0), (9.0, 9.0)), "")


def gate(mode: str, topic: str = "localization/pose", **fields: object) -> FaultGate:
    """Return a gate in which an injection began at 10 s."""
    found = FaultGate()
    assert found.order(Injection("i", topic, mode, 5.0, **fields), 10.0) == ""
    return found


def corrupted(body, at_s: float = 10.0, **fields: object):
    """Return a message as it leaves a gate that corrupts it."""
    found = gate("corrupt", **fields)
    out = found.apply(KEY, body, at_s, at_s)
    assert found.take_news() == [] or found.expire("i") > 0
    return out.body


def sent(faults: FaultGate, times_s) -> list[tuple[float, float, float, int] | None]:
    """Publish a pose with x = time at each time; return (x, stamp, delay, copies) of each."""
    found = []
    for t in times_s:
        out = faults.apply(KEY, m.Pose(t, 0.0, 0.0), t, t)
        if out is not None:
            faults.last[KEY] = (out.body, out.stamp)
        found.append(out and (out.body.x_m, out.stamp, out.delay_s, out.copies))
    return found


# -- the modes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "fields", "at_12", "at_13"), [
    ("drop", {}, None, None),
    ("freeze", {}, (11.0, 11.0, 0.0, 1), (11.0, 11.0, 0.0, 1)),
    ("stuck", {}, (11.0, 12.0, 0.0, 1), (11.0, 13.0, 0.0, 1)),
    ("delay", {"delay_s": 0.3}, (12.0, 12.0, 0.3, 1), (13.0, 13.0, 0.3, 1)),
    ("duplicate", {}, (12.0, 12.0, 0.0, 2), (13.0, 13.0, 0.0, 2)),
    ("restamp", {"stamp_s": -2.5}, (12.0, 9.5, 0.0, 1), (13.0, 10.5, 0.0, 1)),
    ("restamp", {"stamp_s": 0.5}, (12.0, 12.5, 0.0, 1), (13.0, 13.5, 0.0, 1)),
    ("corrupt", {"set_fields": {"x_m": 7}}, (7.0, 12.0, 0.0, 1), (7.0, 13.0, 0.0, 1)),
    ("corrupt", {"add_fields": {"x_m": 5.0}}, (17.0, 12.0, 0.0, 1), (18.0, 13.0, 0.0, 1)),
    ("corrupt", {"ramp_fields": {"x_m": 0.5}}, (12.25, 12.0, 0.0, 1), (13.75, 13.0, 0.0, 1)),
])
def test_each_mode_changes_what_it_says_and_nothing_else(mode, fields, at_12, at_13):
    faults = FaultGate()
    assert sent(faults, [10.0, 11.0]) == [(10.0, 10.0, 0.0, 1), (11.0, 11.0, 0.0, 1)]
    assert faults.order(Injection("i", "localization/pose", mode, 5.0, **fields), 11.5) == ""
    assert sent(faults, [12.0, 13.0]) == [at_12, at_13]
    goal = m.Goal(0.0, 0.0, m.Mode.TAXI)
    assert faults.apply("rampart/mission/goal", goal, 13.5, 13.5).body is goal
    assert faults.expire("i") == 2
    assert sent(faults, [14.0]) == [(14.0, 14.0, 0.0, 1)]
    assert faults.apply(KEY, POSE, 15.0, 15.0).body is POSE


# -- which messages ----------------------------------------------------------------------------


@pytest.mark.parametrize(("on_s", "off_s", "expected"), [
    # one character per 0.5 s from the injection on: x affected, . spared
    (1.0, 1.0, "xx..xx..xx..xx..xx..xx.."),
    (0.5, 2.0, "x....x....x....x....x..."),
    (2.5, 0.5, "xxxxx.xxxxx.xxxxx.xxxxx."),
    (0.0, 0.0, "xxxxxxxxxxxxxxxxxxxxxxxx"),
])
def test_an_intermittent_fault_comes_and_goes_from_the_moment_of_injection(on_s, off_s, expected):
    faults = gate("drop", on_s=on_s, off_s=off_s)
    times_s = [10.0 + 0.5 * i for i in range(len(expected))]
    assert "".join("x" if out is None else "." for out in sent(faults, times_s)) == expected
    assert faults.expire("i") == expected.count("x")


def test_an_intermittent_freeze_repeats_what_was_healthy_last():
    assert [x for x, *_ in sent(gate("stuck"), [10.0, 11.0])] == [10.0, 10.0]  # or what came first
    faults = gate("freeze", on_s=2.0, off_s=2.0)
    sent(faults, [9.0])
    out = sent(faults, [10.0, 11.0, 12.0, 13.0, 14.0, 15.0])
    assert [(x, stamp) for x, stamp, *_ in out] == [
        (9.0, 9.0), (9.0, 9.0), (12.0, 12.0), (13.0, 13.0), (13.0, 13.0), (13.0, 13.0)]


def test_faults_on_one_topic_act_in_the_order_in_which_they_were_ordered():
    faults = FaultGate()
    for name, mode, fields in (("a", "corrupt", {"set_fields": {"x_m": 4.0}}),
                               ("b", "corrupt", {"add_fields": {"x_m": 1.0}}),
                               ("c", "duplicate", {}), ("d", "delay", {"delay_s": 0.2})):
        assert faults.order(Injection(name, "localization/pose", mode, 5.0, **fields), 10.0) == ""
    out = faults.apply(KEY, POSE, 10.0, 10.0)
    assert (out.body.x_m, out.copies, out.delay_s) == (5.0, 2, 0.2)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_share_of_the_messages_is_affected_and_nothing_but_the_seed_says_which(share):
    count = 4000

    def spared(seed: int) -> list[bool]:
        random.random()
        return [out is not None for out in sent(gate("drop", share=share, seed=seed),
                                                [11.0] * count)]

    first = spared(1)
    four_sigma = 4 * math.sqrt(count * share * (1 - share))
    assert abs(count - sum(first) - share * count) <= four_sigma
    assert spared(1) == first
    assert (spared(2) == first) == (share in {0.0, 1.0})


def test_noise_has_the_spread_it_was_ordered_with_and_comes_from_the_seed():
    def noise(seed: int) -> np.ndarray:
        faults = gate("corrupt", noise_fields={"x_m": 0.5}, seed=seed)
        return np.array([faults.apply(KEY, POSE, 11.0, 11.0).body.x_m for _ in range(3000)])

    of_an_array = ranges(corrupted(scan([1.0] * 3000), noise_fields={"ranges_f32": 0.5}, seed=1))
    assert noise(1).tolist() == noise(1).tolist() != noise(2).tolist()
    for found in (noise(1), of_an_array):
        assert len(set(found.tolist())) > 2900
        assert np.mean(found) == pytest.approx(1.0, abs=4 * 0.5 / math.sqrt(3000))
        assert np.std(found) == pytest.approx(0.5, rel=0.06)


# -- corruption of each kind of field ------------------------------------------------------------


@pytest.mark.parametrize(("body", "fields", "expected"), [
    (m.Odometry(POSE, m.Twist(0.5, 0.0)), {"set_fields": {"pose.x_m": 7.0}},
     m.Odometry(m.Pose(7.0, 2.0, 0.5), m.Twist(0.5, 0.0))),
    (m.MissionRequest("m", "", (m.Goal(1.0, 2.0, m.Mode.TAXI), m.Goal(3.0, 4.0, m.Mode.TAXI))),
     {"add_fields": {"goals.x_m": 10.0}},
     m.MissionRequest("m", "", (m.Goal(11.0, 2.0, m.Mode.TAXI), m.Goal(13.0, 4.0, m.Mode.TAXI)))),
    (m.Imu(3.0, 0.0, 0.0, 0.0), {"add_fields": {"yaw_rad": 1.0}}, m.Imu(wrap(4.0), 0.0, 0.0, 0.0)),
    (ROUTE, {"set_fields": {"mode": "light verification", "active": False}},
     structs.replace(ROUTE, mode=m.Mode.LIGHT_VERIFICATION, active=False)),
    (ROUTE, {"keep_ends": ("waypoints",)},
     structs.replace(ROUTE, waypoints=((0.0, 0.0), (9.0, 9.0)))),
    (ROUTE, {"add_fields": {"waypoints": 1.0, "step": 2.0}},
     structs.replace(ROUTE, waypoints=((1.0, 1.0), (2.0, 6.0), (10.0, 10.0)), step=2)),
])
def test_a_field_is_found_by_its_path_through_structs_and_sequences(body, fields, expected):
    assert corrupted(body, **fields) == expected


def scan(ranges) -> m.LaserScan:
    return m.LaserScan(-1.0, 0.1, 8.0, np.asarray(ranges, dtype="<f4").tobytes())


def ranges(body: m.LaserScan) -> np.ndarray:
    return np.frombuffer(body.ranges_f32, dtype="<f4")


f32 = st.floats(-1e3, 1e3, width=32)


@given(values=st.lists(f32, max_size=20), fill=f32, rate=f32, bias=f32)
def test_an_array_is_filled_ramped_and_biased_element_by_element(values, fill, rate, bias):
    before = scan(values)
    elapsed_s = 2.0
    for fields, expected in (
            ({"set_fields": {"ranges_f32": fill}}, np.full(len(values), fill)),
            ({"ramp_fields": {"ranges_f32": rate}}, np.array(values) + rate * elapsed_s),
            ({"add_fields": {"ranges_f32": bias}}, np.array(values) + bias)):
        after = gate("corrupt", **fields).apply(KEY, before, 0.0, 10.0 + elapsed_s).body
        assert ranges(after).tolist() == expected.astype("<f4").tolist()
        assert after.range_max_m == before.range_max_m


@given(st.floats())
@example(math.nextafter(math.pi, 4))
@example(math.nextafter(-math.pi, -4))
def test_wrapping_ends_in_the_half_open_range_and_leaves_what_is_in_it(angle):
    wrapped = wrap(angle)
    if not math.isfinite(angle):
        assert wrapped is angle
    else:
        assert -math.pi < wrapped <= math.pi
        assert wrapped == angle or not -math.pi < angle <= math.pi
    assert wrap(-math.pi) == wrap(3 * math.pi) == math.pi == wrap(math.pi)


# -- what counts ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "fields", "affected"), [
    ("corrupt", {"set_fields": {"x_m": 1.0}}, 0),   # it has that value
    ("corrupt", {"add_fields": {"x_m": 0.0}}, 0),
    ("stuck", {}, 0),                               # it does not move anyway
    ("freeze", {}, 2),                              # same content, but the stamp is old
    ("duplicate", {}, 2),
    ("restamp", {"stamp_s": 0.1}, 2),
])
def test_a_message_that_leaves_as_it_came_is_not_affected(mode, fields, affected):
    faults = FaultGate()
    faults.last[KEY] = (POSE, 10.0)
    faults.order(Injection("i", "localization/pose", mode, 5.0, **fields), 10.5)
    for t in (11.0, 12.0):
        assert faults.apply(KEY, POSE, t, t).body == POSE
    assert len(faults.take_news()) == (affected > 0)
    assert faults.expire("i") == affected


def test_an_order_with_the_id_of_another_takes_its_place_and_keeps_its_count():
    faults = gate("drop")
    sent(faults, [11.0, 12.0])
    assert faults.order(Injection("i", "localization/pose", "duplicate", 5.0), 12.0) == ""
    assert sent(faults, [13.0]) == [(13.0, 13.0, 0.0, 2)]
    assert faults.expire("i") == 3
    assert faults.expire("i") == 0


# -- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "fields", "words"), [
    ("hug", {}, "mode = 'hug'"),
    ("drop", {"duration_s": math.nan}, "duration_s = nan"),
    ("delay", {"delay_s": math.inf}, "delay_s = inf"),
    ("delay", {}, "delay_s = 0"),
    ("restamp", {}, "stamp_s = 0"),
    ("drop", {"share": math.nan}, "share = nan"),
    ("drop", {"on_s": 1.0}, "on_s = 1, off_s = 0"),
    ("drop", {"topic": "inject/report"}, "topic = 'inject/report'"),
    ("corrupt", {}, "mode = 'corrupt'"),
    ("corrupt", {"add_fields": {"x_m": math.inf}}, "add_fields 'x_m' = inf"),
    ("corrupt", {"noise_fields": {"x_m": -1.0}}, "noise_fields 'x_m' = -1"),
    ("corrupt", {"set_fields": {"z_m": 1.0}}, "'z_m': unknown in Odometry; known: pose"),
    ("corrupt", {"set_fields": {"pose.x_m": "far"}}, "'pose.x_m' = 'far': Expected `float`"),
    ("corrupt", {"add_fields": {"pose": 1.0}}, "'pose': Pose, expected a number"),
    ("corrupt", {"keep_ends": ("pose",)}, "keep_ends 'pose'"),
])
def test_what_makes_no_sense_is_refused_for_one_reason_and_nothing_happens(mode, fields, words):
    order = Injection(**{"injection": "i", "topic": "summit_xl/odom", "mode": mode,
                         "duration_s": 1.0, **fields})
    faults = FaultGate()
    reason = faults.order(order, 0.0, m.Odometry)
    assert words in reason
    assert "\n" not in reason
    body = m.Odometry(POSE, m.Twist(0.5, 0.0))
    assert faults.apply(f"rampart/{order.topic}", body, 0.0, 0.0).body is body


@pytest.mark.parametrize(("kind", "fields", "fits"), [
    (m.LaserScan, {"set_fields": {"ranges_f32": b"1234"}}, True),
    (m.LaserScan, {"set_fields": {"ranges_f32": True}}, False),
    (m.Route, {"add_fields": {"step": 1.0}}, True),
    (m.Route, {"ramp_fields": {"step": 1.0}}, False),
    (m.Route, {"add_fields": {"active": 1.0}}, False),
    (m.Route, {"noise_fields": {"waypoints": 1.0}}, True),
])
def test_whether_a_change_fits_is_known_from_the_type_of_the_field(kind, fields, fits):
    assert (flaw(Injection("i", "t", "corrupt", 1.0, **fields), kind) == "") == fits


@pytest.mark.parametrize(("fields", "body", "words"), [
    ({"set_fields": {"z_m": 1.0}}, POSE, "'z_m': unknown"),
    ({"set_fields": {"x_m": "far"}}, POSE, "corrupt Pose"),
    ({"add_fields": {"ranges_f32": 1.0}}, m.LaserScan(0.0, 0.1, 8.0, b"12345"), "5 bytes"),
    ({"add_fields": {"reason": 1.0}}, ROUTE, "got str"),
])
def test_a_misfit_that_only_the_message_shows_ends_the_injection_and_leaves_the_message(
        fields, body, words):
    broken = gate("corrupt", **fields)
    assert broken.apply(KEY, body, 10.0, 10.0).body is body
    ((order, affected, reason),) = broken.take_news()
    assert (order.injection, affected) == ("i", 0)
    assert words in reason
    assert broken.in_force == {}
    assert broken.apply(KEY, body, 11.0, 11.0).body is body
    assert broken.take_news() == []
    assert broken.expire("i") == 0


# -- in living actors


class Talker(Actor):
    """Publishes a pose ten times a second."""

    outputs = (topics.POSE,)

    def on_start(self) -> None:
        self.said = 0

    @every(0.1)
    def speak(self) -> None:
        self.said += 1
        self.publish(topics.POSE, m.Pose(float(self.said), 0.0, 0.0))


class Scene(System):
    """A talker, and what passes on the wire."""

    async def __aenter__(self):
        await super().__aenter__()
        self.wire = self.hear(topics.POSE)
        self.reports = self.hear(bus_topics.INJECTION_REPORT)
        self.diagnostics = self.hear(bus_topics.DIAGNOSTIC)
        self.start("talker", Talker)
        await self.settle()
        return self

    @property
    def poses(self) -> list[float]:
        return [heard.message.x_m for heard in self.wire]

    @property
    def told(self) -> list[tuple[int, bool, str]]:
        """What was affected, whether it is over, and why, of each report."""
        return [(r.message.affected, r.message.finished, r.message.reason) for r in self.reports]


@within(Scene)
async def test_a_duplicate_is_the_same_payload_twice(scene):
    """So an actor handles it once: see the test of actors."""
    scene.inject(topics.POSE, "duplicate", 9.0)
    await asyncio.sleep(3.05)
    assert len(scene.wire) == 2 * 30
    assert scene.wire[::2] == scene.wire[1::2]
    sequences = [heard.header.sequence for heard in scene.wire[::2]]
    assert sequences == sorted(set(sequences))
    assert scene.poses[::2] == list(range(1, 31))


@pytest.mark.parametrize(("duration_s", "ended_s", "end", "heard"), [
    (0.95, None, [(9, True, "")], range(10, 60)),
    (5.0, 1.05, [(0, False, ""), (10, True, "")], range(11, 60)),  # by an order without one
    (math.inf, None, [], [])])
@within(Scene)
async def test_a_fault_reports_its_order_its_first_effect_and_once_its_end(
        scene, duration_s, ended_s, end, heard):
    scene.inject(topics.POSE, "drop", duration_s)
    if ended_s:
        await asyncio.sleep(ended_s)
        scene.inject(topics.POSE, "drop", 0.0)
    await asyncio.sleep(5.95 - scene.clock.now())
    assert scene.told == [(0, False, ""), (1, False, ""), *end]
    assert scene.poses == list(heard)


@within(Scene)
async def test_a_fault_that_fails_when_it_is_ordered_or_on_its_first_message_has_no_effect(scene):
    class Broken(Actor):
        outputs = (topics.SCAN,)

        @every(0.1)
        def speak(self) -> None:
            self.publish(topics.SCAN, m.LaserScan(0.0, 0.1, 8.0, b"12345"))

    scene.start("broken", Broken)
    await scene.settle()
    scene.inject(topics.SCAN, "corrupt", 5.0, set_fields={"z_m": 1.0})
    await asyncio.sleep(0.15)
    ((affected, finished, reason),) = scene.told
    assert (affected, finished) == (0, True)
    assert "'z_m': unknown in LaserScan; known: " in reason
    scene.reports.clear()
    scene.inject(topics.SCAN, "corrupt", 5.0, add_fields={"ranges_f32": 1.0})
    await asyncio.sleep(9.0)
    assert [told[:2] for told in scene.told] == [(0, False), (0, True)]
    assert "5 bytes" in scene.told[-1][2]
    (diagnostic,) = (heard.message for heard in scene.diagnostics)
    assert (diagnostic.context, diagnostic.offender) == ("fault injection", "summit_xl/scan")
