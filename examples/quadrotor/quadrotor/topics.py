"""Messages and topics of the quadrotor.

Frames: `map` is east, north, up, with its origin at the place of takeoff; `base_link` is forward,
left, up. Quaternions (w, x, y, z) turn from `base_link` to `map`. SI units stand in the names.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from rampart import Message, Qos, Topic

Text = Annotated[str, msgspec.Meta(max_length=200)]
Quaternion = tuple[float, float, float, float]


class Imu(Message, frozen=True):
    """Angular rate and specific force in `base_link`; at rest the force is 9.81 upwards."""

    gyro_x_radps: float
    gyro_y_radps: float
    gyro_z_radps: float
    accel_x_mps2: float
    accel_y_mps2: float
    accel_z_mps2: float


class GpsFix(Message, frozen=True):
    """Position and velocity in `map`; the velocity is measured independently (Doppler)."""

    x_m: float
    y_m: float
    z_m: float
    velocity_x_mps: float
    velocity_y_mps: float
    velocity_z_mps: float


class Barometer(Message, frozen=True):
    """Height above the place of takeoff."""

    altitude_m: float


class Heading(Message, frozen=True):
    """Yaw from the magnetometer, counted from east to north."""

    yaw_rad: float


class Battery(Message, frozen=True):
    """State of the battery; `charge` is a share from 0 to 1."""

    charge: float
    voltage_v: float
    current_a: float


class Estimate(Message, frozen=True):
    """Position, velocity and attitude of the vehicle, in `map`.

    `attitude` turns from `base_link` to `map`; `gps_age_s` is the time since the last fix.
    """

    x_m: float
    y_m: float
    z_m: float
    velocity_x_mps: float
    velocity_y_mps: float
    velocity_z_mps: float
    speed_mps: float
    attitude: Quaternion
    gps_age_s: float


class Goal(Message, frozen=True):
    """Goal in `map`. `fly` is false before takeoff and after landing."""

    fly: bool
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    speed_mps: float
    descent_mps: float


class MissionState(Message, frozen=True):
    """Step of the mission; before `busy_until_s` it cannot advance: the pilot does not follow."""

    step: Text
    busy_until_s: float


class Setpoint(Message, frozen=True):
    """Demanded acceleration in `map`, without gravity, and yaw."""

    fly: bool
    accel_x_mps2: float
    accel_y_mps2: float
    accel_z_mps2: float
    yaw_rad: float


class PilotOrder(Message, frozen=True):
    """The mode that the sender demands of the pilots; the strictest one holds."""

    mode: Text


class PilotStatus(Message, frozen=True):
    """Status of the pilot that the rotors obey.

    Attributes:
        mode: NORMAL, HOVER, RETURN, LAND or LEVEL.
        source: the input that it flies by: setpoint, estimate or own sensors.
        landed: whether it stands on the ground, rotors off.
        tilt_rad: angle between the rotors' axis and the vertical.
        attitude: turns from `base_link` to `map`.
        imus_sound: number of IMUs that agree.
        trim: largest trim of a rotor, as a share of the hover thrust.
        refused: 1 if the last setpoint was refused, else 0.
    """

    mode: Text
    source: Text
    landed: bool
    tilt_rad: float
    attitude: Quaternion
    imus_sound: Annotated[int, msgspec.Meta(ge=0, le=100)]
    trim: float
    refused: float


class RotorCommand(Message, frozen=True):
    """Thrust of each rotor, N: front left, front right, rear left, rear right."""

    thrust_n: tuple[float, float, float, float]


class EscStatus(Message, frozen=True):
    """Status of the rotors' speed controllers.

    Attributes:
        command_age_s: age of the command in force.
        turning: whether the rotors turn.
        obeys: name of the pilot in command.
        thrust_n: the command in force.
    """

    command_age_s: float
    turning: bool
    obeys: Text
    thrust_n: tuple[float, float, float, float]


class Truth(Message, frozen=True):
    """Ground truth in `map`, for judge and tests only.

    Attributes:
        x_m, y_m, z_m: position of the feet.
        speed_mps: magnitude of the velocity.
        tilt_rad: angle between the rotors' axis and the vertical.
        grounded: whether it touches the ground.
        turning: whether its rotors turn.
        touch_speed_mps: largest vertical speed of a touchdown so far.
        touch_tilt_rad: largest tilt of a touchdown so far.
        highest_tilt_rad: largest tilt so far.
    """

    x_m: float
    y_m: float
    z_m: float
    speed_mps: float
    tilt_rad: float
    grounded: bool
    turning: bool
    touch_speed_mps: float
    touch_tilt_rad: float
    highest_tilt_rad: float


class BodyFault(Message, frozen=True):
    """A fault of the vehicle itself.

    Attributes:
        injection: id that reports name.
        kind: "rotor" or "battery".
        rotor: 0 to 3, as in `RotorCommand`.
        factor: remaining share of the rotor's thrust, or factor of the battery's drain.
        duration_s: simulated seconds; may be infinite.
    """

    injection: Annotated[str, msgspec.Meta(max_length=256)]
    kind: Text
    rotor: Annotated[int, msgspec.Meta(ge=0, le=3)]
    factor: Annotated[float, msgspec.Meta(ge=0, le=1000)]
    duration_s: Annotated[float, msgspec.Meta(ge=0)]


IMU_1 = Topic("sensors/imu_1", Imu, Qos.SENSOR, 100.0, "base_link", "The first of three IMUs.")
IMU_2 = Topic("sensors/imu_2", Imu, Qos.SENSOR, 100.0, "base_link", "The second of three IMUs.")
IMU_3 = Topic("sensors/imu_3", Imu, Qos.SENSOR, 100.0, "base_link", "The third of three IMUs.")
IMUS = (IMU_1, IMU_2, IMU_3)
GPS = Topic("sensors/gps", GpsFix, Qos.SENSOR, 10.0, "map", "Position and velocity by satellites.")
BAROMETER = Topic("sensors/barometer", Barometer, Qos.SENSOR, 20.0, "map", "Height by pressure.")
HEADING = Topic("sensors/heading", Heading, Qos.SENSOR, 20.0, "map", "Yaw by the magnetometer.")
BATTERY = Topic("sensors/battery", Battery, Qos.SENSOR, 5.0, "", "The battery under load.")
ESC = Topic("sensors/esc", EscStatus, Qos.SENSOR, 50.0, "", "The rotors' speed controllers.")
TRUTH = Topic("world/truth", Truth, Qos.SENSOR, 20.0, "map", "Ground truth, for the judge.")
BODY_FAULT = Topic("world/fault", BodyFault, Qos.COMMAND, 0.0, "", "Faults of the vehicle.",
                   outside=True)
ESTIMATE = Topic("estimate", Estimate, Qos.SENSOR, 50.0, "map", "Position, velocity, attitude.")
GOAL = Topic("mission/goal", Goal, Qos.STATE, 10.0, "map", "The goal.")
MISSION = Topic("mission/state", MissionState, Qos.STATE, 5.0, "", "Step of the mission.")
SETPOINT = Topic("setpoint", Setpoint, Qos.SENSOR, 50.0, "map", "Demanded acceleration.")
PILOT_ORDER = Topic("pilot/order", PilotOrder, Qos.COMMAND, 0.0, "", "Mode demanded of the pilots.")
PILOT = Topic("pilot/status", PilotStatus, Qos.STATE, 20.0, "map",
              "Status of the pilot that the rotors obey.", several=True)
ROTORS = Topic("rotors/{name}", RotorCommand, Qos.SENSOR, 100.0, "base_link",
               "Thrust of the rotors, by each pilot.")
