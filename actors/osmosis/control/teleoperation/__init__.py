"""Driving by hand: joysticks, gamepads, and whose stick counts."""
