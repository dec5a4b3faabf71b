"""Airports as data: graph, lights, pavement, missions, and their file formats."""
