"""Topics of guard and judge; those of ROS 2 are in warehouse.toml."""

from __future__ import annotations

from rampart import Message, Qos, Topic


class Velocity(Message, frozen=True):
    """Velocity of `base_link` in its own axes, and the stamp of the command that it follows.

    Without a command `command_s` is the present time, so it changes unless the guard is stuck.
    """

    linear_mps: float
    angular_radps: float
    command_s: float


class Order(Message, frozen=True):
    """Order to the guard to stop the robot."""

    stop: bool


class Limit(Message, frozen=True):
    """Order to the guard to pass at most its slow speed."""

    slow: bool


class GuardState(Message, frozen=True):
    """What the guard passes, and why not more.

    Attributes:
        stopped: whether it refuses speed.
        standing: whether it passes no speed without an order, although there is a goal.
        slow: whether it passes at most its slow speed.
        reason: why it is stopped, "" if it is not.
        linear_mps, angular_radps: the velocity that it passes.
    """

    stopped: bool
    standing: bool
    slow: bool
    reason: str
    linear_mps: float
    angular_radps: float


class Truth(Message, frozen=True):
    """Ground truth: position in `map`, clearance, and rounds made."""

    x_m: float
    y_m: float
    clearance_m: float
    rounds: float


class Skew(Message, frozen=True):
    """Error of the localization, 0 without a fault."""

    x_m: float


class Trouble(Message, frozen=True):
    """Which errors the nodes of the navigation report; none without a fault."""

    late_control: bool
    no_way: bool
    aborted: bool


CHECKED = Topic("guard/velocity", Velocity, Qos.SENSOR, 20, "base_link",
                "The navigation's command within the guard's limits.")
ORDER = Topic("guard/order", Order, Qos.STATE, 5, "", "Orders of a recovery to the guard.")
LIMIT = Topic("guard/limit", Limit, Qos.STATE, 5, "", "Orders of a recovery to drive slowly.")
STATE = Topic("guard/state", GuardState, Qos.STATE, 5, "", "State of the guard.")
TRUTH = Topic("world/truth", Truth, Qos.STATE, 10, "map", "Ground truth, for the judge only.")
SKEW = Topic("hall/skew", Skew, Qos.STATE, 10, "map", "For faults of the localization.")
TROUBLE = Topic("hall/trouble", Trouble, Qos.STATE, 10, "", "For faults that nodes report.")
