"""A tank with a level, a pump and a valve: topics for tests of modules that know no robot."""

from enum import StrEnum
from typing import Annotated

import msgspec

from rampart import Message, Qos, Topic


class Phase(StrEnum):
    """What the pump does."""

    IDLE = "idle"
    FILLING = "filling"
    DRAINING = "draining"


class Level(Message):
    """How full the tank is."""

    height_m: float
    cells: tuple[float, ...] = ()
    heading_rad: float = 0.0


class Pump(Message):
    """What the pump does, and until when it is busy with it."""

    phase: Phase
    busy_until_s: float = 0.0
    running: bool = True


class Valve(Message):
    """An order to the valve, or its state."""

    shut: bool
    opening: float = 1.0


class Hand(Message):
    """Where the operator's stick is."""

    forward: Annotated[float, msgspec.Meta(ge=-0.5, le=2.0)]
    left: float = 0.0
    held: bool = False


LEVEL = Topic("tank/level", Level, Qos.SENSOR, 10.0, "", "How full the tank is.")
SECOND = Topic("tank/second", Level, Qos.SENSOR, 10.0, "", "The same by another gauge.")
THIRD = Topic("tank/third", Level, Qos.SENSOR, 10.0, "", "The same by a third gauge.")
PUMP = Topic("tank/pump", Pump, Qos.STATE, 5.0, "", "What the pump does.")
ORDER = Topic("tank/order", Valve, Qos.COMMAND, 0.0, "", "Orders to the valve.")
VALVE = Topic("tank/valve", Valve, Qos.STATE, 5.0, "", "The state of the valve.")
GAUGE = Topic("tank/gauge/{name}", Level, Qos.SENSOR, 10.0, "", "The level by one of many gauges.")
HAND = Topic("tank/hand", Hand, Qos.SENSOR, 20.0, "", "The operator's stick.")
TOPICS = (LEVEL, SECOND, THIRD, PUMP, ORDER, VALVE, GAUGE, HAND)
