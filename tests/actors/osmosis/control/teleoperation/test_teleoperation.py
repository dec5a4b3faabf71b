"""The teleoperation node with a joystick that is plugged in, held, pulled out and plugged in again.

The device is a FIFO, the virtual joystick; the clock is the real one.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import asynccontextmanager
from types import SimpleNamespace

import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.teleoperation.joystick_device import (
    AXIS,
    BUTTON,
    EVENT,
    INITIAL,
)
from rampart.actors.osmosis.control.teleoperation.teleoperation import Teleoperation
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan
from rampart.cli import run as launch
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus

RATE = 4.0
SPEC = SimpleNamespace(robot=SimpleNamespace(top_speed_mps=1.0, top_turn_rate_radps=2.0))
STOP = m.Twist(0.0, 0.0)


def record(kind: int, number: int, value: int) -> bytes:
    return EVENT.pack(0, value, kind, number)


PRESS, LET_GO = record(BUTTON, 4, 1), record(BUTTON, 4, 0)
FORWARD, LEFT = record(AXIS, 1, -32767), record(AXIS, 0, -32767)


class Page(Actor):
    """The Safety Pilot's ear, and the operator's page as another source."""

    outputs = (topics.JOYSTICK,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.commands: list[m.Twist] = []
        self.held_since_s = 0.0
        self.diagnostics: list[bm.Diagnostic] = []
        self.changed = asyncio.Event()

    @on(topics.TELEOP_COMMAND)
    def command(self, message: m.Twist, _header: Header) -> None:
        self.commands.append(m.Twist(message.linear_mps, message.angular_radps))
        self.held_since_s = message.held_since_s
        self.changed.set()

    @on(bus_topics.DIAGNOSTIC)
    def diagnostic(self, message: bm.Diagnostic, _header: Header) -> None:
        self.diagnostics.append(message)
        self.changed.set()


class Desk:
    """A teleoperation node, its joystick, and a page."""

    def __init__(self, page: Page, fifo) -> None:
        self.page = page
        self._fifo = fifo
        self._writer: int | None = None

    async def plug(self) -> None:
        async with asyncio.timeout(10):
            while self._writer is None:
                try:
                    self._writer = os.open(self._fifo, os.O_WRONLY | os.O_NONBLOCK)
                except OSError:  # the node has not opened it yet
                    await asyncio.sleep(0.01)

    def tell(self, *records: bytes) -> None:
        os.write(self._writer, b"".join(records))

    def unplug(self) -> None:
        if self._writer is not None:
            os.close(self._writer)
        self._writer = None

    async def until(self, condition) -> None:
        async with asyncio.timeout(10):
            while not condition():
                self.page.changed.clear()
                await self.page.changed.wait()

    async def commands(self, count: int) -> list[m.Twist]:
        """Return the next commands."""
        self.page.commands.clear()
        await self.until(lambda: len(self.page.commands) >= count)
        return self.page.commands[:count]

    def told(self, words: str) -> bool:
        return any(words in d.reason for d in self.page.diagnostics)


def with_joystick(name: str) -> Osmosis:
    application = Osmosis.on_map(load_airport("vallombre"))
    application.options = Osmosis.Options(airport="", mission="", joystick=name)
    return application


@asynccontextmanager
async def desk(tmp_path, device="stick", **parameters):
    fifo = tmp_path / "stick"
    os.mkfifo(fifo)
    loop = asyncio.get_running_loop()
    hub, clock = Hub(), Clock(loop.time(), RATE, loop.time)
    page = Page(Context("page", 1, clock, VirtualBus(hub, "page")))
    node = Teleoperation(Context(
        "teleoperation", 1, clock, VirtualBus(hub, "teleoperation"), parameters,
        RunContext(RunPlan(), SPEC, application=with_joystick(str(tmp_path / device)))))
    tasks = [asyncio.create_task(actor.run()) for actor in (page, node)]
    it = Desk(page, fifo)
    while not {"page", "teleoperation"} <= hub.alive.keys():
        await asyncio.sleep(0)
    page.publish(topics.JOYSTICK, m.Joystick(0.0, 0.0, False))
    try:
        yield it
    finally:
        it.unplug()
        for actor in (node, page):
            actor.stop()
        await asyncio.wait_for(asyncio.gather(*tasks), 10)


async def test_a_joystick_from_plugging_in_to_pulling_out_and_in_again(tmp_path):
    async with desk(tmp_path) as it:
        await it.plug()
        it.tell(PRESS, FORWARD, LEFT)
        await it.until(lambda: m.Twist(1.0, 2.0) in it.page.commands)
        it.page.publish(topics.JOYSTICK, m.Joystick(-1.0, 0.0, True))
        await it.until(lambda: it.told("not followed"))
        assert await it.commands(5) == [m.Twist(1.0, 2.0)] * 5, "it is repeated while it is held"
        told = next(d for d in it.page.diagnostics if "not followed" in d.reason)
        assert (told.offender, "stick has the stick" in told.reason) == ("page", True)
        it.page.publish(topics.JOYSTICK, m.Joystick(0.0, 0.0, False))
        it.tell(LET_GO)
        await it.until(lambda: STOP in it.page.commands)
        it.tell(LEFT)
        await asyncio.sleep(0.1)  # six periods of repetition
        assert it.page.commands[-2:] == [m.Twist(1.0, 2.0), STOP], "then it is silent"
        it.tell(PRESS)
        await it.until(lambda: it.page.commands[-1] != STOP)
        it.unplug()
        await it.until(lambda: it.page.commands[-1] == STOP)
        await it.until(lambda: it.told("lost"))
        await it.plug()
        it.page.commands.clear()
        it.tell(record(BUTTON | INITIAL, 4, 1), record(AXIS | INITIAL, 1, -32767))
        it.tell(LET_GO, PRESS)
        await it.until(lambda: it.page.commands)
        assert it.page.commands[0] == m.Twist(1.0, 0.0), "after a fresh press"


async def test_a_device_that_is_not_there_is_waited_for_and_the_page_drives_meanwhile(tmp_path):
    async with desk(tmp_path, device="later") as it:
        await it.until(lambda: it.told("waiting for the device"))
        it.page.publish(topics.JOYSTICK, m.Joystick(0.5, 0.0, True))
        await it.until(lambda: m.Twist(0.5, 0.0) in it.page.commands)
        (tmp_path / "later").symlink_to(tmp_path / "stick")
        await it.plug()


@pytest.mark.parametrize(("arguments", "words"), [
    (["--joystick", "{file}"], "neither a device nor a FIFO"),
    (["--joystick", "{directory}"], "neither a device nor a FIFO"),
    (["--joystick", "--virtual"], "not possible with --virtual")])
def test_a_launch_with_what_is_no_joystick_is_refused(arguments, words, tmp_path, capsys):
    (tmp_path / "file").touch()
    told = [a.format(file=tmp_path / "file", directory=tmp_path) for a in arguments]
    assert launch.main(["--report", str(tmp_path / "report"), *told]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert words in lines[0]
