"""What the nodes say to each other."""

from __future__ import annotations

from rampart import Message, Qos, Topic


class Motion(Message, frozen=True):
    """How it moves, or is to move."""

    speed_mps: float
    turn_radps: float


class Place(Message, frozen=True):
    """Where it is on the floor, and what the map says is the gap to the nearest thing."""

    x_m: float
    y_m: float
    heading_rad: float
    clearance_m: float


class Free(Message, frozen=True):
    """What the laser sees: how far it can go on as it goes, and the gap to the nearest thing."""

    free_m: float
    clearance_m: float


class Goal(Message, frozen=True):
    """Where to go, the number of the step, and whether the hitch is to be closed."""

    step: int
    x_m: float
    y_m: float
    hitched: bool


class Base(Message, frozen=True):
    """What the base does besides driving."""

    braked: bool
    hitched: bool


class Order(Message, frozen=True):
    """To the pilot: stop; to the base: brake."""

    stop: bool


class Status(Message, frozen=True):
    """Whether the pilot has stopped the tug, and why."""

    stopped: bool
    reason: str


class Truth(Message, frozen=True):
    """What is true, for the judge."""

    x_m: float
    y_m: float
    speed_mps: float
    clearance_m: float
    deliveries: int


WHEELS = Topic("tug/wheels", Motion, Qos.SENSOR, 20, "", "Motion by the wheels' encoders.")
MARKER = Topic("tug/marker", Place, Qos.SENSOR, 10, "map", "Place by markers on the ceiling.")
FREE = Topic("tug/free", Free, Qos.SENSOR, 20, "", "What the laser sees.")
BASE = Topic("tug/base", Base, Qos.STATE, 10, "", "State of brake and hitch.")
DRIVE = Topic("tug/drive", Motion, Qos.SENSOR, 20, "", "What the wheels are to do.")
BRAKE = Topic("tug/brake", Order, Qos.COMMAND, 0, "", "Applies the brake, and lifts it.")
POSE = Topic("localization/pose", Place, Qos.SENSOR, 10, "map", "Where it is.")
GOAL = Topic("mission/goal", Goal, Qos.STATE, 10, "map", "Where it is to go.")
MOTION = Topic("controller/motion", Motion, Qos.SENSOR, 10, "", "How it is to move.")
ORDER = Topic("pilot/order", Order, Qos.COMMAND, 0, "", "Has the pilot stop the tug.")
STATUS = Topic("pilot/status", Status, Qos.STATE, 10, "", "What the pilot does.")
TRUTH = Topic("world/truth", Truth, Qos.SENSOR, 20, "map", "What is true.")
