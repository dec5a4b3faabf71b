"""The socket of a command: what passes in either direction, and what is refused."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.foreign import channel as channel_module
from rampart.actors.foreign.channel import MAX_PACKET, Channel


class Wheels(Message, frozen=True):
    """For tests."""

    left_radps: float


class Text(Message, frozen=True):
    """For tests."""

    text: str


WHEELS = Topic("tug/wheels", Wheels, Qos.SENSOR, 10.0, "", "For tests.")
ORDER = Topic("tug/order", Text, Qos.COMMAND, 0.0, "", "For tests.")
HEADER = Header("driver", 2, 7, 1.5)


class End:
    """A channel, and what became of what was sent to it."""

    def __init__(self) -> None:
        self.taken = []
        self.refused = []
        self.channel = Channel(
            {"tug/wheels": WHEELS},
            lambda key, topic, body, stamp: self.taken.append((key, body, stamp)),
            lambda key, why: self.refused.append(f"{key}: {why}"), lambda: 10.0)
        self.command = self.channel.other

    async def send(self, *packets: bytes) -> None:
        for packet in packets:
            self.command.send(packet)
        for _ in range(10):
            await asyncio.sleep(0)


@pytest.fixture
async def end():
    made = End()
    yield made
    made.channel.close()


async def test_a_message_with_and_without_its_time(end):
    await end.send(b'tug/wheels\n{"left_radps": 2}', b'tug/wheels 9.5\n{"left_radps":1.5}')
    assert end.taken == [("tug/wheels", Wheels(2.0), None), ("tug/wheels", Wheels(1.5), 9.5)]
    assert end.refused == []


KNOWN = "not one of the keys that it publishes; these are: tug/wheels"
BAD = [
    (b'tug/order\n{"text":"x"}', f"tug/order: {KNOWN}"),
    (b"\xff\xfe\n{}", "\ufffd\ufffd: " + KNOWN),
    (b"tug/wheels", "tug/wheels: not a Wheels: Input data was truncated"),
    (b'tug/wheels\n{"left_radps":"x"}',
     "tug/wheels: not a Wheels: Expected `float`, got `str` - at `$.left_radps`"),
    (b'tug/wheels\n{"left_radps":null}',
     "tug/wheels: not a Wheels: Expected `float`, got `null` - at `$.left_radps`"),
    (b'tug/wheels\n{"left":1}',
     "tug/wheels: not a Wheels: Object contains unknown field `left`"),
    (b"tug/wheels\n" + b"[" * 100_000, "tug/wheels: not a Wheels: "),
    (b'tug/wheels soon\n{"left_radps":1}',
     "tug/wheels: not a Wheels: could not convert string to float: 'soon'"),
    (b'tug/wheels 10.2\n{"left_radps":1}',
     "tug/wheels: stamp 10.2: simulated seconds, not ahead of now, are right"),
    (b'tug/wheels nan\n{"left_radps":1}',
     "tug/wheels: stamp nan: simulated seconds, not ahead of now, are right"),
    (b"tug/wheels\n" + b" " * MAX_PACKET, f"tug/wheels: more than {MAX_PACKET} bytes"),
]


@pytest.mark.parametrize(("packet", "line"), BAD, ids=range(len(BAD)))
async def test_what_is_no_message_is_refused_and_the_next_one_is_taken(end, packet, line):
    await end.send(packet, b'tug/wheels\n{"left_radps":1}')
    (refused,) = end.refused
    assert refused.startswith(line)
    assert len(end.taken) == 1


async def test_an_empty_packet_is_not_the_end(end):
    await end.send(b"", b'tug/wheels\n{"left_radps":1}')
    assert len(end.taken) == 1


async def test_its_end_is_the_end(end):
    end.command.close()
    for _ in range(10):
        await asyncio.sleep(0)
    end.channel.say("tug/order", ORDER, Text("x"), HEADER)
    assert end.taken == []


async def test_what_the_command_hears(end):
    end.channel.say("tug/order", ORDER, Text("go"), HEADER)
    assert end.command.recv(1000) == b'tug/order 1.5 driver 2\n{"text":"go"}'


async def test_for_one_that_does_not_read_the_newest_sample_waits_and_commands_up_to_a_bound(end):
    text = Text("x" * 60_000)
    for number in range(400):
        end.channel.say("tug/order", ORDER, text, HEADER)
        end.channel.say("tug/wheels", WHEELS, Wheels(float(number)), HEADER)
    assert "tug/order: the command does not read its socket; a message to it is lost" in end.refused
    assert len(end.channel._waiting) <= channel_module._WAITING
    end.command.setblocking(False)
    heard = []
    while b"399.0" not in (heard[-1] if heard else b"") and len(heard) < 1000:
        await asyncio.sleep(0)
        try:
            heard.append(end.command.recv(MAX_PACKET))
        except BlockingIOError:
            continue
    assert heard[-1] == b'tug/wheels 1.5 driver 2\n{"left_radps":399.0}'


async def test_what_is_too_long_for_a_packet_is_refused(end):
    end.channel.say("tug/order", ORDER, Text("x" * MAX_PACKET), HEADER)
    assert end.refused == [f"tug/order: {MAX_PACKET + 34} bytes are too many for a packet, "
                           f"{MAX_PACKET} fit"]
