"""Messages and topics of the tug."""

from __future__ import annotations

from rampart import Message, Qos, Topic


class Motion(Message, frozen=True):
    """Actual or demanded motion."""

    speed_mps: float
    turn_radps: float


class Place(Message, frozen=True):
    """Pose on the floor, and by the map the gap to the nearest obstacle."""

    x_m: float
    y_m: float
    heading_rad: float
    clearance_m: float


class Free(Message, frozen=True):
    """Laser: free way in the direction of motion, and gap to the nearest obstacle."""

    free_m: float
    clearance_m: float


class Goal(Message, frozen=True):
    """Number of the step, its place, and whether the hitch is closed there."""

    step: int
    x_m: float
    y_m: float
    hitched: bool


class Base(Message, frozen=True):
    """State of brake and hitch."""

    braked: bool
    hitched: bool


class Order(Message, frozen=True):
    """Order to the pilot to stop, or to the base to brake."""

    stop: bool


class Status(Message, frozen=True):
    """Whether the pilot has stopped the tug, and why."""

    stopped: bool
    reason: str


class Truth(Message, frozen=True):
    """Ground truth, for the judge."""

    x_m: float
    y_m: float
    speed_mps: float
    clearance_m: float
    deliveries: int


WHEELS = Topic("tug/wheels", Motion, Qos.SENSOR, 20, "", "Motion by the wheels' encoders.")
MARKER = Topic("tug/marker", Place, Qos.SENSOR, 10, "map", "Place by markers on the ceiling.")
FREE = Topic("tug/free", Free, Qos.SENSOR, 20, "", "Free way, by the laser.")
BASE = Topic("tug/base", Base, Qos.STATE, 10, "", "State of brake and hitch.")
DRIVE = Topic("tug/drive", Motion, Qos.SENSOR, 20, "", "Motion commanded to the wheels.")
BRAKE = Topic("tug/brake", Order, Qos.COMMAND, 0, "", "Applies the brake, and lifts it.")
POSE = Topic("localization/pose", Place, Qos.SENSOR, 10, "map", "Pose of the tug.")
GOAL = Topic("mission/goal", Goal, Qos.STATE, 10, "map", "Goal of the tug.")
MOTION = Topic("controller/motion", Motion, Qos.SENSOR, 10, "", "Demanded motion.")
ORDER = Topic("pilot/order", Order, Qos.COMMAND, 0, "", "Orders the pilot to stop the tug.")
STATUS = Topic("pilot/status", Status, Qos.STATE, 10, "", "Status of the pilot.")
TRUTH = Topic("world/truth", Truth, Qos.SENSOR, 20, "map", "Ground truth.")
