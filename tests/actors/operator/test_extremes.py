"""Whatever bus and browsers say: the operator's node lives, lists are cut, text is text."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json

import httpx
import msgspec
import pytest
import websockets
from msgspec import inspect

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator.panels import Panel
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Light, Mission
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.actors.osmosis.page.map import MAX_LIGHTS
from tests.actors.operator.world import AIRPORT, SPEC, hear, open_page, repeated, served, show
from tests.fuzz.message_extremes import filled

MARKUP = "<img src=x onerror=window.broken=1><script>window.broken=1</script>"


async def test_a_system_that_is_none_is_reported_and_the_one_before_stays(world, monkeypatch):
    async with world.hmi(system=SPEC) as hmi:
        reported: list[str] = []
        monkeypatch.setattr(hmi, "report_diagnostic", lambda what, *_: reported.append(what))
        drawn = hmi._state.picture.value("system")
        documents = ("", "{", "null", "[" * 100_000, '{"nodes": 7}', '{"timing": 1e308}',
                     '{"a": ' + "9" * 400 + "}", '{"mechanism": [{"name": []}]}')
        for document in documents:
            hmi._adapted(fm.AdaptedSystem(7, "a change", "somebody", document),
                         Header("ftm_manager", 1, 1, 0.0))
        assert hmi._state.picture.value("system") == drawn
        assert reported == ["changed system"] * len(documents)


@pytest.mark.page
async def test_of_3000_lights_many_are_drawn_and_the_others_counted(
        world, tab):
    lights = "$$('#map .light')"
    many = dataclasses.replace(AIRPORT, lights=tuple(
        Light(f"L{i:05}", f"row {i // 50}", i % 50, i / 50, 200.0) for i in range(3000)))
    async with world.hmi(airport=many) as hmi:
        await show(tab, hmi)
        await tab.until(f"{lights}.length === {MAX_LIGHTS}")
        assert await tab.value("$('#left-out').textContent") == (
            f"Too much to show: {3000 - MAX_LIGHTS} of the lights left out.")
        hmi._light(m.LightMeasurement("L00007", 0.0, 0.0, m.LightVerdict.OUT),
                   Header("osmosis_control", 1, 1, 0.0))
        out = f"[...{lights}].filter((one) => one.classList.contains('out')).length"
        await tab.until(f"{out} === 1")
        for mission in ("1", "2"):
            hmi._mission_status(m.MissionStatus(
                mission, "A", m.MissionPhase.RUNNING, 0, (), (), (), ""),
                Header("mission_manager", 1, int(mission), 0.0))
        await tab.until(f"{out} === 0")
        hmi._manager(fm.ManagerStatus(("x",) * 5000, (), (), ("RM1",), "", 1),
                     Header("x", 1, 1, 0.0))
        await tab.until("$('#left-out').textContent.endsWith('4800 of the manager left out.')")
        shown = json.loads(hmi._server._feed.frame(0))["manager"]["value"]
        assert [len(shown[name]) for name in ("active", "latched")] == [200, 1]


BAD = ["", "{", "[" * 2000, '{"type":' * 400, "null", '"stick"', '{"type":{}}',
       '{"type":"stick","panel":"Drive","held":true,"ticket":' + "9" * 400 + "}",
       '{"type":"reset","recovery":"\\ud800"}', '{"type":"seen","version":-1}']


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
        for raw in (b"\x00\xff\x80\r\n\r\n", b"GET " + b"/" * 70_000, b"\x16\x03\x01" + bytes(500),
                    b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
                    b"GET /ws HTTP/1.1\r\nHost: " + at.encode() + b"\r\nUpgrade: websocket\r\n"
                    b"Connection: Upgrade\r\n\r\n"):
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


def marked(kind: type[msgspec.Struct]) -> msgspec.Struct:
    """Return a message of a type with markup in each of its texts."""
    return msgspec.convert(filled(inspect.type_info(kind), MARKUP, 1), kind,
                           builtin_types=(bytes,), strict=False)


@pytest.mark.page
async def test_markup_in_every_text_of_the_bus_the_airport_and_the_panels_is_inert(world, tab):
    airport = dataclasses.replace(
        AIRPORT, name=MARKUP, nodes={f"{MARKUP}{n}"[:90]: at for n, at in AIRPORT.nodes.items()},
        edges=(), buildings=tuple(msgspec.structs.replace(b, name=MARKUP)
                                  for b in AIRPORT.buildings),
        lights=tuple(msgspec.structs.replace(light, name=f"{MARKUP}{i}", row=MARKUP)
                     for i, light in enumerate(AIRPORT.lights)),
        missions={MARKUP: Mission(MARKUP, AIRPORT.mission("A").goals)})
    panels = (*OsmosisHmi.panels,
              Panel(title=MARKUP[:60], text="manager/status:strategy", unit="<b>"),
              Panel(title="List", table=("manager/status:strategy",)),
              Panel(title="States", states="manager/status:strategy", of=(MARKUP[:60], "a")))
    async with world.hmi(airport=airport, system=msgspec.structs.replace(SPEC, title=MARKUP),
                         panels=panels) as hmi:
        await show(tab, hmi)
        hmi._state.picture.put("usage", {"nodes": {MARKUP: {"cpu": 1.0, "mb": 1.0, "age_s": 1}},
                                         "guards": [{"name": f"{MARKUP} guard", "kind": MARKUP,
                                                     "pid": 1, "state": MARKUP, "incarnation": 1,
                                                     "restarts": 0, "signals": True}]})

        def say() -> None:
            for topic, method in hmi._handlers:
                if topic.key not in ("inject", "hello"):
                    getattr(hmi, method)(marked(topic.type), Header("x", 1, 1, 0.0))
            for light in airport.lights:
                hmi._light(m.LightMeasurement(light.name, 0.0, 0.0, m.LightVerdict.OUT),
                           Header("x", 1, 2, 0.0))
            hmi._state.announce(MARKUP, 1.0)
            world.others.publish(ftm_topics.MANAGER_STATUS, marked(fm.ManagerStatus))

        async with repeated(say, 0.1):
            for shown in ("toast", "mission-reason", "pilot-reason", "manager", "resets", "events",
                          "decisions", "nodes", "airport", "mission-name", "alarm-title", "map",
                          "tree-title", "strategy-now", "detections"):
                await tab.until(f"$('#{shown}').textContent.includes('<img src=x')")
            for name in ("List", "States", MARKUP[:60]):
                await tab.until("$$('.panel').find((p) => p.dataset"
                                f".name === {json.dumps(name)}).textContent.includes('<img src=x')")
        await tab.value("$$('#nodes button')[0].click()")
        await tab.until("$('#signal-node').textContent.includes('<img')")
        assert await tab.value("document.images.length") == 0
        made = "$$(\"body script, [data-name^='<img'] b\").length"
        assert await tab.value(made) == 0
        assert await tab.value("window.broken === undefined") is True
        assert [url for url in tab.requests if url.endswith("/x")] == []
        assert await tab.value("(() => { try { document.body.innerHTML = '<b>'; return true; }"
                               " catch (error) { return false; } })()") is False
        tab.errors.clear()  # lines of numbers that are none, and what was refused
