"""Osmosis Control: follows a route, inspects lights, drives round obstacles."""
