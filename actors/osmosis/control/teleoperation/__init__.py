"""Teleoperation by joystick or gamepad."""
