"""Osmosis, the robot of the paper: a Summit XL that inspects the lights of a runway."""
