"""Airports as data: graph, lights, pavement, missions, and the formats they come in."""
