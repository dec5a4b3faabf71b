"""The robot at its airport from behind and above, for `rampart replay --viewer` and `--video`."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import mujoco
import numpy as np
import shapely
from PIL import Image, ImageDraw

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.osmosis.application import Osmosis
from rampart.sim.osmosis.scene import Scene, WorldError
from rampart.sim.runs.physics import RobotModel

PIXELS_PER_M = 10
MAX_PIXELS = 8192
"""Longer side of the ground's picture; a large airport has fewer pixels per metre."""

MARGIN_M = 30.0
"""Width of the grass drawn around the airport."""

_GRASS, _PAVEMENT, _RUNWAY = (96, 122, 78), (150, 155, 160), (112, 117, 123)
_LIGHT, _LINE = (255, 244, 200), (210, 190, 90)
_SKY, _HORIZON = (0.55, 0.72, 0.9), (0.86, 0.91, 0.96)


class AirportModel(RobotModel):
    """The robot at its airport, from behind and above.

    Args:
        application: gives the airport.
    """

    def __init__(self, application: Osmosis) -> None:
        airport = application.airport
        self._scene = Scene(airport, lambda spec: dress(spec, airport))
        super().__init__(self._scene.model, self._scene.data)
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self.camera.distance, self.camera.elevation = 4.6, -22.0
        self.options.geomgroup[:] = (1, 1, 1, 1, 0, 0)  # absent obstacles are in group 4

    def take(self, topic: Topic[Any], body: Any) -> None:
        """Place the robot by its published pose, and the present obstacles."""
        if topic == topics.POSE:
            self.place(body.x_m, body.y_m, body.yaw_rad)
        elif topic == topics.OBSTACLES:
            self.put({o.name: (o.x_m, o.y_m, o.radius_m) for o in body.obstacles if o.present})

    def place(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Place the robot; a pose that is not finite is ignored."""
        if all(map(math.isfinite, (x_m, y_m, yaw_rad))):
            self._scene.place_robot(x_m, y_m, yaw_rad)
            ahead = 1.2
            self.camera.lookat[:] = (x_m + ahead * math.cos(yaw_rad),
                                     y_m + ahead * math.sin(yaw_rad), 0.3)
            self.camera.azimuth = math.degrees(yaw_rad)

    def put(self, obstacles: dict[str, tuple[float, float, float]]) -> None:
        """Show these obstacles and no others: name → x, y and radius, m."""
        scene = self._scene
        for name in [n for n in scene.present if n not in obstacles]:
            scene.remove(name)
        for name, (x, y, r) in obstacles.items():
            there = scene.present.get(name)
            if there is None or (there.x_m, there.y_m, there.radius_m) != (x, y, r):
                with contextlib.suppress(WorldError):  # too many, or invalid
                    scene.put(name, x, y, r, shapely.Polygon())


def dress(spec: Any, airport: Airport) -> None:
    """Add ground, sky, light and colours to a model."""
    x0, y0, x1, y1 = _extent(airport)
    ground = spec.add_texture(name="ground", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    image = ground_image(airport)
    ground.width, ground.height = image.size
    ground.data = np.asarray(image, dtype=np.uint8).tobytes()
    spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
                     builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, width=64, height=64,
                     rgb1=list(_SKY), rgb2=list(_HORIZON))
    material = spec.add_material(name="ground", reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
    floor = spec.geom("floor")
    floor.material = "ground"
    floor.size = [(x1 - x0) / 2, (y1 - y0) / 2, 1]
    floor.pos = [(x0 + x1) / 2, (y0 + y1) / 2, 0]
    spec.worldbody.add_light(pos=[(x0 + x1) / 2, (y0 + y1) / 2, 60], dir=[0.3, 0.2, -1],
                             type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=False,
                             diffuse=[0.75, 0.75, 0.72], ambient=[0.3, 0.3, 0.32])
    spec.geom("chassis").rgba = [0.16, 0.17, 0.2, 1]
    for geom in spec.geoms:
        if geom.name.startswith("obstacle/"):
            geom.rgba = [0.86, 0.42, 0.1, 1]
        elif geom.name.startswith("building/"):
            geom.rgba = [0.62, 0.64, 0.68, 1]
        elif geom.name.startswith(("front_", "rear_")):
            geom.rgba = [0.06, 0.06, 0.07, 1]
    spec.visual.map.zfar = 60.0
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 2


def ground_image(airport: Airport) -> Image.Image:
    """Return the ground from above, north up: grass, pavement, graph and lights."""
    x0, y0, x1, y1 = _extent(airport)
    pixels_per_m = min(PIXELS_PER_M, MAX_PIXELS / max(x1 - x0, y1 - y0))
    image = Image.new(
        "RGB", (round((x1 - x0) * pixels_per_m), round((y1 - y0) * pixels_per_m)), _GRASS)
    pen = ImageDraw.Draw(image)

    def at(x: float, y: float) -> tuple[float, float]:
        return (x - x0) * pixels_per_m, (y1 - y) * pixels_per_m

    def fill(shape: Any, colour: tuple[int, int, int]) -> None:
        for part in shapely.get_parts(shape):
            if part.geom_type == "Polygon" and not part.is_empty:
                mask = Image.new("1", image.size)  # holes keep their ground
                mask_pen = ImageDraw.Draw(mask)
                mask_pen.polygon([at(x, y) for x, y in part.exterior.coords], 1)
                for hole in part.interiors:
                    mask_pen.polygon([at(x, y) for x, y in hole.coords], 0)
                image.paste(colour, mask=mask)

    for surface in sorted(airport.surfaces, key=lambda s: s.kind == "runway"):
        fill(surface.polygon, _RUNWAY if surface.kind == "runway" else _PAVEMENT)
    fill(airport.prohibited_polygon(0.0), _GRASS)
    for a, b in airport.edges:
        pen.line([at(*airport.nodes[a]), at(*airport.nodes[b])], _LINE, 2)
    for light in airport.lights:
        x, y = at(light.x_m, light.y_m)
        pen.ellipse((x - 3, y - 3, x + 3, y + 3), _LIGHT, (60, 60, 60))
    return image


def _extent(airport: Airport) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = airport.bounds_m
    return x0 - MARGIN_M, y0 - MARGIN_M, x1 + MARGIN_M, y1 + MARGIN_M
