"""Commands that act on a run: inject, adapt, reset, mission, joystick."""
