"""What the guard and the judge hear and say; all that is of ROS 2 is in warehouse.toml."""

from __future__ import annotations

from rampart import Message, Qos, Topic


class Velocity(Message, frozen=True):
    """Velocity of `base_link` in its own axes, and the stamp of the command that it follows.

    Without a command `command_s` is now. So it never stays the same unless the guard is stuck.
    """

    linear_mps: float
    angular_radps: float
    command_s: float


class Order(Message, frozen=True):
    """What the guard is to do besides: stand still."""

    stop: bool


class GuardState(Message, frozen=True):
    """Whether and why the guard stops the robot, and the speed that it decided on, m/s."""

    stopped: bool
    reason: str
    linear_mps: float


class Truth(Message, frozen=True):
    """What really happens: where the robot is in `map`, and how close to what it may not touch."""

    x_m: float
    y_m: float
    clearance_m: float
    rounds: float


class Skew(Message, frozen=True):
    """By how much the localization is wrong; 0 unless a fault says otherwise."""

    x_m: float


CHECKED = Topic("guard/velocity", Velocity, Qos.SENSOR, 20, "base_link",
                "What the navigation commands, as far as the guard lets it.")
ORDER = Topic("guard/order", Order, Qos.STATE, 5, "", "What a recovery has the guard do.")
STATE = Topic("guard/state", GuardState, Qos.STATE, 5, "", "What the guard does.")
TRUTH = Topic("world/truth", Truth, Qos.STATE, 10, "map", "For the judge alone.")
SKEW = Topic("hall/skew", Skew, Qos.STATE, 10, "map", "For faults of the localization.")
