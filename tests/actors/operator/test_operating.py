"""The HMI as a node, the operator's hands on its WebSocket, and who of several drives."""

from __future__ import annotations

import asyncio
import math
import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator import feed as hmi_feed
from rampart.actors.operator import server as hmi_server
from rampart.actors.operator import stick_arbitration
from rampart.actors.operator.stick_arbitration import FIRST_S, TIMEOUT_S, StickArbiter
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.testing import eventually
from tests.actors.operator.world import ask, hear, open_page, repeated, served, show, visited
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
        world, signalled):
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
        assert signalled == [("localization", "KILL")]
        await eventually(lambda: signalled[1:] == [("hmi", "KILL")])
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


# -- Who is followed when several hold a stick: timelines, and rules no order of events breaks --


HELD, FREE = True, False
LONG_AGO = -10.0


def play(page: str, device: str) -> str:
    """Return who is followed in each step of 100 ms.

    Args:
        page: one character a step: `#` held, `.` let go, blank silent.
        device: likewise.
    """
    arbiter = StickArbiter(LONG_AGO)
    seen = []
    for step, marks in enumerate(zip(page, device, strict=True)):
        now_s = step / 10
        arbiter.expire(now_s)
        followed = ""
        for name, mark in zip("pd", marks, strict=True):
            if mark == " ":
                continue
            ruling = arbiter.offer(name, HELD if mark == "#" else FREE, now_s, now_s)
            followed += name if ruling.follows else ""
        seen.append(followed or ("." if not arbiter.holder else "-"))
    return "".join(seen)


@pytest.mark.parametrize(("page", "device", "followed"), [
    # one alone is followed until it lets go
    (".##..",
     ".....",
     ".pp.."),
    # who was first keeps the stick; the other gets it by a press of its own, not by inheritance
    ("###....",
     ".####.#",
     "ppp...d"),
    # silence for more than 0.3 s is letting go, and who comes back has to let go first
    ("#    ##.#",
     ".........",
     "p---....p"),
    # one that was lost does not keep the other from driving
    ("#        ",
     ".....###.",
     "p---.ddd."),
    # a gap shorter than that is none
    ("# #  #",
     " #    ",
     "p-p--p"),
])
def test_who_is_followed(page, device, followed):
    assert play(page, device) == followed


def test_a_fresh_arbiter_follows_who_was_seen_to_rest_and_who_comes_later():
    arbiter = StickArbiter(started_s=10.0)
    assert "let go first" in arbiter.offer("page", HELD, 10.1, 10.1).told
    assert not arbiter.offer("page", HELD, 11.2, 11.2).follows
    arbiter.offer("device", FREE, 10.2, 10.2)
    assert arbiter.offer("device", HELD, 10.3, 10.3).since_s == 10.3
    assert arbiter.offer("device", HELD, 10.4, 10.4).since_s == 10.3
    arbiter.offer("device", FREE, 10.5, 10.5)
    late_s = 10.0 + FIRST_S
    assert arbiter.offer("tool", HELD, late_s, late_s).follows
    assert not StickArbiter().offer("page", HELD, 1e6, 1e6).follows  # a page reports its rest


@pytest.mark.parametrize("stamp_s", [-1.0, math.nan, -math.inf])
def test_a_position_that_is_old_on_arrival_moves_nothing(stamp_s):
    arbiter = StickArbiter(LONG_AGO)
    ruling = arbiter.offer("page", HELD, stamp_s, 0.0)
    assert (ruling.follows, ruling.told) == (False, "its position came too late")
    assert arbiter.holder == ""


def test_a_stamp_from_the_future_holds_no_longer_and_sources_are_not_kept_for_ever():
    arbiter = StickArbiter(LONG_AGO)
    assert arbiter.offer("page", HELD, math.inf, 0.0).follows
    assert arbiter.expire(TIMEOUT_S + 0.01).released
    for number in range(1000):
        arbiter.offer(f"tool {number}", HELD, number, number)
    assert len(arbiter._barred) <= 64


steps = st.lists(st.tuples(
    st.sampled_from("abc"), st.sampled_from(["held", "free", "late", "wait"]),
    st.floats(0.0, 0.5)), max_size=40)


@given(steps)
def test_no_order_of_events_breaks_the_rules(events):
    arbiter = StickArbiter(LONG_AGO)
    now_s = 0.0
    holding: set[str] = set()  # dead man down since before its source could have got the stick
    last_s: dict[str, float] = {}
    owner = ""
    for source, what, pause_s in events:
        now_s += pause_s
        if owner and now_s - last_s[owner] > TIMEOUT_S:
            holding.add(owner)
            owner = ""
        if what == "wait":
            arbiter.expire(now_s)
        else:
            stamp_s = now_s - 1.0 if what == "late" else now_s
            ruling = arbiter.offer(source, FREE if what == "free" else HELD, stamp_s, now_s)
            if what == "free":
                holding.discard(source)
                assert not ruling.follows
                assert ruling.released or owner != source
                owner = "" if owner == source else owner
            elif what == "late":
                assert not ruling.follows
            elif owner in {"", source} and source not in holding:
                assert ruling.follows
                owner = source
                last_s[source] = now_s
            else:
                assert not ruling.follows
                holding.add(source)
        assert arbiter.holder == owner


# -- The HMI as a node: it asks for the mission, and serves the operator's page --


async def test_the_mission_is_asked_for_when_the_last_node_runs_until_it_is_taken_and_never_again(
        world):
    async def report(state: fm.NodeState) -> None:
        world.others.publish(ftm_topics.NODES, fm.NodeTable((
            fm.NodeInfo("hmi", "non_control", 1, fm.NodeState.RUNNING, 1, 0),
            fm.NodeInfo("DM1", "detection", 2, state, 1, 0))))
        for _ in range(20):
            await asyncio.sleep(0)

    async with world.hmi(mission=world.airport.mission("AB")):
        await report(fm.NodeState.STARTING)
        await asyncio.sleep(1.0 / world.clock.rate)  # two repetitions
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
        await asyncio.sleep(2.0 / world.clock.rate)
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
