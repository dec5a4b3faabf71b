"""What must hold of an airport, checked once at load."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

import shapely
from shapely.geometry import LineString

from airport.errors import Problem
from airport.model import GOAL_MODES, GRAPH_REACH_M, Airport, Mission

MIN_EDGE_CLEARANCE_M = 0.5
"""An edge nearer than this to the prohibited area cannot be driven (half the robot's width)."""


def problems(airport: Airport) -> Iterator[Problem]:
    """Yield everything that is wrong, the fundamental first; later checks trust earlier ones."""
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
    for name, at in airport.nodes.items():
        if not all(math.isfinite(v) for v in at):
            yield Problem(f"nodes.{name}", f"{at}", "coordinates must be finite numbers of metres")
    for i, (a, b) in enumerate(airport.edges):
        for name in (a, b):
            if name not in airport.nodes:
                yield Problem(f"edges[{i}]", repr(name), "unknown node; name one from nodes")
        if a == b:
            yield Problem(f"edges[{i}]", f"{a!r} to {b!r}", "an edge joins two different nodes")
    pairs = Counter(frozenset(edge) for edge in airport.edges if edge[0] != edge[1])
    for pair, times in pairs.items():
        if times > 1:
            yield Problem("edges", " to ".join(sorted(pair)), "edge given twice; once is enough",
                          tolerable=True)


def _ground(airport: Airport) -> Iterator[Problem]:
    if airport.allowed.is_empty:
        yield Problem("surface", "empty", "the airport needs pavement to drive on")
        return
    start = airport.start
    if not all(math.isfinite(v) for v in (start.x_m, start.y_m, start.yaw_rad)):
        yield Problem("start", f"{start}", "the start pose must be finite")
        return
    if airport.prohibited_distance_m(start.x_m, start.y_m) <= 0:
        yield Problem("start", f"({start.x_m:g}, {start.y_m:g})",
                      "in the prohibited area; put it on the pavement", tolerable=True)
    off_m = airport.nearest_on_graph(start.x_m, start.y_m).distance_m
    if off_m > GRAPH_REACH_M:
        yield Problem("start", f"({start.x_m:g}, {start.y_m:g})",
                      f"{off_m:.1f} m from the graph; must be within {GRAPH_REACH_M:g} m")
    inside = set()
    for name, (x_m, y_m) in airport.nodes.items():
        if airport.prohibited_distance_m(x_m, y_m) <= 0:
            inside.add(name)
            yield Problem(f"nodes.{name}", f"({x_m:g}, {y_m:g})",
                          "in the prohibited area; put it on the pavement", tolerable=True)
    for i, (a, b) in enumerate(airport.edges):
        if inside & {a, b}:
            continue
        line = LineString([airport.nodes[a], airport.nodes[b]])
        if not shapely.covers(airport.allowed, line):
            yield Problem(f"edges[{i}]", f"{a} to {b}", "passes through the prohibited area; "
                          "lead it over pavement", tolerable=True)
        elif shapely.distance(airport.allowed.boundary, line) < MIN_EDGE_CLEARANCE_M:
            yield Problem(f"edges[{i}]", f"{a} to {b}", "nearer to the prohibited area than "
                          f"{MIN_EDGE_CLEARANCE_M:g} m; the robot needs more room", tolerable=True)


def _lights(airport: Airport) -> Iterator[Problem]:
    names = Counter(light.name for light in airport.lights)
    for name, times in names.items():
        if times > 1:
            yield Problem("row", repr(name), "two lights of this name; names must be unique")
    for light in airport.lights:
        if not light.nominal_cd > 0:
            yield Problem(f"row.{light.name}.nominal_cd", f"{light.nominal_cd:g}",
                          "the nominal intensity must be positive")
        if airport.prohibited_distance_m(light.x_m, light.y_m) <= 0:
            yield Problem(f"row.{light.name}", f"({light.x_m:g}, {light.y_m:g})",
                          "off the pavement; inset lights lie in it", tolerable=True)


def _obstacles(airport: Airport) -> Iterator[Problem]:
    names = Counter(preset.name for preset in airport.obstacles)
    for name, times in names.items():
        if times > 1:
            yield Problem("obstacle", repr(name), "two obstacles of this name; must be unique")
    for preset in airport.obstacles:
        where = f"obstacle.{preset.name}"
        if not 0.05 <= preset.radius_m <= 5.0:
            yield Problem(f"{where}.radius_m", f"{preset.radius_m:g}", "must be in 0.05 to 5 m")
        near_m = math.dist((preset.x_m, preset.y_m), (airport.start.x_m, airport.start.y_m))
        if preset.appears_within_m is None and near_m < preset.radius_m + 0.5:
            yield Problem(where, f"({preset.x_m:g}, {preset.y_m:g})",
                          "stands on the start pose; move it at least 0.5 m clear")
        for name in ("present_from_s", "appears_within_m", "gone_after_s"):
            value = getattr(preset, name)
            if value is not None and value < 0:
                yield Problem(f"{where}.{name}", f"{value:g}", "must not be negative")


def mission_problems(mission: Mission, airport: Airport) -> Iterator[Problem]:
    """Yield what is wrong with one mission at an airport whose graph is sound."""
    where = f"missions.{mission.name}"
    if not mission.goals:
        yield Problem(where, "empty", "a mission needs at least one goal")
    start = airport.nearest_on_graph(airport.start.x_m, airport.start.y_m)
    reachable = airport.component(start.a)
    for i, goal in enumerate(mission.goals):
        at = f"({goal.x_m:g}, {goal.y_m:g})"
        spot = f"{where}.goals[{i}]"
        if goal.mode not in GOAL_MODES:
            yield Problem(f"{spot}.mode", repr(goal.mode), f"must be one of {GOAL_MODES}")
        if not (math.isfinite(goal.x_m) and math.isfinite(goal.y_m)):
            yield Problem(spot, at, "coordinates must be finite numbers of metres")
            continue
        nearest = airport.nearest_on_graph(goal.x_m, goal.y_m)
        if nearest.distance_m > GRAPH_REACH_M:
            yield Problem(spot, at, f"{nearest.distance_m:.1f} m from the graph; a mission point "
                          f"must be within {GRAPH_REACH_M:g} m of it")
        elif nearest.a not in reachable:
            yield Problem(spot, at, "no way there from the start; connect the graph")
        if airport.prohibited_distance_m(goal.x_m, goal.y_m) <= 0:
            yield Problem(spot, at, "in the prohibited area; put it on the pavement",
                          tolerable=True)
