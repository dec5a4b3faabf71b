"""Whatever bus and browsers say: the operator's nodes live, frames are small, text is text."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json

import httpx
import msgspec
import pytest
import websockets
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.operator.bounds import Bounds
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Light, Mission
from rampart.actors.osmosis.control.teleoperation.teleoperation import Teleoperation
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.actors.osmosis.page.map import MAX_LIGHTS
from rampart.actors.osmosis.page.state import OsmosisState
from tests.actors.operator.extremes import DOCUMENTS, MARKUP, messages
from tests.actors.operator.page import show
from tests.actors.operator.world import AIRPORT, SPEC, hear, open_page, served

FRAME_BYTES = 512_000
HANDLED = [(kind, topic, method) for kind in (OsmosisHmi, Teleoperation)
           for topic, method in kind._handlers]


def node(world, kind: type, **shared: object):
    context = world.context(kind.__name__.lower(), 1, system=SPEC, **shared)
    return kind(context)


# ---- what is heard ----------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "topic", "method"), HANDLED,
                         ids=[f"{k.__name__}-{t.key}" for k, t, _ in HANDLED])
async def test_a_handler_of_the_operators_nodes_survives_every_extreme(world, kind, topic, method):
    async with world.running(node(world, kind)) as actor:
        handler = getattr(actor, method)
        for number, message in enumerate(messages(topic.type)):
            for stamp in (0.0, -1e308, -float("inf")):
                handler(message, Header("x" * (number % 3), number, number, stamp))
        if kind is OsmosisHmi:
            actor._repeat()
            actor._look()
            actor._state.grow_old(1e9)
            assert len(actor._server._feed.frame(0)) < FRAME_BYTES
        await asyncio.sleep(0.05)
        assert not actor._dispatcher._ended.done()
    diagnosed = {d.context for d in world.others.diagnostics}
    assert "handler failed" not in diagnosed


async def test_all_extremes_together_make_a_frame_that_a_page_can_take(world):
    async with world.running(node(world, OsmosisHmi)) as hmi:
        for topic, method in hmi._handlers:
            for number, message in enumerate(messages(topic.type)):
                getattr(hmi, method)(message, Header("somebody", 1, number, 0.0))
        async with websockets.connect(f"ws://{await served(hmi)}/ws", max_size=None) as page:
            sizes = []
            while "state" not in (kind := json.loads(text := await page.recv())["type"]):
                sizes.append(len(text))
            sizes.append(len(text))
            assert kind == "state"
            assert max(sizes) < FRAME_BYTES


async def test_a_system_that_is_none_is_reported_and_the_one_before_stays(world, monkeypatch):
    async with world.running(node(world, OsmosisHmi)) as hmi:
        reported: list[str] = []
        monkeypatch.setattr(hmi, "report_diagnostic", lambda what, *_: reported.append(what))
        drawn = hmi._state.picture.value("system")
        for number, document in enumerate(DOCUMENTS, 1):
            hmi._adapted(fm.AdaptedSystem(7, "a change", "somebody", document),
                         Header("ftm_manager", 1, 1, 0.0))
            assert hmi._state.picture.value("system") == drawn
            assert reported == ["changed system"] * number, document


# ---- how much is shown ------------------------------------------------------------------------


def with_lights(count: int):
    return dataclasses.replace(AIRPORT, lights=tuple(
        Light(f"L{i:05}", f"row {i // 50}", i % 50, i / 50, 200.0) for i in range(count)))


async def test_with_3000_lights_a_frame_is_bounded_and_a_light_costs_what_a_light_costs(world):
    airport = with_lights(3000)
    async with world.hmi(airport=airport) as hmi:
        hmi._mission_status(m.MissionStatus(
            "1", "A", m.MissionPhase.RUNNING, 0, (), (), tuple(
                m.LightMeasurement(light.name, 123.456, 0.5, m.LightVerdict.OK)
                for light in airport.lights), ""), Header("mission_manager", 1, 1, 0.0))
        async with websockets.connect(f"ws://{await served(hmi)}/ws", max_size=None) as page:
            hello = await hear(page, "hello")
            assert len(json.dumps(hello["map"])) < FRAME_BYTES / 2
            assert len(hello["map"]["lights"]) == MAX_LIGHTS
            assert hello["left_out"] == {"lights": 3000 - MAX_LIGHTS}
            whole = await page.recv()
            assert len(whole) < FRAME_BYTES / 2
            assert len(json.loads(whole)["lights"]) == MAX_LIGHTS
            hmi._light(m.LightMeasurement("L00007", 0.0, 0.0, m.LightVerdict.OUT),
                       Header("osmosis_control", 1, 2, 0.0))
            while "lights" not in (frame := json.loads(text := await page.recv())):
                pass
            assert frame["lights"] == {
                "L00007": {"verdict": "out", "ratio": 0.0, "intensity_cd": 0.0}}
            assert len(text) < 1000


@pytest.mark.page
async def test_the_page_draws_so_many_lights_and_says_how_many_it_leaves_out(world, tab):
    lights = "document.querySelectorAll('#map .light')"
    async with world.hmi(airport=with_lights(3000)) as hmi:
        await show(tab, hmi)
        await tab.until(f"{lights}.length === {MAX_LIGHTS}")
        assert await tab.value("document.getElementById('left-out').textContent") == (
            f"Too much to show: {3000 - MAX_LIGHTS} of the lights left out.")
        state = f"[...{lights}].filter((one) => one.classList.contains('out')).length"
        light = m.LightMeasurement("L00007", 0.0, 0.0, m.LightVerdict.OUT)
        hmi._light(light, Header("osmosis_control", 1, 1, 0.0))
        await tab.until(f"{state} === 1")
        for mission in ("1", "2"):
            hmi._mission_status(m.MissionStatus(
                mission, "A", m.MissionPhase.RUNNING, 0, (), (), (), ""),
                Header("mission_manager", 1, int(mission), 0.0))
        await tab.until(f"{state} === 0")
        many = ("x",) * 5000
        hmi._manager(fm.ManagerStatus(many, (), (), ("RM1",), "", 1), Header("x", 1, 1, 0.0))
        await tab.until("document.getElementById('left-out').textContent"
                        ".endsWith('4800 of the manager left out.')")
        assert await tab.value("document.getElementById('resets').children.length") == 1


def test_a_page_that_missed_a_new_mission_is_told_which_lights_are_unmeasured_again():
    state = OsmosisState()
    state.light(m.LightMeasurement("A01", 1.0, 1.0, m.LightVerdict.OK))
    seen = state.picture.version
    state.mission(m.MissionStatus("2", "A", m.MissionPhase.RUNNING, 0, (), (), (), ""), 3.0)
    assert json.loads(msgspec.json.encode(state.picture.changes(seen)))["lights"] == {"A01": None}
    assert json.loads(msgspec.json.encode(state.picture.changes(0)))["lights"] == {}


SCALARS = st.none() | st.booleans() | st.integers(-2**63, 2**63 - 1) | st.floats() | st.text()


@given(st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
def test_whatever_is_fitted_is_json_without_a_long_text_or_list(value):
    shown, _ = Bounds(text=20, items=5, room=200).fit(value)
    to_do = [json.loads(msgspec.json.encode(shown))]
    while to_do:
        match to_do.pop():
            case str(text):
                assert len(text) <= 20
            case list(entries):
                assert len(entries) <= 5
                to_do += entries
            case dict(entries):
                assert len(entries) <= 5
                to_do += [*entries, *entries.values()]


# ---- what browsers say ------------------------------------------------------------------------


BAD = ["", "{", "[" * 2000, '{"type":' * 400, "null", "7", '"stick"', "[]", '{"type":{}}',
       '{"type":"stick","panel":"Drive","held":true,"ticket":' + "9" * 400 + "}",
       '{"type":"stick","panel":"Drive","held":"yes"}', '{"type":"stick","panel":"x","held":true}',
       '{"type":"stick","panel":"Drive","held":true,"ticket":-9223372036854775808,'
       '"forward":1e308,"left":-1e308}',
       '{"type":"inject","fault":"' + MARKUP + '"}', '{"type":"reset","recovery":"\\u0000"}',
       '{"type":"reset","recovery":"\\ud800"}', '{"type":"order","action":"explode"}',
       '{"type":"seen","version":' + "9" * 30 + "}", '{"type":"seen","version":-1}',
       '{"type":"end-fault","injection":"constructor"}', '{"type":"mission","name":"__proto__"}']


@pytest.mark.usefixtures("patient")
async def test_nothing_that_a_browser_says_harms_the_node_or_other_pages(world, caplog):
    async with world.hmi(system=SPEC) as hmi:
        at = await served(hmi)
        async with open_page(at) as good, open_page(at, close_timeout=0.1) as bad:
            for text in (*BAD, *(text.encode() for text in BAD), b"\xff\xfe", b"\x00" * 100):
                with contextlib.suppress(websockets.ConnectionClosed):
                    await bad.send(text)
            await good.send('{"type":"stick","panel":"Drive","held":false}')
            assert not (await hear(good, "stick"))["drives"]
        for raw in (b"\x00\xff\x80\r\n\r\n", b"GET " + b"/" * 70_000, b"GET / HTTP/9.9\r\n\r\n",
                    b"GET http://[::1/ HTTP/1.1\r\nHost: [\r\n\r\n", b"\x16\x03\x01" + bytes(500),
                    b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n",
                    b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
                    b"GET /ws HTTP/1.1\r\nHost: " + at.encode() + b"\r\nUpgrade: websocket\r\n"
                    b"Connection: Upgrade\r\n\r\n",
                    b"GET / HTTP/1.1\r\nHost: " + at.encode() + b"\r\n" + b"a: b\r\n" * 30_000):
            await shout(at, raw)
        async with httpx.AsyncClient() as client:
            assert (await client.get(f"http://{at}/")).status_code == 200
    assert [r.getMessage() for r in caplog.records if r.name == "asyncio"] == []


async def shout(at: str, raw: bytes) -> None:
    """Send bytes and read what comes until the other end has had enough."""
    reader, writer = await asyncio.open_connection(*at.split(":"))
    with contextlib.suppress(ConnectionError):
        writer.write(raw)
        writer.write_eof()
        async with asyncio.timeout(10):
            await reader.read()
    writer.close()
    with contextlib.suppress(ConnectionError):
        await writer.wait_closed()


# ---- text is text -----------------------------------------------------------------------------


@pytest.mark.page
async def test_markup_in_every_text_of_the_bus_and_of_the_airport_is_inert(world, tab):
    airport = dataclasses.replace(
        AIRPORT, name=MARKUP, nodes={f"{MARKUP}{n}"[:90]: at for n, at in AIRPORT.nodes.items()},
        edges=(), buildings=tuple(msgspec.structs.replace(b, name=MARKUP)
                                  for b in AIRPORT.buildings),
        lights=tuple(msgspec.structs.replace(light, name=f"{MARKUP}{i}", row=MARKUP)
                     for i, light in enumerate(AIRPORT.lights)),
        missions={MARKUP: Mission(MARKUP, AIRPORT.mission("A").goals)})
    spec = msgspec.structs.replace(SPEC, title=MARKUP, nodes=tuple(
        msgspec.structs.replace(n, name=n.name) for n in SPEC.nodes))
    async with world.hmi(airport=airport, system=spec) as hmi:
        await show(tab, hmi)
        for topic, method in hmi._handlers:
            if topic.key in ("inject", "hello"):
                continue
            getattr(hmi, method)(marked(topic.type), Header("x", 1, 1, 0.0))
        for light in airport.lights:
            hmi._light(m.LightMeasurement(light.name, 0.0, 0.0, m.LightVerdict.OUT),
                       Header("x", 1, 2, 0.0))
        usage = {MARKUP: {"cpu": 1.0, "mb": 1.0, "age_s": 1}}
        hmi._state.picture.put("usage", {"nodes": usage, "guards": [
            {"name": f"{MARKUP} guard", "kind": MARKUP, "pid": 1, "state": MARKUP,
             "incarnation": 1, "restarts": 0, "signals": True}]})
        hmi._state.announce(MARKUP, 1.0)
        text = "document.body.textContent"
        for shown in ("toast", "mission-reason", "pilot-reason", "manager", "resets", "events",
                      "decisions", "nodes", "airport", "mission-name", "alarm-title", "map",
                      "tree-title", "strategy-now", "detections"):
            await tab.until(f"document.getElementById('{shown}').textContent"
                            ".includes('<img src=x')")
        await tab.value("document.querySelectorAll('#nodes button')[0].click()")
        await tab.until("document.getElementById('signal-node').textContent.includes('<img')")
        assert await tab.value(f"{text}.includes('onerror=window.broken')") is True
        assert await tab.value("document.images.length") == 0
        assert await tab.value("document.querySelectorAll('body script').length") == 0
        assert await tab.value("window.broken === undefined") is True
        assert [url for url in tab.requests if url.endswith("/x")] == []
        refused = await tab.value(
            "(() => { try { document.body.innerHTML = '<b>'; return 'taken'; }"
            " catch (error) { return error.name; } })()")
        assert refused == "TypeError"
        tab.errors.clear()  # lines of numbers that are none, and what was refused


def marked(kind: type) -> msgspec.Struct:
    """Return a message of a type with markup in each of its texts."""
    found = next(message for message in messages(kind) if MARKUP in str(message)
                 or not any(MARKUP in str(x) for x in messages(kind)))
    return filled(found)


def filled(value):
    if isinstance(value, msgspec.Struct):
        return msgspec.structs.replace(value, **{
            name: filled(getattr(value, name)) for name in value.__struct_fields__})
    if isinstance(value, tuple):
        return tuple(filled(entry) for entry in value[:3]) or value
    return MARKUP if type(value) is str else value
