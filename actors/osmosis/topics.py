"""The topics of Osmosis."""

from __future__ import annotations

from typing import Any

from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ftm import topics as engine
from rampart.actors.osmosis import messages as m

# Summit XL layer: the simulator, or the driver of a real robot.
ABSOLUTE_POSE = Topic("summit_xl/absolute_pose", m.Pose, Qos.SENSOR, 20, "map",
                      "Absolute pose from the simulator, as in the paper.",
                      outside=True)
ODOMETRY = Topic("summit_xl/odom", m.Odometry, Qos.SENSOR, 50, "odom", "Wheel odometry.",
                 outside=True)
IMU = Topic("summit_xl/imu", m.Imu, Qos.SENSOR, 50, "base_link", "Inertial measurement unit.",
            outside=True)
GPS = Topic("summit_xl/gps", m.GpsFix, Qos.SENSOR, 10, "map", "RTK-GPS receiver.", outside=True)
SCAN = Topic("summit_xl/scan", m.LaserScan, Qos.SENSOR, 20, "base_link", "2D laser scanner.",
             outside=True)
UPPER_SCAN = Topic("summit_xl/upper_scan", m.LaserScan, Qos.SENSOR, 20, "base_link",
                   "A second laser scanner above the first, if the robot has one.", outside=True)
LIGHT = Topic("summit_xl/light", m.LightSample, Qos.SENSOR, 20, "base_link", "Light sensor.",
              outside=True)
BASE_STATUS = Topic("summit_xl/status", m.BaseStatus, Qos.STATE, 10, "base_link",
                    "Brake, dead man and wheel speeds.", outside=True)
BASE_COMMAND = Topic("summit_xl/command", m.BaseCommand, Qos.SENSOR, 20, "base_link",
                     "Velocity command; the base brakes if it is missing.")
BRAKE = Topic("summit_xl/brake", m.BrakeCommand, Qos.COMMAND, 5, "base_link",
              "Low-level brake, repeated while engaged. Each source releases only its own hold: "
              "the base brakes while any source holds it.")

# Control chain.
MISSION_REQUEST = Topic("mission/request", m.MissionRequest, Qos.COMMAND, 0, "map",
                        "A mission from the operator.")
MISSION_ORDER = Topic("mission/order", m.MissionOrder, Qos.COMMAND, 0, "",
                      "Pause, resume, replan, skip, cancel or return home.", outside=True)
MISSION_ORDER_ANSWER = Topic("mission/order_answer", m.MissionOrderAnswer, Qos.COMMAND, 0, "",
                             "Whether an order was accepted, and why not.")
MISSION_STATUS = Topic("mission/status", m.MissionStatus, Qos.STATE, 2, "map",
                       "Progress and results of the mission.", resend_s=1)
GOAL = Topic("mission/goal", m.GoalOrder, Qos.STATE, 5, "map", "The current goal.", resend_s=1)
ROUTE = Topic("plan/route", m.Route, Qos.STATE, 5, "map", "The route to the current goal.",
              resend_s=1)
COMMAND = Topic("control/command", m.Twist, Qos.SENSOR, 20, "base_link",
                "Velocity command of Osmosis Control.")
STANDBY_COMMAND = Topic("control/standby_command", m.Twist, Qos.SENSOR, 20, "base_link",
                        "The same, of the hot standby in another process.")
CONTROL_STATUS = Topic("control/status", m.ControlStatus, Qos.STATE, 5, "",
                       "Progress along the route.")
LIGHT_MEASURED = Topic("inspection/light", m.LightMeasurement, Qos.COMMAND, 0, "",
                       "Measurement of a light in passing.")
POSE = Topic("localization/pose", m.Pose, Qos.SENSOR, 20, "map", "The robot's pose.")
LOCALIZATION_STATUS = Topic("localization/status", m.LocalizationStatus, Qos.STATE, 5, "map",
                            "Sources of the pose and its uncertainty.")
JOYSTICK = Topic("teleoperation/joystick", m.Joystick, Qos.SENSOR, 20, "",
                 "The operator's joystick.", outside=True)
TELEOP_COMMAND = Topic("teleoperation/command", m.StickTwist, Qos.SENSOR, 20, "base_link",
                       "Velocity from the joystick; silent while the dead man is released.")

# Safety Pilot.
PILOT_ORDER = Topic("pilot/order/{name}", m.PilotOrder, Qos.STATE, 5, "",
                    "Order of the recovery module {name} to the Safety Pilot.")
PILOT_STATUS = Topic("pilot/status", m.PilotStatus, Qos.STATE, 5, "",
                     "State of the Safety Pilot, and why.", resend_s=1)

WAY_OUT = Topic("way_out/request", m.WayOutRequest, Qos.COMMAND, 0, "",
                "Request to drive the robot out of a prohibited area during an emergency stop.",
                outside=True)
WAY_OUT_ANSWER = Topic("way_out/answer", m.WayOutAnswer, Qos.COMMAND, 0, "",
                       "Whether the way out is granted, and later why it has ended.")

# World: ground truth is for the judge, never for the controller.
TRUTH = Topic("world/truth", m.GroundTruth, Qos.STATE, 20, "map", "Ground truth.")
OBSTACLE = Topic("world/obstacle", m.ObstacleCommand, Qos.COMMAND, 0, "map",
                 "Add an obstacle to the world or remove it.", outside=True)
ACTUATOR_FAULT = Topic("world/actuator_fault", m.ActuatorFault, Qos.COMMAND, 0, "",
                       "Start a fault of the base's actuators or end it.", outside=True)
OBSTACLES = Topic("world/obstacles", m.ObstacleList, Qos.STATE, 1, "map",
                  "Present obstacles, for maps.")

ROBOT: tuple[Topic[Any], ...] = tuple(v for v in globals().values() if isinstance(v, Topic))

ALL: tuple[Topic[Any], ...] = (*engine.ALL, *ROBOT)
"""The topics of the engine and of Osmosis."""
