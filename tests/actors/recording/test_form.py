"""What is recorded of a message gives its payload again, to the byte, whatever it is."""

from __future__ import annotations

import json
import struct
import typing
from enum import Enum

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.actors.bus.bounds import bare
from rampart.actors.bus.envelope import Header, encode, pack
from rampart.actors.bus.topic import ROS_SIDE
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.recording import message_form
from rampart.actors.recording.message_form import Forms, MessageForm, Recorded, plain_schema

form_of = Forms(topics.ALL).of

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
WHOLE = st.integers(-(2**63), 2**64 - 1)
ANYTHING = st.recursive(
    st.none() | st.booleans() | WHOLE | st.floats() | TEXT | st.binary(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT | WHOLE, inner, max_size=3),
    max_leaves=5)
HEADS = st.builds(Header, TEXT, st.integers(0, 2**53), st.integers(0, 2**40),
                  st.floats(-1e12, 1e12))


def values(kind: typing.Any) -> st.SearchStrategy[typing.Any]:
    """Anything that a field of a type may hold, numbers that are none included."""
    bounds = kind.__metadata__[0] if hasattr(kind, "__metadata__") else msgspec.Meta()
    kind = bare(kind)
    simple = {float: st.floats(bounds.ge, bounds.le), int: st.integers(bounds.ge, bounds.le),
              str: TEXT, bytes: st.binary(max_size=12), bool: st.booleans(), typing.Any: ANYTHING}
    if kind in simple:
        return simple[kind]
    if isinstance(kind, type) and issubclass(kind, Enum):
        return st.sampled_from(kind)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return st.builds(kind, **{f.name: values(f.type) for f in msgspec.structs.fields(kind)})
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is dict:
        return st.dictionaries(values(parts[0]), values(parts[1]), max_size=3)
    if typing.get_origin(kind) is tuple and parts[-1] is Ellipsis:
        return st.lists(values(parts[0]), max_size=3).map(tuple)
    return st.tuples(*map(values, parts))


@pytest.mark.parametrize("topic", topics.ALL, ids=lambda t: t.key)
def test_any_message_of_any_topic_comes_back_to_the_byte(topic):
    form = MessageForm(topic)

    @settings(max_examples=15, deadline=None, database=None)
    @given(HEADS, values(topic.type))
    def check(header, body):
        payload = encode(header, body)
        text, found, _ = form.recorded(payload)
        assert found is not None
        assert json.loads(text)["source"] == header.source
        assert form.payload(text) == payload

    check()


@settings(max_examples=60, deadline=None, database=None)
@given(HEADS, ANYTHING)
def test_a_message_of_a_topic_that_only_the_robot_knows_has_its_header_and_comes_back(head, body):
    form = form_of("rampart/porter/speed/driver")
    payload = encode(head, body)
    text, header, _ = form.recorded(payload)
    assert (header.source, header.sequence) == (head.source, head.sequence)
    assert "error" not in json.loads(text)
    assert form.payload(text) == payload


@settings(max_examples=60, deadline=None, database=None)
@given(st.binary(max_size=40) | ANYTHING.map(msgspec.msgpack.encode))
def test_garbage_comes_back_to_the_byte_and_says_that_it_is_none(payload):
    form = MessageForm(topics.COMMAND)
    text, header, _ = form.recorded(payload)
    assert form.payload(text) == payload
    assert (header is None) == ("error" in json.loads(text))


def test_garbage_in_the_form_of_an_envelope_with_a_text_that_is_none_is_garbage_too():
    for name, body in ((b"\xa1\xff", b"\x93" + 3 * (b"\xcb" + struct.pack(">d", 1.0))),
                       (b"\xa1x", b"\x92\xa1\xff\xa0")):
        payload = b"\x95" + name + b"\x01\x01\xcb" + struct.pack(">d", 1.0) + body
        form = MessageForm(topics.POSE if b"\xff" in name else ftm_topics.RESET)
        text, header, _ = form.recorded(payload)
        assert header is None
        assert "error" in json.loads(text)
        assert form.payload(text) == payload
    nameless = b"\x95\xa1\xff\x01\x01\xcb" + bytes(8) + b"\xc0"
    assert message_form.header_of(nameless) is None


def test_a_message_is_legible_and_only_one_that_json_cannot_hold_has_its_payload_beside_it():
    header = {"source": "localization", "incarnation": 1, "sequence": 7, "stamp": 3.25}
    for yaw_rad, shown_rad in ((1e-310, 1e-310), (float("nan"), None)):
        payload = encode(Header(*header.values()), m.Pose(1.5, -0.0, yaw_rad))
        shown = json.loads(form_of(topics.POSE.at()).recorded(payload)[0])
        assert bool(shown.pop("raw", "")) == (shown_rad is None)
        assert shown == header | {"body": {"x_m": 1.5, "y_m": -0.0, "yaw_rad": shown_rad}}


def test_a_sound_message_in_other_bytes_than_ours_keeps_them():
    payload = pack(("x", 1, 1, 3, m.Pose(1, 2, 3)))  # integers where floats are due
    form = form_of(topics.POSE.at())
    text, header, body = form.recorded(payload)
    assert (header.stamp, body.x_m) == (3.0, 1.0)
    assert form.payload(text) == payload


def test_a_message_of_ros_2_has_its_bytes_and_is_no_garbage():
    form = form_of(f"{ROS_SIDE}/data/0|odom")
    text, header, _ = form.recorded(b"\xc1")
    assert (header, form.is_foreign, form.payload(text)) == (None, True, b"\xc1")
    assert "error" not in json.loads(text)


def test_the_text_raw_in_a_message_is_no_payload():
    payload = encode(Header('"raw":', 1, 1, 0.0), fm.Reset('"raw":"AAAA"', "raw"))
    form = form_of(ftm_topics.RESET.at())
    assert form.payload(form.recorded(payload)[0]) == payload


@pytest.mark.parametrize("text", [
    b"", b"{}", b"[]", b'{"source":"a","incarnation":1,"sequence":1,"stamp":1}',
    b'{"source":"a","incarnation":1,"sequence":1,"stamp":1,"body":{"x_m":"far"}}',
    b'{"source":"a","incarnation":1,"sequence":1,"stamp":1,"raw":"?"}'])
def test_what_is_no_recorded_message_is_refused(text):
    with pytest.raises(ValueError):  # noqa: PT011 msgspec's words
        form_of(topics.POSE.at()).payload(text)


@pytest.mark.parametrize("topic", topics.ALL, ids=lambda t: t.key)
def test_schemas_are_of_the_plain_kind_that_viewers_know(topic):
    schema = json.loads(plain_schema(Recorded[topic.type]))
    body = schema["properties"]["body"]
    assert schema["type"] == body["type"] == "object"
    assert set(body["properties"]) == {f.name for f in msgspec.structs.fields(topic.type)}

    def check(node, name):
        assert not {"$ref", "anyOf", "prefixItems"} & set(node), name
        if node.get("type") == "array":
            check(node["items"], name)
        for key, part in node.get("properties", {}).items():
            check(part, f"{name}.{key}")

    check(schema, topic.key)
