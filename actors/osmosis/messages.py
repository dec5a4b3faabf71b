"""The messages of Osmosis: SI units, REP-103 axes, REP-105 frames.

The bus adds the header to these structs (`rampart.actors.bus.envelope`). Angles: (-pi, pi], x
forward, y left, yaw counter-clockwise. A field named `*_f32` is a little-endian float32 array.

Each field but a measurement or a command is bounded by its type (`rampart.actors.bus.bounds`): a
payload beyond the bounds never reaches an actor. A plain `float` may have any value, NaN and
infinity included; its reader checks it.
"""

from __future__ import annotations

from enum import StrEnum

from rampart.actors.bus.bounds import (
    Count,
    Duration,
    Explained,
    Few,
    Floats32,
    Lasting,
    Many,
    Most,
    Name,
    Names,
    Seconds,
    Text,
)
from rampart.actors.bus.messages import Message

# ---- robot: the Summit XL layer --------------------------------------------------------------


class Pose(Message, frozen=True):
    """Planar pose of `base_link`."""

    x_m: float
    y_m: float
    yaw_rad: float


class Twist(Message, frozen=True):
    """Planar velocity of `base_link` in its own axes."""

    linear_mps: float
    angular_radps: float


class StickTwist(Twist, frozen=True):
    """Velocity of the operator's joystick, and since when its dead man is held.

    `held_since_s` is in simulated seconds. A joystick that was held before a stop ended drives only
    after it was released.
    """

    held_since_s: float = 0.0


class Odometry(Message, frozen=True):
    """Wheel odometry: pose in `odom` (starts at the origin), velocity in `base_link`."""

    pose: Pose
    twist: Twist


class Imu(Message, frozen=True):
    """Inertial measurement in `base_link`; `yaw_rad` is the integrated heading."""

    yaw_rad: float
    yaw_rate_radps: float
    accel_x_mps2: float
    accel_y_mps2: float


class GpsFix(Message, frozen=True):
    """RTK-GPS position in `map` (local east-north), with velocity over ground in `map`."""

    x_m: float
    y_m: float
    velocity_x_mps: float
    velocity_y_mps: float
    accuracy_m: float


class LaserScan(Message, frozen=True):
    """A sweep of the 2D laser in `base_link`; a range of `range_max_m` means no echo.

    `reference_m` is the range to the target in the laser's housing, measured once a sweep, for
    `rampart.actors.osmosis.control.pilot.laser_pair`; exactly -1 for a device without a target.
    """

    angle_min_rad: float
    angle_increment_rad: float
    range_max_m: float
    ranges_f32: Floats32
    reference_m: float = -1.0


class LightSample(Message, frozen=True):
    """Illuminance at the light sensor, which faces the ground ahead of the robot."""

    illuminance_lux: float


class BaseCommand(Twist, frozen=True):
    """Velocity for the base. Without fresh commands the base stops (dead man)."""


class BrakeCommand(Message, frozen=True):
    """Low-level brake: blocks the wheels until its last holder releases it."""

    engaged: bool
    reason: Text


class BaseStatus(Message, frozen=True):
    """State of the Summit XL layer. Wheels: front left, front right, rear left, rear right."""

    brake_engaged: bool
    dead_man_tripped: bool
    command_age_s: float
    wheel_speeds_radps: tuple[float, float, float, float]


# ---- mission and control ---------------------------------------------------------------------


class Mode(StrEnum):
    """How a goal is reached (paper, section III)."""

    TAXI = "taxi"
    LIGHT_VERIFICATION = "light verification"


class Goal(Message, frozen=True):
    """A point of a mission, in `map`, and its mode."""

    x_m: float
    y_m: float
    mode: Mode


class MissionRequest(Message, frozen=True):
    """A mission for the Mission Manager. A repeated `mission_id` is the same mission."""

    mission_id: Name
    name: Name
    goals: Many[Goal]


class MissionPhase(StrEnum):
    """State of a mission."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSED = "paused"
    RETURNING = "returning home"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class LightVerdict(StrEnum):
    """Verdict on a light: below half its nominal intensity it is dim (ICAO Annex 14, 10.4)."""

    OK = "ok"
    DIM = "dim"
    OUT = "out"


class LightMeasurement(Message, frozen=True):
    """Measurement of a light in passing."""

    light: Name
    intensity_cd: float
    ratio: float
    verdict: LightVerdict


class MissionAction(StrEnum):
    """Orders to a mission under way."""

    PAUSE = "pause"
    RESUME = "resume"
    REPLAN = "replan"
    SKIP = "skip"
    CANCEL = "cancel"
    HOME = "home"


class MissionOrder(Message, frozen=True):
    """An order to the Mission Manager with sender and reason; a repeated `order` counts once."""

    order: Name
    action: MissionAction
    reason: Text
    by: Name


class MissionOrderAnswer(Message, frozen=True):
    """Whether an order was accepted, and why not; `plan` is the number of the resulting plan."""

    order: Name
    accepted: bool
    reason: Text
    plan: Count = 0


class MissionStatus(Message, frozen=True):
    """Progress of the mission: `step`, the index of the current goal, and the measured lights.

    `skipped`: indices of goals skipped by order; `unmeasured`: lights passed without a measurement;
    `orders`: those that would be accepted now.
    """

    mission_id: Name
    name: Name
    phase: MissionPhase
    step: Count
    goals: Many[Goal]
    step_times_s: Many[Seconds]
    lights: Most[LightMeasurement]
    reason: Text
    skipped: Many[Count] = ()
    unmeasured: Most[Name] = ()
    orders: Few[MissionAction] = ()


class OfStep(Message, frozen=True):
    """Base of messages that belong to a step of a mission."""

    mission_id: Name
    step: Count

    @property
    def which(self) -> tuple[str, int]:
        """Mission and step."""
        return self.mission_id, self.step


class GoalOrder(OfStep, frozen=True):
    """The Mission Manager's current goal for the Graph Planner; `active` False: no goal.

    On the way home `step` is the number of goals. `plan` grows with each order to replan.
    """

    goal: Goal
    active: bool
    plan: Count = 0


class Route(OfStep, frozen=True):
    """Route to a goal: waypoints in `map` from the start; empty with a `reason` if there is none.

    `plan` is that of its goal. A detour has a `reason` too.
    """

    mode: Mode
    active: bool
    waypoints: Most[tuple[float, float]]
    reason: Text
    plan: Count = 0


class ControlPhase(StrEnum):
    """State of Osmosis Control."""

    IDLE = "idle"
    FOLLOWING = "following"
    WAITING = "waiting"
    ARRIVED = "arrived"
    REFUSED = "refused"


class Blockage(Message, frozen=True):
    """A blockage of the route: its place in `map`, and since when."""

    x_m: float
    y_m: float
    since_s: Seconds


class ControlStatus(OfStep, frozen=True):
    """Progress along the route of (mission, step).

    `blocked`: at most one blockage, in front of the robot now; `reason`: why a route was refused;
    `unmeasured`: on arrival, lights passed without a measurement.

    Intent for the standby: `back_to`, the point in `map` to which the robot goes back, if any;
    `passing`: it passes an obstacle beside a row; `aside_m`: intended offset to the left of the
    route; `turn_added_radps`: correction of the yaw loop.
    """

    phase: ControlPhase
    waypoint: Count
    distance_to_go_m: float
    blocked: Many[Blockage] = ()
    reason: Text = ""
    unmeasured: Most[Name] = ()
    back_to: Most[tuple[float, float]] = ()
    passing: bool = False
    aside_m: float = 0.0
    turn_added_radps: float = 0.0


class LocalizationStatus(Message, frozen=True):
    """Sources of the pose: those in use, and those excluded with the reason.

    Standard deviations are infinite before the first pose. `bridged_m` is the distance driven since
    two independent sources last agreed on the position.
    """

    in_use: Names
    excluded: Explained
    position_sd_m: float
    heading_sd_rad: float
    bridged_m: float


class Joystick(Message, frozen=True):
    """Joystick positions in [-1, 1] and the dead-man button."""

    forward: float
    left: float
    dead_man: bool


class WayOutRequest(Message, frozen=True):
    """Request to drive a robot out of a prohibited area, once; a repeated `order` counts once."""

    order: Name
    by: Name
    reason: Text


class WayOutAnswer(Message, frozen=True):
    """Whether the way out is granted, and why not; later why it has ended.

    `is_out`: it ended because the robot is far enough from the area to be released.
    """

    order: Name
    granted: bool
    reason: Text
    is_out: bool = False


class PilotMode(StrEnum):
    """Source of the commands that the Safety Pilot passes."""

    AUTO = "auto"
    STOP = "stop"
    TELEOPERATION = "teleoperation"


class Way(StrEnum):
    """Allowed directions; turning is always allowed."""

    ANY = "any"
    FORWARDS = "forwards"
    BACKWARDS = "backwards"
    NEITHER = "neither"


class PilotOrder(Message, frozen=True):
    """A recovery module's order to the Safety Pilot, which applies while `engaged`.

    `top_speed_mps` limits the speed; 0: only the robot's limit applies. An order with another `way`
    than any becomes an order to stop if it is not renewed.
    """

    engaged: bool
    mode: PilotMode
    reason: Text
    top_speed_mps: float = 0.0
    way: Way = Way.ANY


class PilotStatus(Message, frozen=True):
    """State of the Safety Pilot: `reason` is empty while commands pass unchanged.

    `top_speed_mps`: lowest ordered limit, or 0; `forbids`: why not even the joystick may drive.
    """

    mode: PilotMode
    stopped: bool
    reason: Text
    refused_commands: Count
    top_speed_mps: float = 0.0
    forbids: Text = ""


# ---- world: for the judge and the tests, never for the controller ----------------------------


class GroundTruth(Message, frozen=True):
    """Ground truth. Counters are cumulative, so that a lost sample loses no event."""

    pose: Pose
    twist: Twist
    collisions: Count
    prohibited_s: Duration
    obstacle_clearance_m: float
    prohibited_clearance_m: float
    real_time_factor: float


class ObstacleCommand(Message, frozen=True):
    """Adds a named obstacle at (x, y) in `map`, or removes it."""

    name: Name
    present: bool
    x_m: float
    y_m: float
    radius_m: float


class ActuatorFaultKind(StrEnum):
    """Failures of the base's actuators."""

    STUCK_WHEEL = "stuck wheel"
    WEAK_WHEEL = "weak wheel"
    BRAKE_FAILURE = "brake failure"


class ActuatorFault(Message, frozen=True):
    """Starts a fault of the base's actuators; a duration of 0 ends it.

    `wheel`: front left, front right, rear left or rear right; a brake failure ignores it.
    `strength` from 0 to 1 (no loss): remaining share of a weak wheel's torque and speed, or with a
    brake failure of the braking torque, without locking; a stuck wheel ignores it.
    `InjectionReport.affected` counts the 10 ms ticks in which the fault had an effect.
    """

    injection: Name
    kind: ActuatorFaultKind
    wheel: Name
    strength: float
    duration_s: Lasting


class ObstacleList(Message, frozen=True):
    """The present obstacles, for the map on the operator's page."""

    obstacles: Many[ObstacleCommand]
