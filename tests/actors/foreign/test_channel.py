"""The socket of a command: what passes in either direction, and what is refused."""

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


WHEEL = "tug/wheels: not a Wheels: "


@pytest.mark.parametrize(("packet", "line"), [
    (b'tug/order\n{"text":"x"}', "tug/order: not one of the keys"),
    (b"\xff\xfe\n{}", "\ufffd\ufffd: not one of the keys"), (b"tug/wheels", WHEEL),
    (b'tug/wheels\n{"left_radps":"x"}', f"{WHEEL}Expected `float`, got `str`"),
    (b'tug/wheels\n{"left":1}', WHEEL), (b"tug/wheels\n" + b"[" * 100_000, WHEEL),
    (b'tug/wheels soon\n{"left_radps":1}', WHEEL),
    (b'tug/wheels 10.2\n{"left_radps":1}', "tug/wheels: stamp 10.2: "),
    (b'tug/wheels nan\n{"left_radps":1}', "tug/wheels: stamp nan: "),
    (b"tug/wheels\n" + b" " * MAX_PACKET, f"tug/wheels: more than {MAX_PACKET} bytes"),
    (b"", ""),  # which is not the end
], ids=range(11))
async def test_what_is_no_message_is_refused_and_the_next_one_is_taken(end, packet, line):
    await end.send(packet, b'tug/wheels\n{"left_radps":1}')
    (refused,) = end.refused
    assert refused.startswith(line)
    assert len(end.taken) == 1


async def test_its_end_is_the_end(end):
    end.command.close()
    for _ in range(10):
        await asyncio.sleep(0)
    end.channel.send("tug/order", ORDER, Text("x"), HEADER)
    assert end.taken == []


async def test_what_the_command_hears(end):
    end.channel.send("tug/order", ORDER, Text("x" * MAX_PACKET), HEADER)
    end.channel.send("tug/order", ORDER, Text("go"), HEADER)
    assert end.command.recv(1000) == b'tug/order 1.5 driver 2\n{"text":"go"}'
    (refused,) = end.refused
    assert refused.startswith(f"tug/order: packet of {MAX_PACKET + 34} bytes; at most")


async def test_for_one_that_does_not_read_the_newest_sample_waits_and_commands_up_to_a_bound(end):
    text = Text("x" * 60_000)
    for number in range(400):
        end.channel.send("tug/order", ORDER, text, HEADER)
        end.channel.send("tug/wheels", WHEELS, Wheels(float(number)), HEADER)
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
