"""The operator's hands on the page's WebSocket: driving, signals, faults."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator import stick_arbitration
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.supervision.kill_node import UnknownNodeError
from rampart.actors.supervision.process_title import RunProcess
from rampart.testing import eventually
from tests.actors.operator.world import ask, hear, open_page, repeated, served, visited
from tests.osmosis_system import shipped_system

RELEASED = m.Joystick(0.0, 0.0, dead_man=False)


async def operating(page, shown) -> dict:
    """Wait until the section "operating" is as wanted."""
    async with asyncio.timeout(5):
        while True:
            found = (await hear(page, "state"))["operating"]
            found |= found["sticks"]["Drive"]
            if shown(found):
                return found


class Hand:
    """Drives from a page as fast as it is answered."""

    def __init__(self, page, panel: str = "Drive") -> None:
        self.page = page
        self.panel = panel
        self.ticket = 0

    async def hold(self, forward: float = 0.5, left: float = 0.0) -> dict:
        told = await ask(self.page, type="stick", panel=self.panel, held=True, ticket=self.ticket,
                         forward=forward, left=left)
        self.ticket = told["ticket"]
        return told

    async def take(self) -> None:
        await self.let_go()
        assert not (await self.hold())["drives"]  # it has no ticket yet
        assert (await self.hold())["drives"]

    async def let_go(self) -> dict:
        return await ask(self.page, type="stick", panel=self.panel, held=False)


# ---- driving ------------------------------------------------------------------------------------


async def test_a_page_that_falls_silent_has_let_go(world, page):
    hand = Hand(page)
    await hand.take()
    await eventually(lambda: world.others.stick[-1] == RELEASED)
    shown = await operating(page, lambda o: o["holder"] is None)
    assert "page 1 was silent for 0.3 s" in shown["note"]
    assert not (await hand.hold())["drives"]
    assert "let go first" in (await hand.hold())["text"]
    assert world.others.stick[-1] == RELEASED


async def test_a_page_that_closes_or_vanishes_and_an_hmi_that_is_stopped_have_let_go(
        world, monkeypatch):
    monkeypatch.setattr(stick_arbitration, "TIMEOUT_S", 60.0)  # it is not its silence
    async with world.hmi() as hmi:
        at = await served(hmi)
        for end in (lambda page: page.close(), None):
            world.others.stick.clear()
            page = await open_page(at)
            await Hand(page).take()
            if end is None:
                page.transport.abort()  # as when the machine is unplugged
            else:
                await end(page)
            await eventually(lambda: RELEASED in world.others.stick)
            await eventually(lambda: hmi._server.pages == 0)
        page = await open_page(at)
        await Hand(page).take()
        assert world.others.stick[-1] != RELEASED
    await eventually(lambda: world.others.stick[-1] == RELEASED)
    await page.close()


@pytest.mark.usefixtures("patient")
async def test_what_a_stalled_connection_delivers_does_not_move_the_robot(world, page):
    hand = Hand(page)
    await hand.let_go()
    told = await hand.hold()
    for _ in range(3):  # with a ticket, but pressed long ago
        told = await ask(page, type="stick", panel="Drive", held=True, pressed_s=5,
                         ticket=told["ticket"], forward=0.5)
        assert "let go first" in told["text"]
    await hand.let_go()
    for _ in range(3):  # pressed just now, by a ticket of long ago
        told = await ask(page, type="stick", panel="Drive", held=True, ticket=1.0)
        assert not told["drives"]
    assert set(world.others.stick) == {RELEASED}


async def test_the_page_says_whether_the_stick_has_an_effect_now(world, page):
    shown = await operating(page, lambda _: True)
    assert shown["text"] == "no effect: the Safety Pilot is silent"
    async with repeated(lambda: world.others.publish(
            topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.AUTO, False, "", 0))):
        shown = await operating(page, lambda o: "overrides the mission" in o["text"])
        assert shown["works"] is True
        world.others.publish(topics.BASE_STATUS, m.BaseStatus(
            True, False, 0.0, (0.0, 0.0, 0.0, 0.0)))
        await operating(page, lambda o: "the brake is engaged" in o["text"])


# ---- signals, faults, strategies ----------------------------------------------------------------


async def test_a_signal_is_sent_here_ordered_elsewhere_and_to_the_own_node_after_its_answer(
        world, monkeypatch):
    sent = []

    def signal_node(node: str, name: str, _port: int) -> RunProcess:
        if node not in ("localization", "hmi"):
            raise UnknownNodeError(f"unknown node {node!r}")
        sent.append((node, name))
        return RunProcess(77, 7450, 1, (node,), 1)

    monkeypatch.setattr("rampart.actors.operator.operating.signal_node", signal_node)
    async with visited(world, launcher_pid=1) as (_, page):
        world.others.publish(ftm_topics.NODES, fm.NodeTable((
            fm.NodeInfo("teleoperation", "control", 7, fm.NodeState.RUNNING, 1, 0, host="g"),
            fm.NodeInfo("localization", "control", 8, fm.NodeState.RUNNING, 1, 0))))
        async with asyncio.timeout(5):
            while "teleoperation" not in str(await hear(page, "state")):
                pass
        for node, name, kind, text in (
                ("localization", "KILL", "done", "localization (pid 77): KILL"),
                ("localization", "HUP", "error", "unknown signal 'HUP'"),
                ("launchd", "KILL", "error", "unknown node 'launchd'"),
                ("teleoperation", "KILL", "done", "by the supervisor of its host"),
                ("teleoperation", "STOP", "done", "by the supervisor of its host"),
                ("hmi", "KILL", "done", "will reconnect")):
            told = await ask(page, type="signal", node=node, signal=name)
            assert told["type"] == kind
            assert text in told["text"]
        assert sent == [("localization", "KILL")]
        await eventually(lambda: sent[1:] == [("hmi", "KILL")])
        await eventually(lambda: [(one.node, one.signal) for one in world.others.signals] == [
            ("teleoperation", "KILL"), ("teleoperation", "STOP")])
        first, second = world.others.signals
        assert first.order != second.order  # the same one twice would be one


async def test_what_nobody_answers_is_shown_to_have_had_no_effect(world):
    async with visited(world, system=shipped_system()) as (hmi, page):
        for wish, why in (({"type": "inject", "fault": "drop:world/truth"}, "no such topic"),
                          ({"type": "signal", "node": "hmi", "signal": "KILL"}, "no processes"),
                          ({"type": "strategy", "name": "hope"}, "no strategy 'hope'")):
            told = await ask(page, **wish)
            assert told["type"] == "error"
            assert why in told["text"]
        await ask(page, type="inject", fault="drop:detection/DM1")
        await ask(page, type="strategy", name="mission-first")
        told = await ask(page, type="strategy", name="safety-first")
        assert told["text"] == "strategy mission-first waits for its answer"
        shown = await operating(page, lambda o: o["faults"] and o["faults"][0]["ended"])
        assert shown["faults"][0]["state"] == "no effect: no publisher of detection/DM1 answers"
        assert len({o.injection for o in world.others.injections}) == 1
        await eventually(lambda: hmi._state.picture.value("order")["text"] == (
            "strategy mission-first not set: no answer from the FTM Manager"))
        assert len({a.request for a in world.others.adaptations}) == 1
        world.others.manager()
        await operating(page, lambda o: o["strategy"] == "guarded-repair")
        told = await ask(page, type="strategy", name="guarded-repair")
        assert told["text"] == "strategy guarded-repair is in force already"
