"""Fields of messages: each is bounded, and is found by its name; beyond a bound nothing arrives."""

import asyncio
import math
import re
from typing import Annotated

import numpy as np
import pytest
from msgspec import Meta, inspect

from rampart import Actor, Message, on
from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import MAX_PAYLOAD_BYTES, TEXT_CHARS, clip, oversized
from rampart.actors.bus.envelope import ArrivalGuard
from rampart.actors.bus.fields import Field
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import DetectionReport, DetectionState
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.testing import VirtualSystem
from tests.fuzz.message_extremes import HEADER, all_topics, edges, pack, smallest, unbounded
from tests.tank import LEVEL, TOPICS, Level, Phase, Pump
from tests.virtual_time import within

NOW_S = 2e12
"""Later than any stamp, so that none is ahead."""


def bounds_of(topic):
    return inspect.type_info(topic.type)


@pytest.mark.parametrize("topic", all_topics(), ids=lambda t: t.key)
def test_every_field_of_every_message_is_bounded(topic):
    assert list(unbounded(bounds_of(topic))) == []
    assert list(unbounded(HEADER)) == []


def judged(topic, payload):
    """Return whether an arriving payload is taken, and else why not."""
    taken, refused = [], []
    receive = ArrivalGuard(lambda: NOW_S).receiver(
        topic, lambda key, _message: taken.append(key), lambda _key, reason: refused.append(reason))
    receive("x", payload)
    assert len(taken) + len(refused) == 1
    return bool(taken), "".join(refused)


@pytest.mark.parametrize("topic", all_topics(), ids=lambda t: t.key)
def test_just_inside_a_bound_is_taken_and_just_outside_refused(topic):
    wrong = []
    for path, body, fits in edges(bounds_of(topic)):
        payload = pack("x", 1, 1, 0.0, body)
        taken, reason = judged(topic, payload)
        if taken is not fits or not (taken or reason.startswith(f"not a {topic.type.__name__}: ")):
            wrong.append((path, str(body)[:80], fits, reason))
    assert wrong == []


def test_a_header_beyond_its_bounds_is_refused():
    good = {"source": "x", "incarnation": 1, "sequence": 1, "stamp": 0.0}
    for path, value, fits in edges(HEADER):
        name = path.removeprefix("$.")
        parts = {**good, name: value[name]}
        taken, _ = judged(bus_topics.HEARTBEAT, pack(
            *parts.values(), smallest(bounds_of(bus_topics.HEARTBEAT))))
        assert taken is fits, (name, value[name])


def test_a_payload_that_is_too_long_is_refused():
    taken, reason = judged(ftm_topics.RESET, b"\x95" + bytes(MAX_PAYLOAD_BYTES))
    assert not taken
    assert f"{MAX_PAYLOAD_BYTES + 1} bytes" in reason


class Node(Actor):
    """Publishes and reports what no reader would take, and keeps what it hears."""

    outputs = (topics.MISSION_STATUS,)

    def on_start(self):
        self.heard = []
        light = m.LightMeasurement("x" * 256, 0.0, 0.0, m.LightVerdict.OK)
        self.publish(topics.MISSION_STATUS, m.MissionStatus(
            "", "", m.MissionPhase.IDLE, 0, (), (), (light,) * 9999, ""))
        self.report_diagnostic("c" * 5000, "r" * 5000 + "\udc80", "o" * 5000)

    @on(ftm_topics.STUB_TRIGGER)
    def take(self, message, _header):
        self.heard.append(message.name)


@within(VirtualSystem)
async def test_what_is_beyond_a_bound_is_reported_and_neither_sent_nor_handled(system):
    told, beats = (system.hear(topic, "node") for topic in (
        bus_topics.DIAGNOSTIC, bus_topics.HEARTBEAT))
    sent, key = system.hear(topics.MISSION_STATUS), ftm_topics.STUB_TRIGGER.at()
    node = system.start("node", Node)
    await asyncio.sleep(0.1)
    for sequence, name in enumerate(("n" * 257, "n")):
        system.bus.publish(ftm_topics.STUB_TRIGGER, key, pack(
            "x", 1, sequence, 0.0, {"name": name, "active": True, "reason": ""}))
    await asyncio.sleep(6.0)  # a heartbeat is posted, and sent now and then
    assert (sent, node.heard) == ([], ["n"])
    too_long, shortened, rejected = (one.message for one in told)
    assert (too_long.context, too_long.offender) == ("not sent", topics.MISSION_STATUS.at())
    assert [len(text) for text in (shortened.context, shortened.reason, shortened.offender)] == (
        [TEXT_CHARS] * 3)
    assert (rejected.context, rejected.offender) == ("payload rejected", key)
    assert rejected.reason == (
        "not a StubTrigger: Expected `str` of length <= 256 - at `$[4].name`")
    assert beats[-1].message.rejected_payloads == 1


@pytest.mark.parametrize(("text", "chars", "expected"), [
    ("short", 5, "short"), ("longer", 5, "lo..."), ("", 5, ""), ("é" * 6, 5, "éé..."),
    ("\udcff", 5, "?")])
def test_clip_makes_a_text_fit(text, chars, expected):
    assert clip(text, chars) == expected


@pytest.mark.parametrize(("value", "too_much"), [
    ({}, False), ({"x": 1.0}, False), ({"x": "y" * 99}, True), ([1] * 20, True),
    ([[[1]]], False), ([[[[1]]]], True), (b"1234", False)])
def test_oversized_counts_bytes_and_depth(value, too_much):
    assert oversized(value, budget=100, depth=3) is too_much
    with pytest.raises(ValueError, match="set_fields: more than"):
        bm.Injection("i", "t", "corrupt", 1.0, set_fields={"x": ["y" * 1000] * 1000})


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_reaches_its_readers(value):
    body = {**smallest(bounds_of(topics.POSE)), "x_m": value}
    assert judged(topics.POSE, pack("x", 1, 1, 0.0, body))[0]


# -- fields of messages by name


class Arm(Message):
    """Seven joints."""

    angles_rad: Annotated[tuple[float, ...], Meta(max_length=7)]


class Fixed(Message):
    """Three numbers and a text."""

    angles: tuple[float, float, float, str]


@pytest.mark.parametrize(("message", "path", "value", "kind"), [
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[1]", 1.0, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[-1]", 2.0, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[min]", 1.0, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[max]", 3.0, "number"),
    (Level(1.5), "cells[len]", 0, "number"),
    (Level(1.5), "cells[min]", None, "number"),
    (Level(1.5), "cells[7]", None, "number"),
    (Pump(Phase.FILLING), "phase", "filling", "text"),
    (Pump(Phase.IDLE, running=False), "running", False, "truth"),
    (DetectionReport(DetectionState.ACTIVE, "why", ("a", "b"), 1.0), "nodes[0]", "a", "text"),
    (Arm((0.5,) * 7), "angles_rad[-7]", 0.5, "number"),
    (Fixed((1.0, 2.0, 3.0, "x")), "angles[3]", "x", "text"),
])
def test_a_field_is_read(message, path, value, kind):
    field = Field(type(message), path)
    assert field(message) == value
    assert field.kind == kind


class Gauge(Actor):
    """What publishes a level."""

    outputs = (LEVEL,)


@pytest.mark.parametrize(("message", "where", "kind"), [
    (Level(np.float64(1.0)), "height_m", "numpy.float64"),
    (Level(1.0, (0.0, np.float32(1.0))), "cells[1]", "numpy.float32")])
@within(lambda: VirtualSystem(topics=TOPICS))
async def test_a_value_of_numpy_is_refused_by_topic_and_field(system, message, where, kind):
    with pytest.raises(
            TypeError, match=rf"^topic tank/level: \$\.{re.escape(where)}: .*{kind} "):
        system.start("gauge", Gauge).publish(LEVEL, message)


def test_an_item_that_a_list_lacks_is_named():
    field = Field(Level, "cells[7]")
    assert field.beyond(Level(1.5, (1.0, 2.0))) == "cells[7]: no item [7], the list has 2"
    assert field.beyond(Level(1.5, (1.0,) * 8)) == ""


@pytest.mark.parametrize(("kind", "path", "words"), [
    (Level, "hieght_m", "hieght_m: Level has no field 'hieght_m'; did you mean height_m?"),
    (Level, "cells", "cells: expected a number, a text or a truth value"),
    (Level, "height_m[0]", "height_m[0]: cannot take [0]: the value is not a list"),
    (Level, "height_m.x", "height_m.x: cannot take x: the value has no fields"),
    (Level, "", "expected the name of a field"),
    (Level, "cells[one]", "cells[one]: not a path of a field, such as pose.x_m or ranges_m[0]"),
    (Arm, "angles_rad[-8]", "angles_rad[-8]: [-8]: the list has at most 7 items, expected -7 to 6"),
    (Fixed, "angles[4]", "angles[4]: [4]: the list has at most 4 items, expected -4 to 3"),
])
def test_an_invalid_field_is_refused_in_one_line(kind, path, words):
    with pytest.raises(ValueError, match=r".") as caught:
        Field(kind, path)
    assert str(caught.value) == words
