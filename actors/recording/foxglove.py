"""Messages in the JSON schemas of Foxglove-compatible viewers.

Field names, enumerations and frames follow the published lists
(https://docs.foxglove.dev/docs/sdk/schemas). Primitives that nothing draws here are left out, which
the schema of a scene entity permits. The schema of the type `Log` is named `foxglove.Log`.
"""

from __future__ import annotations

import math
from enum import IntEnum

import msgspec

PREFIX = "foxglove."


class Record(msgspec.Struct, frozen=True, gc=False):
    """Base class of all messages."""


class Time(Record, frozen=True):
    """A time or duration."""

    sec: int
    nsec: int


class Vector3(Record, frozen=True):
    """A vector or point, m; the published lists have both, with the same fields."""

    x: float
    y: float
    z: float


class Quaternion(Record, frozen=True):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class Pose(Record, frozen=True):
    """Position and orientation in some frame."""

    position: Vector3
    orientation: Quaternion


class Color(Record, frozen=True):
    """Red, green, blue and opacity, 0 to 1."""

    r: float
    g: float
    b: float
    a: float


class Stamped(Record, frozen=True):
    """Base class of messages with a time and a frame."""

    timestamp: Time
    frame_id: str


class PoseInFrame(Stamped, frozen=True):
    """A pose at a time."""

    pose: Pose


class FrameTransform(Record, frozen=True):
    """Pose of a child frame in its parent."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(Record, frozen=True):
    """Several transforms."""

    transforms: tuple[FrameTransform, ...]


class LaserScan(Stamped, frozen=True):
    """A sweep of a planar laser, m and rad; null is a lost echo."""

    pose: Pose
    start_angle: float
    end_angle: float
    ranges: list[float]
    intensities: list[float]


class LogLevel(IntEnum):
    """Severity of a line."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


class Log(Record, frozen=True):
    """A line of a log; `file` and `line` stay empty here."""

    timestamp: Time
    level: LogLevel
    message: str
    name: str
    file: str = ""
    line: int = 0


class LineType(IntEnum):
    """How points are joined."""

    LINE_STRIP = 0
    LINE_LOOP = 1
    LINE_LIST = 2


class LinePrimitive(Record, frozen=True):
    """Points joined by lines; the thickness is in pixels if `scale_invariant`, otherwise in m."""

    type: LineType
    pose: Pose
    thickness: float
    scale_invariant: bool
    points: tuple[Vector3, ...]
    color: Color
    colors: tuple[Color, ...] = ()
    indices: tuple[int, ...] = ()


class TriangleListPrimitive(Record, frozen=True):
    """A surface of triangles: three points each."""

    pose: Pose
    points: tuple[Vector3, ...]
    color: Color
    colors: tuple[Color, ...] = ()
    indices: tuple[int, ...] = ()


class CubePrimitive(Record, frozen=True):
    """A box."""

    pose: Pose
    size: Vector3
    color: Color


class CylinderPrimitive(Record, frozen=True):
    """A cylinder; the scales make it a cone."""

    pose: Pose
    size: Vector3
    bottom_scale: float
    top_scale: float
    color: Color


class ArrowPrimitive(Record, frozen=True):
    """An arrow along its own x axis."""

    pose: Pose
    shaft_length: float
    shaft_diameter: float
    head_length: float
    head_diameter: float
    color: Color


class TextPrimitive(Record, frozen=True):
    """A label; a billboard always faces the camera."""

    pose: Pose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class SceneEntity(Stamped, frozen=True):
    """An object of the scene; it replaces the one with the same id on the same channel."""

    id: str
    lifetime: Time
    frame_locked: bool
    arrows: tuple[ArrowPrimitive, ...] = ()
    cubes: tuple[CubePrimitive, ...] = ()
    cylinders: tuple[CylinderPrimitive, ...] = ()
    lines: tuple[LinePrimitive, ...] = ()
    triangles: tuple[TriangleListPrimitive, ...] = ()
    texts: tuple[TextPrimitive, ...] = ()


class DeletionType(IntEnum):
    """Entities to delete."""

    MATCHING_ID = 0
    ALL = 1


class SceneEntityDeletion(Record, frozen=True):
    """Deletes entities."""

    timestamp: Time
    type: DeletionType
    id: str


class SceneUpdate(Record, frozen=True):
    """Changes of a scene."""

    deletions: tuple[SceneEntityDeletion, ...]
    entities: tuple[SceneEntity, ...]


def schema_name(kind: type[Record]) -> str:
    """Return the name of a type's schema."""
    return PREFIX + kind.__name__


def time_of(nanoseconds: int) -> Time:
    """Return nanoseconds as a time."""
    return Time(*divmod(nanoseconds, 1_000_000_000))


def pose_at(x_m: float, y_m: float, z_m: float = 0.0, yaw_rad: float = 0.0) -> Pose:
    """Return a pose that is rotated about the z axis."""
    return Pose(Vector3(x_m, y_m, z_m), turned(yaw_rad))


def turned(yaw_rad: float) -> Quaternion:
    """Return a counter-clockwise rotation about the z axis."""
    half = yaw_rad / 2 if math.isfinite(yaw_rad) else 0.0
    return Quaternion(0.0, 0.0, math.sin(half), math.cos(half))
