"""The messages of Osmosis: SI units, REP-103 axes, REP-105 frames.

The bus puts the header round these structs (`rampart.actors.bus.envelope`). Angles: (-pi, pi], x
forward, y left, yaw counter-clockwise. A field named `*_f32` is a little-endian float32 array.

Every field but a measurement or a command is bounded by its type (`rampart.actors.bus.bounds`): a
payload beyond the bounds never reaches an actor. A plain `float` may be anything, NaN and infinity
included; its reader judges it.
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

# ---- robot: what a Summit XL driver publishes and takes --------------------------------------


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
    """Velocity that the operator's stick asks for, and when the stick was taken in hand.

    `held_since_s` is in simulated seconds. A stick that was held before a stop ended drives only
    after its operator has let go of it.
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
    """One sweep of the 2D laser in `base_link`; a range of `range_max_m` means no echo.

    `reference_m` is the range to the target in the laser's housing, measured once a sweep, for
    `rampart.actors.osmosis.control.pilot.laser_pair`; exactly -1 for a device without one.
    """

    angle_min_rad: float
    angle_increment_rad: float
    range_max_m: float
    ranges_f32: Floats32
    reference_m: float = -1.0


class LightSample(Message, frozen=True):
    """Illuminance at the light sensor, which looks down at the ground ahead of the robot."""

    illuminance_lux: float


class BaseCommand(Twist, frozen=True):
    """Velocity for the base. The base stops by itself when these cease (dead man)."""


class BrakeCommand(Message, frozen=True):
    """Low-level brake: blocks the wheels, whatever is commanded, until its last holder lets go."""

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
    """One point of a mission, in `map`, and the mode in which to reach it."""

    x_m: float
    y_m: float
    mode: Mode


class MissionRequest(Message, frozen=True):
    """A mission for the Mission Manager. The same `mission_id` twice is one mission."""

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
    """Judgement on a light: below half its nominal intensity it is dim (ICAO Annex 14, 10.4)."""

    OK = "ok"
    DIM = "dim"
    OUT = "out"


class LightMeasurement(Message, frozen=True):
    """One light measured in passing."""

    light: Name
    intensity_cd: float
    ratio: float
    verdict: LightVerdict


class MissionAction(StrEnum):
    """What can be asked of a mission under way."""

    PAUSE = "pause"
    RESUME = "resume"
    REPLAN = "replan"
    SKIP = "skip"
    CANCEL = "cancel"
    HOME = "home"


class MissionOrder(Message, frozen=True):
    """An order to the Mission Manager, `by` whom and why; the same `order` twice is one order."""

    order: Name
    action: MissionAction
    reason: Text
    by: Name


class MissionOrderAnswer(Message, frozen=True):
    """Whether an order was obeyed, and why not; `plan` is the number of the plan it led to."""

    order: Name
    accepted: bool
    reason: Text
    plan: Count = 0


class MissionStatus(Message, frozen=True):
    """Where the mission is. `step` is the index of the current goal; lights measured so far.

    `skipped` holds the indices of goals left out on request, `unmeasured` the lights that the robot
    passed and could not measure, `orders` those that would be obeyed now.
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
    """What belongs to one step of a mission."""

    mission_id: Name
    step: Count

    @property
    def which(self) -> tuple[str, int]:
        """The mission, and the step of it."""
        return self.mission_id, self.step


class GoalOrder(OfStep, frozen=True):
    """The Mission Manager's current goal for the Graph Planner; `active` False means none.

    On the way home `step` is the number of goals. `plan` grows with each request for another plan.
    """

    goal: Goal
    active: bool
    plan: Count = 0


class Route(OfStep, frozen=True):
    """Way to a goal: waypoints in `map`, first is the start; empty with a `reason` if none.

    `plan` is that of the goal it was made for. The reason of a way round something says so.
    """

    mode: Mode
    active: bool
    waypoints: Most[tuple[float, float]]
    reason: Text
    plan: Count = 0


class ControlPhase(StrEnum):
    """What Osmosis Control is doing with its route."""

    IDLE = "idle"
    FOLLOWING = "following"
    WAITING = "waiting"
    ARRIVED = "arrived"
    REFUSED = "refused"


class Blockage(Message, frozen=True):
    """Something on the route that the robot does not get past: where in `map`, and since when."""

    x_m: float
    y_m: float
    since_s: Seconds


class ControlStatus(OfStep, frozen=True):
    """Progress along the route of (mission, step).

    `blocked` holds at most one blockage, the one in front of the robot now. `reason` says why a
    route was refused. `unmeasured` names, on arrival, lights that were passed unmeasured.

    For a standby to do the same: `back_to`, the point in `map` to which the robot goes back, if it
    does; whether it is `passing` something beside the row; how far to the left of the route it
    means to be; what its yaw loop has learnt.
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
    """What the pose rests on: sources in use, and those that are not, each with the reason.

    Standard deviations are infinite before there is a pose. `bridged_m` is the way made since two
    independent sources last agreed on the position.
    """

    in_use: Names
    excluded: Explained
    position_sd_m: float
    heading_sd_rad: float
    bridged_m: float


class Joystick(Message, frozen=True):
    """Stick positions in [-1, 1] and the dead-man button."""

    forward: float
    left: float
    dead_man: bool


class WayOutRequest(Message, frozen=True):
    """An operator's word that a robot inside a prohibited area may be driven out, once.

    The same `order` twice is one request.
    """

    order: Name
    by: Name
    reason: Text


class WayOutAnswer(Message, frozen=True):
    """Whether the way out is granted, and why not; or, after it was, why it has ended.

    `is_out`: it has ended because the robot is far enough from the area to be released.
    """

    order: Name
    granted: bool
    reason: Text
    is_out: bool = False


class PilotMode(StrEnum):
    """Whose commands the Safety Pilot passes on."""

    AUTO = "auto"
    STOP = "stop"
    TELEOPERATION = "teleoperation"


class Way(StrEnum):
    """In which directions the robot may drive; whatever it is, it may turn."""

    ANY = "any"
    FORWARDS = "forwards"
    BACKWARDS = "backwards"
    NEITHER = "neither"


class PilotOrder(Message, frozen=True):
    """A recovery module's order to the Safety Pilot, in force while `engaged`.

    `top_speed_mps` bounds the speed of what passes; 0 leaves the bound of the robot. An order whose
    `way` is not any is one to stop if it is not renewed.
    """

    engaged: bool
    mode: PilotMode
    reason: Text
    top_speed_mps: float = 0.0
    way: Way = Way.ANY


class PilotStatus(Message, frozen=True):
    """What the Safety Pilot does and why: `reason` is empty while commands pass unchanged.

    `top_speed_mps` is the lowest bound ordered, or 0; `forbids`: why not even the joystick drives.
    """

    mode: PilotMode
    stopped: bool
    reason: Text
    refused_commands: Count
    top_speed_mps: float = 0.0
    forbids: Text = ""
# ---- world: for the judge and the tests, never for the controller ----------------------------


class GroundTruth(Message, frozen=True):
    """What really happens. Counters are cumulative, so a lost sample loses nothing."""

    pose: Pose
    twist: Twist
    collisions: Count
    prohibited_s: Duration
    obstacle_clearance_m: float
    prohibited_clearance_m: float
    real_time_factor: float


class ObstacleCommand(Message, frozen=True):
    """Makes a named obstacle of the airport appear at (x, y) in `map`, or go away."""

    name: Name
    present: bool
    x_m: float
    y_m: float
    radius_m: float


class ActuatorFaultKind(StrEnum):
    """What can fail about the base's actuators."""

    STUCK_WHEEL = "stuck wheel"
    WEAK_WHEEL = "weak wheel"
    BRAKE_FAILURE = "brake failure"


class ActuatorFault(Message, frozen=True):
    """Puts a fault of the base's actuators in force; 0 simulated seconds end it.

    `wheel`: front left, front right, rear left or rear right; a brake failure ignores it.
    `strength` from 0 to 1, where 1 loses nothing: what is left of a weak wheel's torque and speed,
    or with a brake failure of the braking torque, with wheels that do not lock; a stuck wheel
    ignores it. `InjectionReport.affected` counts the 10 ms ticks in which something changed.
    """

    injection: Name
    kind: ActuatorFaultKind
    wheel: Name
    strength: float
    duration_s: Lasting


class ObstacleList(Message, frozen=True):
    """The obstacles that are there now, for the map on the operator's page."""

    obstacles: Many[ObstacleCommand]
