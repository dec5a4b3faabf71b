"""Builds the MuJoCo model of an airport: floor, robot, buildings and a pool of obstacles.

MuJoCo's model is fixed once compiled, so obstacles that appear later come from a pool of mocap
bodies: one per preset and `SPARE_OBSTACLES` others. An absent obstacle is parked below the ground,
without collisions and in a group that rays ignore.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import shapely
from shapely.geometry import Point

from rampart.actors.osmosis.airport.model import Airport, ObstacleShape, rectangle

MODEL_FILE = Path(__file__).with_name("summit_xl.xml")
SPARE_OBSTACLES = 6
OBSTACLE_HALF_HEIGHT_M = 0.6
PRESENT_GROUP, ABSENT_GROUP, SOLID_GROUP = 3, 4, 3
COLLIDES_WITH_CHASSIS = 2
NOTHING_M = 1000.0
FARTHEST_M = 1e6
"""Largest coordinate of an obstacle."""

_PARKED_Z_M = -10.0


class WorldError(ValueError):
    """An invalid request to the world: one line with value and remedy."""


@dataclass(slots=True)
class Solid:
    """A present obstacle with its ground plan for clearances."""

    name: str
    shape: ObstacleShape
    x_m: float
    y_m: float
    radius_m: float

    @property
    def outline(self) -> Any:
        """Ground plan as a shapely polygon."""
        if self.shape == "box":
            return rectangle(self.x_m, self.y_m, 0.0, 2 * self.radius_m, 2 * self.radius_m)
        return Point(self.x_m, self.y_m).buffer(self.radius_m, quad_segs=16)


class Scene:
    """The compiled model and data, and the obstacles in them.

    Args:
        airport: gives buildings, obstacle presets and the start pose.
        dress: adds visual elements (`rampart.sim.osmosis.camera`) before the model is compiled.
    """

    def __init__(self, airport: Airport, dress: Callable[[Any], None] = lambda _spec: None) -> None:
        spec = mujoco.MjSpec.from_file(str(MODEL_FILE))
        for building in airport.buildings:
            spec.worldbody.add_geom(
                name=f"building/{building.name}", type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[building.length_m / 2, building.width_m / 2, building.height_m / 2],
                pos=[building.x_m, building.y_m, building.height_m / 2],
                quat=_turned(building.yaw_rad),
                contype=0, conaffinity=COLLIDES_WITH_CHASSIS, group=SOLID_GROUP)
        self._shapes = {preset.name: preset.shape for preset in airport.obstacles}
        shapes = [*self._shapes.values(), *["cylinder"] * SPARE_OBSTACLES]
        for i, shape in enumerate(shapes):
            body = spec.worldbody.add_body(name=f"obstacle/{i}", mocap=True)
            box = shape == "box"
            body.add_geom(
                name=f"obstacle/{i}",
                type=mujoco.mjtGeom.mjGEOM_BOX if box else mujoco.mjtGeom.mjGEOM_CYLINDER,
                size=[0.3, 0.3 if box else OBSTACLE_HALF_HEIGHT_M, OBSTACLE_HALF_HEIGHT_M],
                contype=0, conaffinity=0, group=ABSENT_GROUP)
        dress(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._slots = {name: i for i, name in enumerate(self._shapes)}
        self._spare = list(range(len(self._shapes), len(shapes)))
        self.present: dict[str, Solid] = {}
        self._buildings = [building.polygon for building in airport.buildings]
        self.base = self.model.body("base").id
        for i in range(len(shapes)):
            self._park(i)
        self.place_robot(airport.start.x_m, airport.start.y_m, airport.start.yaw_rad)
        mujoco.mj_forward(self.model, self.data)
        self._refresh()

    def place_robot(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Move the robot; the caller runs `mj_forward`."""
        self.data.qpos[0:2] = x_m, y_m
        self.data.qpos[3:7] = _turned(yaw_rad)

    def put(self, name: str, x_m: float, y_m: float, radius_m: float, footprint: Any) -> None:
        """Add or move an obstacle; a preset keeps its shape.

        Args:
            name: name of the obstacle.
            x_m: position in `map`.
            y_m: position in `map`.
            radius_m: radius or half side.
            footprint: the robot's footprint as a shapely polygon, which must be free.

        Raises:
            WorldError: not finite, too far away, invalid radius, on the robot, or the pool is
                empty.
        """
        solid = Solid(name, self._shapes.get(name, "cylinder"), x_m, y_m, radius_m)
        if not all(map(math.isfinite, (x_m, y_m, radius_m))):
            raise WorldError(f"obstacle {name}: {solid}: position and radius must be finite")
        if not max(abs(x_m), abs(y_m)) <= FARTHEST_M:
            raise WorldError(f"obstacle {name}: ({x_m:g}, {y_m:g}): must be within "
                             f"{FARTHEST_M:g} m of the origin")
        if not 0.05 <= radius_m <= 5.0:
            raise WorldError(f"obstacle {name}: radius_m: {radius_m:g}: must be in 0.05 to 5 m")
        if solid.outline.intersects(footprint):
            raise WorldError(f"obstacle {name}: ({x_m:g}, {y_m:g}): on the robot; expected beside "
                             "it")
        if name not in self._slots:
            if not self._spare:
                raise WorldError(f"obstacle {name}: too many: expected at most "
                                 f"{SPARE_OBSTACLES} besides the presets")
            self._slots[name] = self._spare.pop()
        r, h = radius_m, OBSTACLE_HALF_HEIGHT_M
        box = solid.shape == "box"
        geom, body = self._place(self._slots[name], (x_m, y_m, h), present=True)
        self.model.geom_size[geom] = (r, r, h) if box else (r, h, 0)
        self.model.geom_rbound[geom] = math.hypot(r * (2**0.5 if box else 1), h)
        self.model.geom_aabb[geom] = (0, 0, 0, r, r, h)
        self.model.bvh_aabb[self.model.body_bvhadr[body]] = (0, 0, 0, r, r, h)
        self.present[name] = solid
        self._refresh()

    def remove(self, name: str) -> bool:
        """Remove an obstacle; return whether it was present."""
        if self.present.pop(name, None) is None:
            return False
        self._park(self._slots[name])
        if name not in self._shapes:
            self._spare.append(self._slots.pop(name))
        self._refresh()
        return True

    def _park(self, slot: int) -> None:
        self._place(slot, (0.0, 3.0 * slot, _PARKED_Z_M), present=False)

    def _place(self, slot: int, at: tuple[float, float, float], *, present: bool
               ) -> tuple[int, int]:
        """Move an obstacle of the pool; return its geom and its body."""
        collides_with = COLLIDES_WITH_CHASSIS if present else 0
        geom = self.model.geom(f"obstacle/{slot}").id
        body = self.model.body(f"obstacle/{slot}").id
        self.model.geom_conaffinity[geom] = collides_with
        self.model.body_conaffinity[body] = collides_with
        self.model.geom_group[geom] = PRESENT_GROUP if present else ABSENT_GROUP
        self.data.mocap_pos[self.model.body_mocapid[body]] = at
        return geom, body

    def _refresh(self) -> None:
        """Update derived positions, so that rays see the change at once."""
        mujoco.mj_kinematics(self.model, self.data)
        outlines = [*self._buildings, *(solid.outline for solid in self.present.values())]
        self.outlines = shapely.unary_union(outlines) if outlines else None

    def clearance_m(self, footprint: Any) -> float:
        """Return the distance to the nearest obstacle or building, `NOTHING_M` without one."""
        return NOTHING_M if self.outlines is None else float(self.outlines.distance(footprint))

    def touched(self) -> set[str]:
        """Return the names of the geoms that the chassis touches."""
        chassis = self.model.geom("chassis").id
        return {self.model.geom(int(b if a == chassis else a)).name
                for a, b in self.data.contact.geom if chassis in (a, b)}


def _turned(yaw_rad: float) -> tuple[float, float, float, float]:
    """Return a quaternion about the vertical axis."""
    return math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2)
