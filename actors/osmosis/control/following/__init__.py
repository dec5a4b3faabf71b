"""Osmosis Control: follows a route, inspects lights, passes obstacles."""
