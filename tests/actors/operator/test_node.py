"""The HMI as a node: it asks for the mission, and serves the operator's page."""

from __future__ import annotations

import asyncio
import socket

import pytest

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator import feed as hmi_feed
from rampart.actors.operator import server as hmi_server
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.testing import eventually
from tests.actors.operator.page import show
from tests.actors.operator.world import (
    AIRPORT,
    RATE,
    ask,
    hear,
    open_page,
    repeated,
    served,
    visited,
)


async def test_the_mission_is_asked_for_when_the_last_node_runs_until_it_is_taken_and_never_again(
        world):
    async def report(state: fm.NodeState) -> None:
        world.others.publish(ftm_topics.NODES, fm.NodeTable((
            fm.NodeInfo("hmi", "non_control", 1, fm.NodeState.RUNNING, 1, 0),
            fm.NodeInfo("DM1", "detection", 2, state, 1, 0))))
        for _ in range(20):
            await asyncio.sleep(0)

    async with world.hmi(mission=AIRPORT.mission("AB")):
        await report(fm.NodeState.STARTING)
        await asyncio.sleep(1.0 / RATE)  # two repetitions
        assert not world.others.requests
        await report(fm.NodeState.RUNNING)
        assert world.others.requests
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


async def test_what_fails_is_told_in_one_line_and_the_page_goes_on_or_is_closed_with_a_reason(
        world, monkeypatch):
    def fail(*_):
        raise KeyError("a\nb")

    monkeypatch.setattr(OsmosisHmi, "_fulfil", fail)
    async with visited(world) as (hmi, page):
        assert "reset failed" in (await ask(page, type="reset", recovery="RM1"))["text"]
        await hear(page, "state")
        later_s = hmi.clock.now() + 1.1
        await eventually(lambda: hmi.clock.now() > later_s)  # a node reports once a second
        monkeypatch.setattr(hmi_feed.Feed, "push", fail)
        async with open_page(await served(hmi)) as other:
            await other.wait_closed()
            assert other.close_code == 1011
            assert "failed" in other.close_reason
        await eventually(lambda: len(world.others.diagnostics) == 2)
        assert hmi._server.pages == 1
    assert [report.reason.partition(" ")[0] for report in world.others.diagnostics] == [
        "reset:", "this"]
    assert not any("\n" in report.reason for report in world.others.diagnostics)


async def test_a_mission_is_started_from_the_page_unless_one_runs(world, hmi, page):
    told = await ask(page, type="mission", name="Z")
    assert told["text"] == "unknown mission 'Z'; known: A, B, AB"
    assert (await ask(page, type="mission", name="B"))["type"] == "done"
    await eventually(lambda: bool(world.others.requests))
    assert world.others.requests[0].name == "B"
    world.say_running(world.others.requests[0])
    await eventually(lambda: hmi._submission.pending is None)
    assert (await ask(page, type="mission", name="A"))["text"] == "mission B is running"


async def test_an_order_is_given_from_the_page_if_it_makes_sense_and_its_answer_is_shown(
        world, hmi, page):
    told = await ask(page, type="order", action="pause")
    assert told["text"] == "no status of the Mission Manager was received yet"
    world.say(m.MissionPhase.RUNNING, m.MissionAction.PAUSE)
    await eventually(lambda: hmi._state.picture.value("mission") is not None)
    told = await ask(page, type="order", action="resume")
    assert told["text"] == "resume is not possible while the mission is running; possible: pause"
    told = await ask(page, type="order", action="pause", reason="runway in use")
    assert told["text"] == "pause requested"
    await eventually(lambda: bool(world.others.orders))
    order = world.others.orders[0]
    assert (order.action, order.reason, order.by) == ("pause", "runway in use", "operator")
    world.others.publish(topics.MISSION_ORDER_ANSWER, m.MissionOrderAnswer(
        order.order, False, "a reason"))
    await eventually(lambda: hmi._orders.pending is None)
    assert hmi._state.picture.value("order")["text"] == "pause refused: a reason"
    assert {o.order for o in world.others.orders} == {order.order}


async def test_a_page_that_takes_nothing_gives_its_place_back(world, monkeypatch):
    monkeypatch.setattr(hmi_feed, "SEND_TIMEOUT_S", 0.1)
    monkeypatch.setattr(hmi_server, "CLOSE_TIMEOUT_S", 0.1)
    monkeypatch.setattr(OsmosisHmi, "_hello", lambda _hmi: {
        "type": "hello", "much": "x" * (1 << 25)})
    async with world.hmi() as hmi:
        host, port = (await served(hmi)).split(":")
        with socket.create_connection((host, int(port))) as mute:
            mute.sendall(f"GET /ws HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\n"
                         "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                         "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode())
            await eventually(lambda: hmi._server.pages == 1)
            await eventually(lambda: hmi._server.pages == 0)


BUTTONS = "$$('#orders button:enabled').map((b) => b.dataset.order)"


@pytest.mark.page
async def test_in_chromium_the_orders_that_make_sense_are_buttons_for_mouse_and_keyboard(
        world, hmi, tab):
    p, a = m.MissionPhase, m.MissionAction
    await show(tab, hmi)
    await tab.until("$('#orders')?.hidden")
    async with repeated(lambda: world.say(p.PAUSED, a.RESUME, a.CANCEL)):
        await tab.until(f"{BUTTONS}.join() === '{a.RESUME},{a.CANCEL}'")
    async with repeated(lambda: world.say(p.RUNNING, *a)):
        await tab.until(f"{BUTTONS}.length === 5")
        await tab.value("$('[data-order=pause]').focus()")
        for kind in ("rawKeyDown", "char", "keyUp"):
            await tab.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter",
                           windowsVirtualKeyCode=13, text="\r" if kind == "char" else "")
        # The HMI repeats an order until it is answered.
        await eventually(lambda: {o.action for o in world.others.orders} == {a.PAUSE})
        world.others.publish(topics.MISSION_ORDER_ANSWER, m.MissionOrderAnswer(
            world.others.orders[0].order, True, ""))
        await tab.until("$('#toast').textContent === 'pause obeyed'")
        cancel = "$('[data-order=cancel]')"
        await tab.value(f"{cancel}.click()")
        assert await tab.value(f"{cancel}.textContent") == "Sure?"
        assert len({o.order for o in world.others.orders}) == 1
        await tab.value(f"{cancel}.click()")
        await eventually(lambda: world.others.orders[-1].action == a.CANCEL)
    world.say(p.CANCELLED)
    await tab.until("$('#orders').hidden")
