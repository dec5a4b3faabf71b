"""The HMI as a node: it asks for the mission, and serves the operator's page."""

from __future__ import annotations

import asyncio
import json
import socket
from contextlib import asynccontextmanager

import httpx
import pytest
import websockets
from hmi_browser import CHROMIUM, browser

from actors import messages as m
from actors import topics
from actors.operator.hmi import Hmi
from actors.operator.hmi_server import MAX_MESSAGE_BYTES, OrderWish, own_origin
from actors.runtime.actor import Actor, Context, Header, on
from actors.runtime.clock import Clock
from actors.runtime.virtual_bus import Hub, VirtualBus
from airport.formats import load_airport

AIRPORT = load_airport("vallombre")
RATE = 20.0


class Others(Actor):
    """Stands for the rest of the system."""

    outputs = (topics.MISSION_STATUS, topics.MANAGER_STATUS, topics.POSE, topics.DETECTION,
               topics.MISSION_ORDER_ANSWER)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.requests: list[m.MissionRequest] = []
        self.resets: list[m.Reset] = []
        self.orders: list[m.MissionOrder] = []
        self.diagnostics: list[m.Diagnostic] = []

    @on(topics.MISSION_REQUEST)
    def request(self, message: m.MissionRequest, _header: Header) -> None:
        self.requests.append(message)

    @on(topics.RESET)
    def reset(self, message: m.Reset, _header: Header) -> None:
        self.resets.append(message)

    @on(topics.MISSION_ORDER)
    def order(self, message: m.MissionOrder, _header: Header) -> None:
        self.orders.append(message)

    @on(topics.DIAGNOSTIC)
    def diagnostic(self, message: m.Diagnostic, _header: Header) -> None:
        self.diagnostics.append(message)


class World:
    """A hub with `Others` on it; HMIs join and leave."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.hub = Hub()
        self.clock = Clock(loop.time(), RATE, loop.time)
        self.others = Others(self.context("others", 1))

    def context(self, name: str, incarnation: int, **shared: object) -> Context:
        return Context(name, incarnation, self.clock, VirtualBus(self.hub, name, incarnation),
                       {}, {"airport": AIRPORT, "run_id": "r1", **shared})

    @asynccontextmanager
    async def running(self, actor: Actor):
        task = asyncio.create_task(actor.run())
        for _ in range(20):
            await asyncio.sleep(0)
        try:
            yield actor
        finally:
            actor.stop()
            await asyncio.wait_for(task, 5)

    @asynccontextmanager
    async def hmi(self, incarnation: int = 1, **shared: object):
        async with self.running(Hmi(self.context("hmi", incarnation, **shared))) as hmi:
            yield hmi

    def say_running(self, request: m.MissionRequest) -> None:
        self.others.publish(topics.MISSION_STATUS, m.MissionStatus(
            request.mission_id, request.name, m.MissionPhase.RUNNING, 0, request.goals, (), (), ""))

    def say(self, phase: m.MissionPhase, *possible: m.MissionAction) -> None:
        goals = tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in AIRPORT.mission("A").goals)
        self.others.publish(topics.MISSION_STATUS, m.MissionStatus(
            "r1/first", "A", phase, 0, goals, (), (), "", orders=possible))

    def say_latched(self, *names: str) -> None:
        self.others.publish(topics.MANAGER_STATUS, m.ManagerStatus(
            (), (), names, names, "safety-first", 1))


@pytest.fixture
async def world():
    made = World()
    async with made.running(made.others):
        yield made


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


async def eventually(condition, timeout_s: float = 5.0) -> None:
    deadline = asyncio.get_running_loop().time() + timeout_s
    while not condition():
        assert asyncio.get_running_loop().time() < deadline, "it did not happen in time"
        await asyncio.sleep(0.005)


@asynccontextmanager
async def repeated(say, period_s: float = 0.02):
    """Have something said again and again, as living nodes do."""
    async def again() -> None:
        while True:
            say()
            await asyncio.sleep(period_s)

    task = asyncio.create_task(again())
    try:
        yield
    finally:
        task.cancel()


async def served(hmi: Hmi) -> str:
    await eventually(lambda: hmi._starting is not None and hmi._starting.done())
    return f"127.0.0.1:{hmi.page_port}"


async def hear(page, kind: str) -> dict:
    async with asyncio.timeout(5):
        while True:
            message = json.loads(await page.recv())
            if message["type"] == kind:
                return message


async def test_the_mission_is_asked_for_until_it_is_taken_and_never_again(world):
    async with world.hmi(mission=AIRPORT.mission("AB")):
        await eventually(lambda: len(world.others.requests) >= 3)
        assert len({r.mission_id for r in world.others.requests}) == 1
        assert world.others.requests[0].goals[0] == m.Goal(-22.0, -18.5, m.Mode.TAXI)
        world.say_running(world.others.requests[0])
        await asyncio.sleep(0.05)
        count = len(world.others.requests)
        world.others.publish(topics.MISSION_STATUS, m.MissionStatus(
            "", "", m.MissionPhase.IDLE, 0, (), (), (), ""))
        await asyncio.sleep(2.0 / RATE)
        assert len(world.others.requests) == count


async def test_an_hmi_respawned_in_mid_run_starts_nothing(world):
    await asyncio.sleep(9.0 / RATE)
    async with world.hmi(incarnation=2, mission=AIRPORT.mission("AB")):
        await asyncio.sleep(2.0 / RATE)
    assert world.others.requests == []


async def test_a_page_gets_the_map_once_and_then_states(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        world.others.publish(topics.POSE, m.Pose(1.0, 2.0, 0.5))
        async with websockets.connect(f"ws://{at}/ws", origin=f"http://{at}") as page:
            hello = json.loads(await page.recv())
            assert hello["map"]["name"] == AIRPORT.name
            assert hello["missions"] == ["A", "B", "AB"]
            state = await hear(page, "state")
            assert state["pose"]["value"] == {"x_m": 1.0, "y_m": 2.0, "yaw_rad": 0.5}


async def test_nothing_is_pushed_and_no_task_is_left_when_the_page_is_closed(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        before = len(asyncio.all_tasks())
        async with websockets.connect(f"ws://{at}/ws") as page:
            await hear(page, "state")
            assert hmi._server.pages == 1
        await eventually(lambda: hmi._server.pages == 0 and len(asyncio.all_tasks()) <= before)


async def test_the_emergency_stop_is_reset_from_the_page(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with websockets.connect(f"ws://{at}/ws") as page:
            await page.send('{"type": "reset", "recovery": "RM1"}')
            assert "'RM1' does not wait for a reset" in (await hear(page, "error"))["text"]
            world.say_latched("RM1")
            await eventually(lambda: hmi._state.latched == ("RM1",))
            await page.send('{"type": "reset", "recovery": "RM1"}')
            await hear(page, "done")
            await eventually(lambda: world.others.resets == [m.Reset("RM1", "hmi")])


async def test_a_mission_is_started_from_the_page_unless_one_runs(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with websockets.connect(f"ws://{at}/ws") as page:
            await page.send('{"type": "mission", "name": "Z"}')
            assert (await hear(page, "error"))["text"] == "no mission 'Z'; there are: A, B, AB"
            await page.send('{"type": "mission", "name": "B"}')
            await hear(page, "done")
            await eventually(lambda: bool(world.others.requests))
            assert world.others.requests[0].name == "B"
            world.say_running(world.others.requests[0])
            await eventually(lambda: hmi._submission.pending is None)
            await page.send('{"type": "mission", "name": "A"}')
            assert (await hear(page, "error"))["text"] == "mission B is running"


@pytest.mark.parametrize("text", [
    "", "not json", "[]", "null", "{}", '{"type": "reset"}', '{"type": "reset", "recovery": 1}',
    '{"type": "format", "disk": "c"}', '{"type": "reset", "recovery": "RM1", "extra": 1}',
    "[" * 4000, b"\xff\xfe\x00",
    '{"type": "order"}', '{"type": "order", "action": "explode"}',
    '{"type": "order", "action": "PAUSE"}', '{"type": "order", "action": null}',
    '{"type": "order", "action": ["pause"]}', '{"type": "order", "action": "pause", "by": "RM6"}',
    '{"type": "order", "action": "pause", "reason": 7}',
    '{"type": "order", "action": "pause", "reason": "' + 201 * "x" + '"}',
])
async def test_a_malformed_message_is_answered_with_an_error_and_ignored(world, text):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with websockets.connect(f"ws://{at}/ws") as page:
            await page.send(text)
            assert "not understood" in (await hear(page, "error"))["text"]
            await hear(page, "state")
    assert (world.others.resets, world.others.orders) == ([], [])


async def test_an_order_is_given_from_the_page_if_it_makes_sense_and_its_answer_is_shown(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with websockets.connect(f"ws://{at}/ws") as page:
            await page.send('{"type": "order", "action": "pause"}')
            assert (await hear(page, "error"))["text"] == "the Mission Manager was not heard yet"
            world.say(m.MissionPhase.RUNNING, m.MissionAction.PAUSE)
            await eventually(lambda: hmi._state.snapshot(0.0)["mission"] is not None)
            await page.send('{"type": "order", "action": "resume"}')
            assert (await hear(page, "error"))["text"] == (
                "resume makes no sense while the mission is running; possible: pause")
            await page.send('{"type": "order", "action": "pause", "reason": "runway in use"}')
            assert (await hear(page, "done"))["text"] == "pause asked for"
            await eventually(lambda: bool(world.others.orders))
            order = world.others.orders[0]
            assert (order.action, order.reason, order.by) == ("pause", "runway in use", "operator")
            world.others.publish(topics.MISSION_ORDER_ANSWER, m.MissionOrderAnswer(
                order.order, False, "a reason"))
            await eventually(lambda: hmi._orders.pending is None)
            while (state := await hear(page, "state"))["order"]["number"] == 0:
                pass
            assert state["order"]["text"] == "pause refused: a reason"
            assert state["events"][-1]["text"] == "order to the mission: pause refused: a reason"
    assert {o.order for o in world.others.orders} == {order.order}


async def test_an_order_without_an_answer_is_repeated_to_a_mission_manager_that_comes_back(world):
    async with world.hmi() as hmi:
        world.say(m.MissionPhase.RUNNING, *m.MissionAction)
        await eventually(lambda: hmi._orders._status is not None)
        hmi._fulfil(OrderWish(m.MissionAction.HOME))
        sent = []
        hmi.publish = lambda topic, body, *_: topic is topics.MISSION_ORDER and sent.append(body)
        await eventually(lambda: len(sent) >= 2)
        await eventually(lambda: hmi._orders.pending is None)
        assert len(set(sent)) == 1
        assert "does not answer" in hmi._state.snapshot(0.0)["order"]["text"]


async def test_a_huge_message_closes_that_page_only(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with (websockets.connect(f"ws://{at}/ws") as good,
                    websockets.connect(f"ws://{at}/ws") as bad):
            await bad.send("x" * (MAX_MESSAGE_BYTES + 1))
            with pytest.raises(websockets.ConnectionClosedError):
                await hear(bad, "never")
            await hear(good, "state")


async def test_a_foreign_origin_and_a_foreign_host_are_refused(world):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        with pytest.raises(websockets.InvalidStatus, match="403"):
            await websockets.connect(f"ws://{at}/ws", origin="http://evil.example")
        async with httpx.AsyncClient() as client:
            assert (await client.get(f"http://{at}/")).status_code == 200
            rebound = await client.get(f"http://{at}/", headers={"host": "evil.example"})
            assert rebound.status_code == 400
            assert (await client.get(f"http://{at}/../hmi.py")).status_code == 404


@pytest.mark.parametrize(("origin", "own"), [
    (None, True), ("http://127.0.0.1:8080", True), ("http://localhost:8080", True),
    ("http://127.0.0.1:8081", False), ("https://127.0.0.1:8080", False), ("null", False),
    ("http://127.0.0.1.evil.example:8080", False), ("http://evil.example", False),
    ("http://127.0.0.1:99999999", False), ("", False),
])
def test_only_the_page_itself_is_its_own_origin(origin, own):
    assert own_origin(origin, 8080) is own


async def test_without_a_free_port_the_hmi_works_without_a_page_and_says_why(world):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        async with world.hmi(hmi_port=port, mission=AIRPORT.mission("A")) as hmi:
            await eventually(lambda: bool(world.others.diagnostics and world.others.requests))
            assert hmi.page_port is None
    report = world.others.diagnostics[0]
    assert report.offender == f"port {port}"
    assert "Address already in use" in report.reason
    assert "choose another hmi_port" in report.reason


async def test_a_successor_takes_the_page_over_at_once(world):
    port = free_port()
    async with world.hmi(hmi_port=port) as first:
        at = await served(first)
        page = await websockets.connect(f"ws://{at}/ws")
        await hear(page, "state")
    async with world.hmi(incarnation=2, hmi_port=port) as second:
        at = await served(second)
        async with websockets.connect(f"ws://{at}/ws") as again:
            await hear(again, "state")
    await page.close()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
async def test_chromium_shows_the_system_resets_the_stop_and_reconnects_by_itself(world):
    port = free_port()
    async with browser() as tab:
        async with world.hmi(hmi_port=port) as hmi:
            await tab.show(f"http://{await served(hmi)}/")
            await tab.until("document.getElementById('link').textContent === 'live'")
            await tab.until("document.querySelectorAll('.light').length === 22")
            world.others.publish(topics.POSE, m.Pose(-10.0, 5.0, 0.0))
            await tab.until("document.querySelector('.robot').getAttribute('transform')"
                            " === 'translate(-10 -5) rotate(0)'")
            world.say_latched("RM1")
            await tab.until("!document.getElementById('alarm').hidden")
            await tab.value("document.querySelector('#resets button').click()")
            await eventually(lambda: world.others.resets == [m.Reset("RM1", "hmi")])
            assert tab.errors == []
        await tab.until("document.body.classList.contains('offline')")
        async with world.hmi(incarnation=2, hmi_port=port):
            await tab.until("document.getElementById('link').textContent === 'live'")


BUTTONS = "[...document.querySelectorAll('#orders button:enabled')].map((b) => b.dataset.order)"


async def press(tab, key: str) -> None:
    for kind in ("rawKeyDown", "char", "keyUp"):
        await tab.call("Input.dispatchKeyEvent", type=kind, key=key, code="Enter",
                       windowsVirtualKeyCode=13, text="\r" if kind == "char" else "")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
async def test_in_chromium_the_orders_that_make_sense_are_buttons_for_mouse_and_keyboard(world):
    p, a = m.MissionPhase, m.MissionAction
    async with world.hmi(hmi_port=free_port()) as hmi, browser() as tab:
        await tab.show(f"http://{await served(hmi)}/")
        await tab.until("document.getElementById('link').textContent === 'live'")
        assert await tab.value("document.getElementById('orders').hidden") is True
        for phase, possible in ((p.RUNNING, (a.PAUSE, a.SKIP, a.CANCEL, a.HOME)),
                                (p.PAUSED, (a.RESUME, a.SKIP, a.CANCEL, a.HOME)),
                                (p.RETURNING, (a.PAUSE, a.CANCEL))):
            async with repeated(lambda phase=phase, possible=possible: world.say(phase, *possible)):
                shown = [x.value for x in (a.PAUSE, a.RESUME, a.SKIP, a.HOME, a.CANCEL)
                         if x in possible]
                await tab.until(f"JSON.stringify({BUTTONS}) === '{json.dumps(shown)}'"
                                .replace(", ", ","))
        async with repeated(lambda: world.say(p.RUNNING, *a)):
            await tab.until(f"{BUTTONS}.length === 5")
            await tab.value("document.querySelector('[data-order=pause]').focus()")
            await press(tab, "Enter")
            # The HMI repeats an order until it is answered.
            await eventually(lambda: {o.action for o in world.others.orders} == {a.PAUSE})
            world.others.publish(topics.MISSION_ORDER_ANSWER, m.MissionOrderAnswer(
                world.others.orders[0].order, True, ""))
            await tab.until("document.getElementById('toast').textContent === 'pause obeyed'")
            cancel = "document.querySelector('[data-order=cancel]')"
            await tab.value(f"{cancel}.click()")
            assert await tab.value(f"{cancel}.textContent") == "Sure?"
            assert len({o.order for o in world.others.orders}) == 1
            await tab.value(f"{cancel}.click()")
            await eventually(lambda: world.others.orders[-1].action == a.CANCEL)
        world.say(p.CANCELLED)
        await tab.until("document.getElementById('orders').hidden")
        assert tab.errors == []
