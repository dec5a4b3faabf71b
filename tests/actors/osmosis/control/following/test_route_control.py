"""The core of Osmosis Control by itself: messages and the time in, commands and the status out."""

from __future__ import annotations

import math

import msgspec
import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.control.following.dead_reckoning import DeadReckoning
from rampart.actors.osmosis.control.following.light_ledger import RowInspection
from rampart.actors.osmosis.control.following.light_row import RowLimits
from rampart.actors.osmosis.control.following.route_control import PERIOD_S, RouteControl
from rampart.actors.osmosis.control.pilot.laser_pair import LOWER
from rampart.manager.spec.schema import Layers
from tests.actors.osmosis.control.house import AIRPORT
from tests.actors.osmosis.control.laser_sweeps import full_sweep
from tests.osmosis_system import shipped_system

SYSTEM = msgspec.structs.replace(shipped_system(), layers=Layers(checkpoints=True))
START = AIRPORT.start
GOAL = (START.x_m + 20.0 * math.cos(START.yaw_rad), START.y_m + 20.0 * math.sin(START.yaw_rad))
WAY = m.Route("m", 0, m.Mode.TAXI, True, ((START.x_m, START.y_m), GOAL), "")


class Bench:
    """A core whose robot stands at the start."""

    def __init__(self, **parts) -> None:
        self.told: list[tuple[str, str, str]] = []
        self.core = RouteControl(
            SYSTEM, AIRPORT, lambda *what: self.told.append(what), 0.0, RowLimits(),
            lights=RowInspection((), goes_back=False), **parts)
        self.now_s = 0.0

    def drive(self, seconds: float, *, localized: bool = True) -> list[m.Twist]:
        commands = []
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            if localized:
                self.core.pose(m.Pose(START.x_m, START.y_m, START.yaw_rad), self.now_s, self.now_s)
            self.core.scan(LOWER, full_sweep(number=round(self.now_s / PERIOD_S)), self.now_s,
                           self.now_s)
            commands.append(self.core.step(self.now_s))
        return commands


def test_without_a_route_zero_is_commanded_and_with_one_it_accelerates():
    bench = Bench()
    assert set(bench.drive(0.5)) == {m.Twist(0.0, 0.0)}
    assert not bench.core.report()
    assert bench.core.status.phase is m.ControlPhase.IDLE
    assert bench.core.route(WAY)
    assert not bench.core.route(WAY)
    speeds = [command.linear_mps for command in bench.drive(1.0)]
    assert speeds == sorted(speeds)
    assert speeds[-1] > 0.5
    assert bench.core.report()
    assert bench.core.status.phase is m.ControlPhase.FOLLOWING
    assert not bench.core.report()


def test_a_wrong_route_is_refused_and_looked_at_again_with_another_goal():
    bench = Bench(check=RouteCheck(AIRPORT))
    bench.drive(0.2)
    wrong = m.Route("m", 0, m.Mode.TAXI, True, ((START.x_m + 900.0, 0.0), GOAL), "")
    assert bench.core.route(wrong)
    assert [context for context, *_ in bench.told] == ["route refused"]
    assert set(bench.drive(0.2)) == {m.Twist(0.0, 0.0)}
    assert bench.core.report()
    assert bench.core.status.phase is m.ControlPhase.REFUSED
    assert bench.core.goal(m.GoalOrder("m", 0, m.Goal(*GOAL, m.Mode.TAXI), True))
    assert len(bench.told) == 2
    assert set(bench.drive(0.2)) == {m.Twist(0.0, 0.0)}


@pytest.mark.parametrize("bridge", [None, DeadReckoning(1.0)], ids=["the paper's", "bridged"])
def test_only_who_bridges_a_stale_pose_stops_when_it_has_nothing_to_bridge_with(bridge):
    bench = Bench(bridge=bridge)
    bench.core.route(WAY)
    bench.drive(1.0)
    assert (bench.drive(1.0, localized=False)[-1] == m.Twist(0.0, 0.0)) == (bridge is not None)


def test_what_is_kept_says_where_a_successor_takes_up_the_route():
    bench, after = Bench(), Bench()
    assert bench.core.kept is None
    bench.core.route(WAY)
    bench.drive(0.2)
    kept = bench.core.kept
    assert kept is not None
    assert (kept.route, kept.row_start) == (WAY, WAY.waypoints[0])
    assert kept.progress_m == pytest.approx(0.0, abs=1e-6)
    after.core.restore(kept)
    assert after.core.route(WAY)
    assert after.core.kept.row_start == WAY.waypoints[0]
