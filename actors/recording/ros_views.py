"""Translates views to types that viewers of ROS 2 draw (RViz, PlotJuggler). Pure.

A recording has its views in JSON (`foxglove`, `views`). Each becomes one message, except that a
scan becomes two: the pose of the laser, and its ranges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from rampart.actors.recording import foxglove as fg
from rampart.actors.ros2.translation.types import Types

TF, ROSOUT = "/tf", "/rosout"
"""Topics of transforms and of the log in ROS 2."""

_TF, _LOG = "tf2_msgs/msg/TFMessage", "rcl_interfaces/msg/Log"
_SCAN, _POSE = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/PoseStamped"
_MARKERS, _MARKER = "visualization_msgs/msg/MarkerArray", "visualization_msgs/msg/Marker"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"

_NEAREST_M = 0.001
"""Least valid range."""

_PIXEL_M = 0.01
"""Width of a pixel, for lines whose width is in pixels."""

_ADD, _DELETE_ALL = 0, 3
_ARROW, _CUBE, _CYLINDER, _STRIP, _LIST, _TEXT, _TRIANGLES = 0, 1, 3, 4, 5, 9, 11

Shown = Iterator[tuple[str, str, bytes]]
"""Topic of ROS 2, its type, and a message of it."""


class RosViews:
    """Translates views.

    Args:
        types: of ROS 2.
    """

    def __init__(self, types: Types) -> None:
        self._types = types
        self._ways: Mapping[str, tuple[type[fg.Record], Callable[[str, Any], Shown]]] = {
            fg.schema_name(kind): (kind, way) for kind, way in (
                (fg.FrameTransforms, self._transforms), (fg.PoseInFrame, self._pose),
                (fg.LaserScan, self._scan), (fg.Log, self._log), (fg.SceneUpdate, self._scene))}

    def of(self, schema: str, channel: str, data: bytes) -> Shown:
        """Yield the messages for a view; none for an unknown schema.

        Args:
            schema: name of its schema.
            channel: name of its channel.
            data: the view as JSON.

        Raises:
            ValueError: it does not decode, or a value does not fit its field in ROS 2.
        """
        if schema in self._ways:
            kind, way = self._ways[schema]
            yield from way(f"/{channel}", msgspec.json.decode(data, type=kind))

    # -- each kind --------------------------------------------------------------------------------

    def _transforms(self, _topic: str, view: fg.FrameTransforms) -> Shown:
        yield self._tf([self._transform(
            one.timestamp, one.parent_frame_id, one.child_frame_id, one.translation, one.rotation)
            for one in view.transforms])

    def _pose(self, topic: str, view: fg.PoseInFrame) -> Shown:
        made = self._stamped(_POSE, view.timestamp, view.frame_id)
        self._place(made.pose, view.pose)
        yield self._encoded(topic, _POSE, made)

    def _scan(self, topic: str, view: fg.LaserScan) -> Shown:
        frame, at = topic.strip("/").replace("/", "_"), view.pose
        yield self._tf([self._transform(
            view.timestamp, view.frame_id, frame, at.position, at.orientation)])
        made = self._stamped(_SCAN, view.timestamp, frame)
        made.angle_min, made.angle_max = view.start_angle, view.end_angle
        made.angle_increment = (view.end_angle - view.start_angle) / max(1, len(view.ranges) - 1)
        made.range_min, made.range_max = _NEAREST_M, max(view.ranges, default=0.0)
        made.ranges = self._types.numbers(view.ranges)
        made.intensities = self._types.numbers(view.intensities)
        yield self._encoded(topic, _SCAN, made)

    def _log(self, _topic: str, view: fg.Log) -> Shown:
        made = self._types.blank(_LOG)
        self._time(made.stamp, view.timestamp)
        made.level = 10 * int(view.level)  # ROS 2 counts levels in tens
        made.name, made.msg, made.file, made.line = view.name, view.message, view.file, view.line
        yield self._encoded(ROSOUT, _LOG, made)

    def _scene(self, topic: str, view: fg.SceneUpdate) -> Shown:
        made = self._types.blank(_MARKERS)
        if any(one.type is fg.DeletionType.ALL for one in view.deletions):
            marker = self._types.blank(_MARKER)
            marker.action = _DELETE_ALL
            made.markers.append(marker)
        for entity in view.entities:
            for number, marker in enumerate(self._markers(entity)):
                marker.ns, marker.id, marker.action = entity.id, number, _ADD
                made.markers.append(marker)
        yield self._encoded(topic, _MARKERS, made)

    def _markers(self, entity: fg.SceneEntity) -> Iterator[Any]:
        for arrow in entity.arrows:
            yield self._marker(entity, _ARROW, arrow.pose, arrow.color, (
                arrow.shaft_length + arrow.head_length, arrow.shaft_diameter, arrow.shaft_diameter))
        for kind, solids in ((_CUBE, entity.cubes), (_CYLINDER, entity.cylinders)):
            for solid in solids:
                yield self._marker(entity, kind, solid.pose, solid.color,
                                   (solid.size.x, solid.size.y, solid.size.z))
        for line in entity.lines:
            width_m = _PIXEL_M * line.thickness if line.scale_invariant else line.thickness
            points = [line.points[n] for n in line.indices] if line.indices else [*line.points]
            if line.type is fg.LineType.LINE_LOOP:
                points += points[:1]
            kind = _LIST if line.type is fg.LineType.LINE_LIST else _STRIP
            yield self._marker(entity, kind, line.pose, line.color, (width_m, 0.0, 0.0),
                               points=points)
        for faces in entity.triangles:
            points = [faces.points[n] for n in faces.indices or range(len(faces.points))]
            yield self._marker(entity, _TRIANGLES, faces.pose, faces.color, (1.0, 1.0, 1.0),
                               points=points)
        for text in entity.texts:
            marker = self._marker(entity, _TEXT, text.pose, text.color, (
                0.0, 0.0, text.font_size * (_PIXEL_M if text.scale_invariant else 1.0)))
            marker.text = text.text
            yield marker

    # -- their parts ------------------------------------------------------------------------------

    def _marker(self, entity: fg.SceneEntity, kind: int, pose: fg.Pose, color: fg.Color,
                size_m: tuple[float, float, float], *, points: Sequence[fg.Vector3] = ()) -> Any:
        made = self._stamped(_MARKER, entity.timestamp, entity.frame_id)
        self._place(made.pose, pose)
        made.type, made.frame_locked = kind, entity.frame_locked
        self._time(made.lifetime, entity.lifetime)
        made.scale.x, made.scale.y, made.scale.z = size_m
        made.color = self._types.like("std_msgs/msg/ColorRGBA", color)
        made.points = [self._types.like("geometry_msgs/msg/Point", point) for point in points]
        return made

    def _transform(self, at: fg.Time, parent: str, child: str, moved: fg.Vector3,
                   turned: fg.Quaternion) -> Any:
        made = self._stamped(_TRANSFORM, at, parent)
        made.child_frame_id = child
        made.transform.translation = self._types.like("geometry_msgs/msg/Vector3", moved)
        made.transform.rotation = self._types.like("geometry_msgs/msg/Quaternion", turned)
        return made

    def _tf(self, transforms: list[Any]) -> tuple[str, str, bytes]:
        return self._encoded(TF, _TF, self._types.new(_TF, {"transforms": transforms}))

    def _place(self, pose: Any, view: fg.Pose) -> None:
        pose.position = self._types.like("geometry_msgs/msg/Point", view.position)
        pose.orientation = self._types.like("geometry_msgs/msg/Quaternion", view.orientation)

    def _stamped(self, kind: str, at: fg.Time, frame: str) -> Any:
        made = self._types.blank(kind)
        self._time(made.header.stamp, at)
        made.header.frame_id = frame
        return made

    @staticmethod
    def _time(made: Any, at: fg.Time) -> None:
        made.sec, made.nanosec = at.sec, at.nsec

    def _encoded(self, topic: str, kind: str, made: Any) -> tuple[str, str, bytes]:
        return topic, kind, self._types.encode(kind, made)
