"""Teleoperation by joystick."""
