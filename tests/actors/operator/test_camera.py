"""The picture of the robot: a renderer of its own that may be missing, hang, die and come back."""

from __future__ import annotations

import asyncio
import io
import os
import signal
import sys

import httpx
import msgspec
import pytest
import shapely
from PIL import Image

from rampart.actors.operator import camera_eye
from rampart.actors.operator.camera_eye import CameraError, CameraEye
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, Building, StartPose, Surface
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.sim.osmosis.camera import MARGIN_M, MAX_PIXELS, View, ground_image
from tests.actors.operator.page import show
from tests.actors.operator.world import World, served

ECHO = """
import struct, sys
sys.stdin.buffer.readline()
for line in sys.stdin.buffer:
    sys.stdout.buffer.write(struct.pack(">I", len(line)) + line)
    sys.stdout.flush()
"""
"""A renderer that sends back what it is to show."""


def eye(program: str, view=lambda: {"n": 1}) -> CameraEye:
    return CameraEye((sys.executable, "-c", program), {"airport": "vallombre"}, view)


@pytest.fixture(autouse=True)
async def no_renderer_is_left(monkeypatch):
    eyes = []
    make = CameraEye.__init__

    def note(self, *arguments) -> None:
        make(self, *arguments)
        eyes.append(self)

    monkeypatch.setattr(CameraEye, "__init__", note)
    yield
    for camera in eyes:
        camera.close()
        await camera.ended()
    await asyncio.sleep(0)  # what has ended closes its pipes


async def test_all_who_ask_within_a_period_get_the_same_picture():
    count = iter(range(100))
    camera = eye(ECHO, lambda: {"n": next(count)})
    assert set(await asyncio.gather(*(camera.picture() for _ in range(5)))) == {b'{"n":0}\n'}
    assert next(count) == 1


async def test_a_renderer_that_was_killed_is_started_again(monkeypatch):
    monkeypatch.setattr(camera_eye, "PERIOD_S", 0.0)
    monkeypatch.setattr(camera_eye, "RETRY_S", 0.0)
    camera = eye(ECHO)
    await camera.picture()
    first = camera._process
    os.kill(first.pid, signal.SIGKILL)
    await first.wait()
    assert await camera.picture() == b'{"n":1}\n'
    assert camera._process.pid != first.pid


async def test_a_renderer_that_hangs_is_killed_and_the_page_told(monkeypatch):
    monkeypatch.setattr(camera_eye, "START_S", 0.3)
    camera = eye("import time; time.sleep(60)")
    with pytest.raises(CameraError, match="does not answer"):
        await camera.picture()
    assert camera._process is None


async def test_where_nothing_can_be_rendered_the_reason_is_told_and_not_tried_at_once_again(
        tmp_path):
    starts = tmp_path / "starts"
    camera = eye(f"open({str(starts)!r}, 'a').write('x'); raise SystemExit('no EGL here')")
    for _ in range(3):
        with pytest.raises(CameraError, match="this machine cannot render: no EGL here"):
            await camera.picture()
    assert starts.read_text() == "x"


async def test_nonsense_from_a_renderer_is_no_picture():
    camera = eye("import sys; sys.stdout.write('hello world'); sys.stdout.flush(); input()")
    with pytest.raises(CameraError, match="a picture of 1751477356 bytes"):
        await camera.picture()


async def test_a_renderer_that_nobody_looks_through_is_ended(monkeypatch):
    monkeypatch.setattr(camera_eye, "IDLE_S", 0.05)
    camera = eye(ECHO)
    await camera.picture()
    process = camera._process
    assert await asyncio.wait_for(process.wait(), 5) == -signal.SIGKILL
    assert camera._process is None


def square(half_m: float) -> shapely.Polygon:
    return shapely.box(-half_m, -half_m, half_m, half_m)


def test_pavement_within_grass_and_grass_within_a_ring_are_drawn_as_what_they_are():
    ring, island = square(20).difference(square(10)), square(3)
    airport = Airport(
        "island", {}, (), ring.union(island), StartPose(15.0, 0.0, 0.0),
        (Surface("middle", "apron", island), Surface("ring", "taxiway", ring)),
        (Building("tower", 40.0, 0.0, 2.0, 2.0, 5.0), Building("hut", -40.0, 0.0, 2.0, 2.0, 5.0),
         Building("shed", 0.0, 40.0, 2.0, 2.0, 5.0), Building("barn", 0.0, -40.0, 2.0, 2.0, 5.0)))
    assert max(len(part.interiors) for part in
               shapely.get_parts(airport.prohibited_polygon(0.0))) == 1, "the ring is a hole in it"
    image = ground_image(airport)
    x0, _, _, y1 = airport.bounds_m

    def grey(x: float, y: float) -> bool:
        colour = image.getpixel((round((x - x0 + MARGIN_M) * 10), round((y1 + MARGIN_M - y) * 10)))
        return max(colour) - min(colour) < 20

    assert [grey(x, 0.0) for x in (0.0, 6.0, 15.0, 30.0)] == [True, False, True, False]


def test_a_large_airport_has_a_picture_of_its_ground_that_fits_into_a_texture():
    runway = shapely.box(0.0, 0.0, 4000.0, 45.0)
    image = ground_image(Airport("long", {}, (), runway, StartPose(5.0, 5.0, 0.0),
                                 (Surface("runway", "runway", runway),)))
    assert image.size[0] == MAX_PIXELS
    colour = image.getpixel((MAX_PIXELS // 2, image.size[1] // 2))
    assert max(colour) - min(colour) < 20, "grey"


class Seen(OsmosisHmi):
    """An HMI with the camera of the shipped systems, or another."""

    def __init__(self, context, module: str = "rampart.sim.osmosis.camera") -> None:
        context.parameters["camera"] = module
        super().__init__(context)


async def test_the_page_gets_pictures_of_the_robot_and_other_sites_do_not(world):
    async with (world.running(Seen(world.context("hmi", 1))) as hmi,
                httpx.AsyncClient(timeout=40) as client):
        url = f"http://{await served(hmi)}/camera.jpg"
        foreign = await client.get(url, headers={"sec-fetch-site": "cross-site"})
        assert foreign.status_code == 403
        blind = await client.get(url)
        assert (blind.status_code, blind.text) == (503, "the robot's pose is not known")
        world.others.publish(topics.POSE, m.Pose(-22.0, -18.5, 0.0))
        answer = await client.get(url)
        if answer.status_code == 503:
            assert "this machine cannot render: " in answer.text
            pytest.skip(answer.text)
        picture = Image.open(io.BytesIO(answer.content))
        assert (picture.format, picture.size) == ("JPEG", (416, 260))
        assert len(picture.convert("P").getcolors()) > 20, "not just one colour"


async def test_a_pose_and_an_obstacle_that_are_no_numbers_end_no_renderer(monkeypatch):
    monkeypatch.setattr(camera_eye, "PERIOD_S", 0.0)
    hmi = Seen(World().context("hmi", 1))
    nan = float("nan")
    hmi._state.pose(m.Pose(nan, -18.5, nan), 0.0, 0.0)
    hmi._state.obstacles(m.ObstacleList((m.ObstacleCommand("crate", True, nan, 0.0, nan),)))
    line = msgspec.json.encode(hmi._camera_view())
    hmi._state.pose(m.Pose(-22.0, -18.5, 0.0), 0.0, 0.0)
    hmi._state.obstacles(m.ObstacleList(()))
    assert msgspec.json.decode(line, type=View).obstacles == (("crate", None, 0.0, None),)
    try:
        before = await hmi._camera.picture()
    except CameraError as error:
        pytest.skip(str(error))
    renderer_before = hmi._camera._process
    hmi._camera._view = lambda: msgspec.Raw(line)
    assert await hmi._camera.picture() == before, "the last pose, and no obstacle"
    assert hmi._camera._process is renderer_before


@pytest.mark.page
async def test_the_renderer_starts_when_somebody_looks_and_the_page_says_what_is_wrong_with_it(
        world, tab):
    async with world.running(Seen(world.context("hmi", 1), "nobody.renders")) as hmi:
        await show(tab, hmi)
        world.others.publish(topics.POSE, m.Pose(-22.0, -18.5, 0.0))
        await tab.until("!document.getElementById('camera-panel').hidden")
        assert hmi._camera._process is None
        await tab.value("document.getElementById('camera-show').click()")
        words = "document.getElementById('camera-text').textContent"
        await tab.until(f"{words}.startsWith('No picture: this machine cannot render: ')")
        assert "No module named 'nobody'" in await tab.value(words)
        assert await tab.value("document.getElementById('camera').hidden") is True
        tab.errors.clear()  # it reports the answer of the server
