"""Checks of an airport at load."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from rampart.actors.osmosis.airport.errors import Problem
from rampart.actors.osmosis.airport.model import GRAPH_REACH_M, Airport, Mission, repeated

MIN_EDGE_CLEARANCE_M = 0.5
"""Least distance of an edge to the prohibited area: half the robot's width, and a margin."""


def problems(airport: Airport) -> Iterator[Problem]:
    """Yield all problems; if the graph is broken, only its own, since later checks rely on it."""
    fundamental = list(_graph(airport))
    yield from fundamental
    if any(not found.tolerable for found in fundamental):
        return
    yield from _ground(airport)
    yield from _lights(airport)
    yield from _obstacles(airport)
    for mission in airport.missions.values():
        yield from mission_problems(mission, airport)


def _graph(airport: Airport) -> Iterator[Problem]:
    if not airport.nodes:
        yield Problem("nodes", "empty", "a graph needs at least one node")
    for i, (a, b) in enumerate(airport.edges):
        for name in (a, b):
            if name not in airport.nodes:
                yield Problem(f"edges[{i}]", repr(name), "unknown node; expected one of nodes")
        if a == b:
            yield Problem(f"edges[{i}]", f"{a!r} to {b!r}", "expected two different nodes")
    for pair in repeated(frozenset(edge) for edge in airport.edges if edge[0] != edge[1]):
        yield Problem("edges", " to ".join(sorted(pair)), "duplicate edge",
                      tolerable=True)


def _ground(airport: Airport) -> Iterator[Problem]:
    if airport.allowed.is_empty:
        yield Problem("surface", "empty", "the airport needs pavement to drive on")
        return
    start = airport.start
    if airport.prohibited_distance_m(start.x_m, start.y_m) <= 0:
        yield Problem("start", f"({start.x_m:g}, {start.y_m:g})",
                      "in the prohibited area; expected on the pavement", tolerable=True)
    off_m = airport.nearest_on_graph(start.x_m, start.y_m).distance_m
    if off_m > GRAPH_REACH_M:
        yield Problem("start", f"({start.x_m:g}, {start.y_m:g})",
                      f"{off_m:.1f} m from the graph; must be within {GRAPH_REACH_M:g} m")
    off = _off_pavement(airport, list(airport.nodes.values()))
    inside = [name for name, is_off in zip(airport.nodes, off, strict=True) if is_off]
    for name in inside:
        x_m, y_m = airport.nodes[name]
        yield Problem(f"nodes.{name}", f"({x_m:g}, {y_m:g})",
                      "in the prohibited area; expected on the pavement", tolerable=True)
    yield from _edges(airport, set(inside))


def _edges(airport: Airport, inside: set[str]) -> Iterator[Problem]:
    """Yield edges over or near the prohibited area, except those of the nodes `inside` it."""
    edges = [(i, *edge) for i, edge in enumerate(airport.edges) if not inside & {*edge}]
    lines = shapely.linestrings(
        np.reshape([(airport.nodes[a], airport.nodes[b]) for _, a, b in edges], (-1, 2, 2)))
    paved = shapely.covers(airport.allowed, lines)
    rings = shapely.get_rings(shapely.get_parts(airport.allowed))
    corners = [shapely.get_coordinates(ring) for ring in rings]
    sides = shapely.linestrings(np.concatenate(
        [np.stack([ring[:-1], ring[1:]], axis=1) for ring in corners]))
    _, clear_m = shapely.STRtree(sides).query_nearest(
        lines, all_matches=False, return_distance=True)
    for (i, a, b), is_paved, distance_m in zip(edges, paved, clear_m, strict=True):
        if not is_paved:
            yield Problem(f"edges[{i}]", f"{a} to {b}", "passes through the prohibited area; "
                          "expected pavement", tolerable=True)
        elif distance_m < MIN_EDGE_CLEARANCE_M:
            yield Problem(f"edges[{i}]", f"{a} to {b}", "too near to the prohibited area; expected "
                          f"at least {MIN_EDGE_CLEARANCE_M:g} m", tolerable=True)


def _off_pavement(airport: Airport, points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each point whether it lies in the prohibited area or on its boundary."""
    x_m, y_m = np.reshape(points, (-1, 2)).T
    return [not paved for paved in shapely.contains_xy(airport.allowed, x_m, y_m).tolist()]


def _lights(airport: Airport) -> Iterator[Problem]:
    for name in repeated(light.name for light in airport.lights):
        yield Problem("row", repr(name), "duplicate name of a light")
    off = _off_pavement(airport, [(light.x_m, light.y_m) for light in airport.lights])
    for light, is_off in zip(airport.lights, off, strict=True):
        if not light.nominal_cd > 0:
            yield Problem(f"row.{light.name}.nominal_cd", f"{light.nominal_cd:g}",
                          "must be positive")
        if is_off:
            yield Problem(f"row.{light.name}", f"({light.x_m:g}, {light.y_m:g})",
                          "off the pavement; expected on it", tolerable=True)


def _obstacles(airport: Airport) -> Iterator[Problem]:
    for name in repeated(preset.name for preset in airport.obstacles):
        yield Problem("obstacle", repr(name), "duplicate name of an obstacle")
    for preset in airport.obstacles:
        where = f"obstacle.{preset.name}"
        if not 0.05 <= preset.radius_m <= 5.0:
            yield Problem(f"{where}.radius_m", f"{preset.radius_m:g}", "must be in 0.05 to 5 m")
        near_m = math.dist((preset.x_m, preset.y_m), (airport.start.x_m, airport.start.y_m))
        if preset.appears_within_m is None and near_m < preset.radius_m + 0.5:
            yield Problem(where, f"({preset.x_m:g}, {preset.y_m:g})",
                          "on the start pose; expected at least 0.5 m beside it")
        for name in ("present_from_s", "appears_within_m", "gone_after_s"):
            value = getattr(preset, name)
            if value is not None and value < 0:
                yield Problem(f"{where}.{name}", f"{value:g}", "must not be negative")


def mission_problems(mission: Mission, airport: Airport) -> Iterator[Problem]:
    """Yield the problems of a mission at an airport with a sound graph."""
    where = f"missions.{mission.name}"
    if not mission.goals:
        yield Problem(where, "empty", "a mission needs at least one goal")
    off = _off_pavement(airport, [(goal.x_m, goal.y_m) for goal in mission.goals])
    for i, goal in enumerate(mission.goals):
        at = f"({goal.x_m:g}, {goal.y_m:g})"
        spot = f"{where}.goals[{i}]"
        nearest = airport.nearest_on_graph(goal.x_m, goal.y_m)
        if nearest.distance_m > GRAPH_REACH_M:
            yield Problem(spot, at, f"{nearest.distance_m:.1f} m from the graph; a mission point "
                          f"must be within {GRAPH_REACH_M:g} m of it")
        elif nearest.a not in airport.within_reach:
            yield Problem(spot, at, "not connected to the start; expected a connected graph")
        if off[i]:
            yield Problem(spot, at, "in the prohibited area; expected on the pavement",
                          tolerable=True)
