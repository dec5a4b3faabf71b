"""DM10 and DM11: a route that must not be driven, and control nodes that contradict each other."""

from __future__ import annotations

import math
from types import MappingProxyType

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.detection.erroneous_route import RouteMonitor
from rampart.actors.osmosis.detection.mission_consistency import (
    ConsistencyLimits,
    ConsistencyMonitor,
)
from rampart.actors.osmosis.messages import ControlPhase, Goal, MissionPhase, Mode
from rampart.testing import play, table, wake

GOALS = (Goal(10.0, 0.0, Mode.TAXI), Goal(40.0, 0.0, Mode.LIGHT_VERIFICATION))
GOOD, BAD = ((0.0, 0.0), (10.0, 0.0)), ((0.0, 0.0), (10.0, 5.0))


# ---- DM10 ---------------------------------------------------------------------------------------

# g a good route of the planner's first life, b a bad one, G and B of its second; n none.
ROUTES = {
    "one bad route is enough, and good ones must come for 500 ms": (
        "g.b.g.g.g.g.g", "--AAAAAAAA---"),
    "a planner that is wrong now and then": ("gbgggbggggggg", "-AAAAAAAAAA--"),
    "a planner that was respawned is believed": ("gb..GG", "-AAA--"),
    "unless it is wrong as well": ("gb..BBGGGGGGG", "-AAAAAAAAAA--"),
    "an inactive route is not bad": ("gbnnnnnnn", "-AAAAAA--"),
}


def routes(monitor):
    def handle(event, now_s):
        active = event != "n"
        waypoints = (BAD if event in "bB" else GOOD) if active else ()
        monitor.route(m.Route("m1", 0, Mode.TAXI, active, waypoints, ""), "graph_planner",
                      1 if event.islower() else 2, now_s)

    return handle


def wrong(waypoints, _goal):
    return "leg 1 is wrong" if waypoints == BAD else ""


@pytest.mark.parametrize(("events", "expected"), **table(ROUTES))
def test_timeline_of_routes(events, expected):
    monitor = RouteMonitor(wrong, 0.5)
    assert expected == play(monitor, routes(monitor), events)


STATUS = m.MissionStatus("m1", "A", MissionPhase.RUNNING, 0, GOALS, (), (), "")


@pytest.mark.parametrize(("goal", "status", "blamed"), [
    (GOALS[0], STATUS, "graph_planner#1"),
    (Goal(10.0, 4.0, Mode.TAXI), STATUS, "mission_manager#3"),
    (Goal(10.0, 4.0, Mode.TAXI), msgspec.structs.replace(STATUS, phase=MissionPhase.RETURNING),
     "graph_planner#1"),
    (GOALS[0], msgspec.structs.replace(STATUS, mission_id="m2"), "mission_manager#3")])
def test_who_gave_a_wrong_goal_is_to_blame_for_the_bad_route_to_it(goal, status, blamed):
    monitor = RouteMonitor(wrong, 0.5)
    monitor.mission(status)
    monitor.goal(m.GoalOrder("m1", 0, goal, True), "mission_manager", 3)
    routes(monitor)("b", 1.0)
    assert monitor.nodes == (blamed,)
    monitor.goal(m.GoalOrder("m1", 0, GOALS[0], True), "mission_manager", 4)
    routes(monitor)("g", 1.1)
    assert monitor.active == blamed.startswith("graph"), "a new life of the manager is believed"


# ---- DM11 ---------------------------------------------------------------------------------------


class Story:
    """The chain in order, and what may be changed about it."""

    def __init__(self, changes=MappingProxyType({})):
        self.mission = m.MissionStatus("m1", "A", MissionPhase.RUNNING, 0, GOALS, (), (), "")
        self.goal = m.GoalOrder("m1", 0, GOALS[0], True)
        self.route = m.Route("m1", 0, Mode.TAXI, True, GOOD, "")
        self.control = m.ControlStatus("m1", 0, ControlPhase.FOLLOWING, 0, 9.0)
        self.pose = (0.0, 0.0)
        self.lives = {"mission": 1, "goal": 1, "route": 1, "control": 1}
        self.silent: set[str] = set()
        for what, fields in changes.items():
            self.change(what, **fields)

    SOURCES = {"mission": "mission_manager", "goal": "mission_manager", "route": "graph_planner",
               "control": "osmosis_control"}

    def change(self, what, **fields):
        setattr(self, what, msgspec.structs.replace(getattr(self, what), **fields))

    def tell(self, monitor, now_s):
        for what, source in self.SOURCES.items():
            if what not in self.silent:
                monitor.take(getattr(self, what), source, self.lives[what], now_s, now_s)
        monitor.pose(*self.pose, now_s)


def watch(story, seconds, monitor=None, start_s=0.0, each=None):
    """Let the chain talk at 5 Hz; return when the monitor became active, or None."""
    monitor = monitor or ConsistencyMonitor(ConsistencyLimits(), start_s)
    found = None
    for tick in range(round(seconds / 0.2)):
        now_s = round(start_s + 0.2 * tick, 9)
        wake(monitor, now_s - 1e-9)
        if each:
            each(story, now_s)
        story.tell(monitor, now_s)
        if monitor.active and found is None:
            found = now_s
    return monitor, found


PAUSED = {"mission": {"phase": MissionPhase.PAUSED}}
IDLE_GOAL = {"goal": {"active": False, "goal": Goal(0.0, 0.0, Mode.TAXI)}}
IDLE_ROUTE = {"route": {"active": False, "waypoints": ()}}
CONTRADICTIONS = {
    "an old goal": ({"mission": {"step": 1}}, "mission_manager#1",
                    "gives goal 1, the mission is at goal 2"),
    "another point": ({"goal": {"goal": Goal(11.0, 0.0, Mode.TAXI)}}, "mission_manager#1",
                      "another point"),
    "another mode": ({"route": {"mode": Mode.LIGHT_VERIFICATION}}, "graph_planner#1", "replanned"),
    "a goal while paused": (PAUSED, "mission_manager#1", "mission m1 is paused"),
    "no goal while running": (IDLE_GOAL, "mission_manager#1", "no goal of mission m1"),
    "a goal of another mission": ({"goal": {"mission_id": "m0"}}, "mission_manager#1", "m0"),
    "an old route": ({"route": {"step": 3}}, "graph_planner#1", "plans to goal 4"),
    "an old plan": ({"goal": {"plan": 1}}, "graph_planner#1", "not replanned goal 1"),
    "a route while paused": ({**PAUSED, **IDLE_GOAL}, "graph_planner#1", "plans against the goal"),
    "an old progress": ({"control": {"step": 2}}, "osmosis_control#1", "is at goal 3"),
    "nothing moves on": ({"control": {"phase": ControlPhase.ARRIVED}}, "mission_manager#1",
                         "keeps goal 1, which is reached"),
    "a step beyond the last": ({"mission": {"step": 2}, "goal": {"step": 2}}, "mission_manager#1",
                               "goal 3"),
    "running": ({}, "", ""),
    "paused": ({**PAUSED, **IDLE_GOAL, **IDLE_ROUTE}, "", ""),
    "returning home": (
        {"mission": {"phase": MissionPhase.RETURNING}, "goal": {"step": 2}, "route": {"step": 2},
         "control": {"step": 2}}, "", ""),
    "over": (
        {"mission": {"phase": MissionPhase.SUCCEEDED, "step": 2},
         "goal": {"step": 2, "active": False}, "route": {"step": 2, "active": False},
         "control": {"step": 1, "phase": ControlPhase.ARRIVED}}, "", ""),
}
"""What contradicts, who is named, and why; no name: it is consistent."""


@pytest.mark.parametrize("case", CONTRADICTIONS.values(), ids=CONTRADICTIONS.keys())
def test_a_lasting_contradiction_names_the_first_in_the_chain_who_is_wrong(case):
    changes, node, reason = case
    monitor, found = watch(Story(changes), 8.0)
    assert found == (pytest.approx(2.5, abs=0.21) if node else None)
    assert monitor.nodes == ((node,) if node else ())
    assert reason in monitor.reason


@pytest.mark.parametrize(("changes", "knows"), [({}, True), ({"route": {"step": 3}}, False)])
def test_a_respawned_module_knows_what_it_has_seen_whole_unless_it_is_contradictory(changes, knows):
    story = Story(changes)
    monitor = ConsistencyMonitor(ConsistencyLimits(), 0.0, known=False)
    monitor.take(story.mission, "mission_manager", 1, 0.0, 0.0)
    assert not monitor.known
    monitor, _ = watch(story, 0.5, monitor)
    assert (monitor.known, monitor.active) == (knows, False)
    monitor, found = watch(story, 4.0, monitor, 0.5)
    assert (found is None) is knows


@pytest.mark.parametrize("first_pose", [(0.0, 20.0), (1e300, 20.0)])
@pytest.mark.parametrize("tells", [True, False])
def test_progress_that_stays_the_same_while_the_robot_drives_is_wrong(tells, first_pose):
    def drive(story, now_s):
        story.pose = (now_s, 20.0)
        if tells:
            story.change("control", distance_to_go_m=9.0 - now_s)

    monitor = ConsistencyMonitor(ConsistencyLimits(), 0.0)
    monitor.pose(*first_pose, 0.0)
    monitor, found = watch(Story(), 6.0, monitor, each=drive)
    assert monitor.known
    assert found is None if tells else found == pytest.approx(3.0, abs=0.21)
    assert monitor.nodes == (() if tells else ("osmosis_control#1",))


@pytest.mark.parametrize("phase", [ControlPhase.FOLLOWING, ControlPhase.WAITING])
def test_an_arrival_that_is_not_reported_is_noticed_later(phase):
    story = Story()
    story.pose = (10.2, 0.0)
    story.change("control", phase=phase)
    monitor, found = watch(story, 9.0)
    assert found is None if phase is ControlPhase.WAITING else found == pytest.approx(6, abs=0.21)
    assert monitor.active == (phase is ControlPhase.FOLLOWING)


@pytest.mark.parametrize("stamp_s", [None, 1e9, math.nan])
@pytest.mark.parametrize(("what", "node"), Story.SOURCES.items())
def test_who_falls_silent_is_named_also_after_a_stamp_of_no_possible_time(what, node, stamp_s):
    story = Story()
    monitor, _ = watch(story, 1.0)
    if stamp_s is not None:
        monitor.take(getattr(story, what), node, 1, stamp_s, 1.0)
    story.silent = {what}
    monitor, found = watch(story, 4.0, monitor, 1.0)
    assert found == (pytest.approx(0.8 + 2.5, abs=0.21) if stamp_s is None else 1.0)
    assert monitor.nodes == (f"{node}#1",)
    monitor.take(getattr(story, what), node, 1, 5.0, 5.0)
    assert not monitor.active


def test_a_new_life_is_forgiven_and_judged_by_what_it_says():
    story = Story()
    story.change("route", step=3)
    monitor, _ = watch(story, 3.0)
    assert monitor.active
    story.lives["route"] = 2
    monitor, found = watch(story, 2.0, monitor, 3.0)
    assert found is None
    monitor, found = watch(story, 2.0, monitor, 5.0)
    assert monitor.nodes == ("graph_planner#2",)


@given(st.lists(st.tuples(
    st.sampled_from(["mission", "goal", "route", "control"]), st.integers(0, 2),
    st.floats(0.05, 1.2)), max_size=25))
def test_contradictions_that_do_not_last_are_none(changes):
    story, monitor, now_s = Story(), ConsistencyMonitor(ConsistencyLimits(), 0.0), 0.0
    for what, step, lasts_s in changes:
        story.change(what, step=step)
        story.tell(monitor, now_s)
        now_s += lasts_s
        for healed in Story.SOURCES:
            story.change(healed, step=0)
        wake(monitor, now_s - 1e-9)
        story.tell(monitor, now_s)
        assert not monitor.active
        now_s += 0.1
