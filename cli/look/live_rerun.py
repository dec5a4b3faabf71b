"""Views for a Rerun viewer, over `rerun-sdk`.

The tree of entities is the tree of frames: what is fixed to `base_link` lies below it and moves
with its transforms. Each run is a recording of its own, on a timeline of simulated seconds.
"""

from __future__ import annotations

import math
from typing import Any

import rerun as rr

from rampart.actors.recording import foxglove as fg
from rampart.actors.run.run_info import RunInfo

APPLICATION = "rampart"
TIMELINE = "simulated"
_FRAMES = {"map": "map", "odom": "map/odom", "base_link": "map/odom/base_link"}
_LEVELS = {fg.LogLevel.INFO: "INFO", fg.LogLevel.WARNING: "WARN", fg.LogLevel.ERROR: "ERROR",
           fg.LogLevel.FATAL: "CRITICAL"}


class RerunViewer:
    """A viewer or a file.

    The SDK could serve viewers, too, but only to the whole network.

    Args:
        connect: URL of a viewer that is open; None for none.
        save: file to write; None for none. Without both a viewer is opened.
    """

    def __init__(self, connect: str | None = None, save: str | None = None) -> None:
        self._connect = connect
        self._save = save
        self._runs = 0
        self._stream: Any = None

    def begin(self, run: RunInfo) -> None:
        """Begin a recording; a file of a second run gets a number."""
        self.close()
        self._runs += 1
        self._stream = stream = rr.RecordingStream(APPLICATION, recording_id=run.run_id)
        if self._save is not None:
            stream.save(self._save if self._runs == 1 else f"{self._save}.{self._runs}")
        elif self._connect is not None:
            stream.connect_grpc(self._connect)
        else:
            stream.spawn()
        stream.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def show(self, channel: str, record: Any, at_ns: int) -> None:
        """Log a view."""
        if self._stream is None:
            return
        self._stream.set_time(TIMELINE, duration=at_ns / 1e9)
        if isinstance(record, fg.SceneUpdate):
            self._scene(channel, record)
        elif isinstance(record, fg.FrameTransforms):
            for one in record.transforms:
                self._stream.log(_FRAMES[one.child_frame_id], rr.Transform3D(
                    translation=_xyz(one.translation), quaternion=_xyzw(one.rotation)))
        elif isinstance(record, fg.LaserScan):
            self._stream.log(_path(record.frame_id, channel), rr.Points3D(
                sweep_points(record), radii=0.04))
        elif isinstance(record, fg.Log):
            self._stream.log(f"log/{record.name}", rr.TextLog(
                record.message, level=_LEVELS.get(record.level, "INFO")))

    def close(self) -> None:
        """Hand over what is left.

        Raises:
            RuntimeError: nobody takes it.
        """
        stream, self._stream = self._stream, None
        if stream is not None:
            try:
                stream.flush()
            finally:
                stream.disconnect()

    def _scene(self, channel: str, scene: fg.SceneUpdate) -> None:
        """Log a scene; a message holds all of its channel, so what was there before goes."""
        for entity in scene.entities:
            path = f"{_path(entity.frame_id, channel)}/{entity.id}"
            self._stream.log(path, rr.Clear(recursive=True))
            for kind, archetype in _archetypes(entity):
                self._stream.log(f"{path}/{kind}", archetype)


def sweep_points(scan: fg.LaserScan) -> list[tuple[float, float, float]]:
    """Return where a sweep saw something, in its frame; 0 is no echo. Pure."""
    count = len(scan.ranges)
    step = (scan.end_angle - scan.start_angle) / (count - 1) if count > 1 else 0.0
    height_m = scan.pose.position.z
    return [(r * math.cos(scan.start_angle + i * step), r * math.sin(scan.start_angle + i * step),
             height_m) for i, r in enumerate(scan.ranges) if r > 0]


def _archetypes(entity: fg.SceneEntity) -> list[tuple[str, Any]]:
    """Return what an entity is made of, each kind of primitive in one piece where that can be."""
    found: list[tuple[str, Any]] = []
    for number, mesh in enumerate(entity.triangles):
        if mesh.points:
            found.append((f"surface_{number}", rr.Mesh3D(
                vertex_positions=[_xyz(p) for p in mesh.points], albedo_factor=_rgba(mesh.color))))
    if entity.lines:
        found.append(("lines", rr.LineStrips3D(
            [strip for line in entity.lines for strip in _strips(line)],
            colors=[_rgba(line.color) for line in entity.lines for _ in _strips(line)],
            radii=rr.Radius.ui_points(1.0))))
    if entity.cubes:
        found.append(("boxes", rr.Boxes3D(
            centers=[_xyz(c.pose.position) for c in entity.cubes],
            sizes=[_xyz(c.size) for c in entity.cubes],
            quaternions=[rr.Quaternion(xyzw=_xyzw(c.pose.orientation)) for c in entity.cubes],
            colors=[_rgba(c.color) for c in entity.cubes], fill_mode="solid")))
    if entity.cylinders:
        found.append(("cylinders", rr.Cylinders3D(
            lengths=[c.size.z for c in entity.cylinders],
            radii=[c.size.x / 2 for c in entity.cylinders],
            centers=[_xyz(c.pose.position) for c in entity.cylinders],
            colors=[_rgba(c.color) for c in entity.cylinders], fill_mode="solid")))
    if entity.arrows:
        found.append(("arrows", rr.Arrows3D(
            origins=[_xyz(a.pose.position) for a in entity.arrows],
            vectors=[(a.shaft_length + a.head_length, 0.0, 0.0) for a in entity.arrows],
            colors=[_rgba(a.color) for a in entity.arrows])))
    if entity.texts:
        found.append(("labels", rr.Points3D(
            [_xyz(t.pose.position) for t in entity.texts], radii=0.0,
            labels=[t.text for t in entity.texts], colors=[_rgba(t.color) for t in entity.texts])))
    return found


def _strips(line: fg.LinePrimitive) -> list[list[tuple[float, float, float]]]:
    points = [_xyz(p) for p in line.points]
    if line.type is fg.LineType.LINE_LIST:
        return [points[i:i + 2] for i in range(0, len(points) - 1, 2)]
    if line.type is fg.LineType.LINE_LOOP and points:
        points = [*points, points[0]]
    return [points] if len(points) > 1 else []


def _path(frame: str, channel: str) -> str:
    return f"{_FRAMES.get(frame, 'map')}/{channel.removeprefix('view/')}"


def _xyz(vector: fg.Vector3) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _xyzw(rotation: fg.Quaternion) -> tuple[float, float, float, float]:
    return rotation.x, rotation.y, rotation.z, rotation.w


def _rgba(color: fg.Color) -> tuple[int, int, int, int]:
    red, green, blue, opacity = (
        round(255 * share) for share in (color.r, color.g, color.b, color.a))
    return red, green, blue, opacity
