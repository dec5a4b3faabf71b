"""A system that says whatever the tests want, and the operator's page on it in a real Chromium."""

from __future__ import annotations

import math
import os
from contextlib import asynccontextmanager

import numpy as np

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.manager.spec.specification import parse_specification
from rampart.testing import free_port
from tests import ROOT
from tests.actors.operator.browser import browser
from tests.actors.operator.world import AIRPORT, Others, World, served

FILE = ROOT / "systems" / "osmosis.toml"
SPEC = parse_specification(FILE.read_text(encoding="utf-8"), FILE.name)
LIVE = "document.getElementById('link').textContent === 'live'"


class Everybody(Others):
    """Says whatever the rest of the system says."""

    outputs = tuple(topics.ALL)

    def manager(self, *active: str, activated: tuple[str, ...] = (),
                latched: tuple[str, ...] = ()) -> None:
        """Publish the manager's status: some mechanisms are active, and so are their modules."""
        detecting = {d for x in SPEC.mechanisms if x.name in active for d in x.detections}
        self.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus(
            active, (), activated, latched, "guarded-repair", 1, tuple(
                fm.DetectionView(d.name, d.name in detecting, "a test" * (d.name in detecting), ())
                for d in SPEC.detections)))

    def sweep(self) -> None:
        """Publish a pose and a sweep with one echo, 3 m straight ahead."""
        ranges = np.full(181, 8.0, dtype="<f4")
        ranges[90] = 3.0
        self.publish(topics.POSE, m.Pose(-10.0, 5.0, 0.5))
        self.publish(topics.SCAN, m.LaserScan(
            -math.radians(135), math.radians(1.5), 8.0, ranges.tobytes()))

    def busy(self) -> None:
        """Publish something for every part of the page."""
        self.sweep()
        self.manager("FTM4", activated=("RM3",), latched=("RM1",))
        goals = tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in AIRPORT.mission("AB").goals)
        self.publish(topics.MISSION_STATUS, m.MissionStatus(
            "r1/first", "AB", m.MissionPhase.RUNNING, 1, goals, (12.0,), (), "",
            orders=tuple(m.MissionAction)))
        self.publish(topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.AUTO, False, "", 0))
        self.publish(ftm_topics.NODES, fm.NodeTable(tuple(
            fm.NodeInfo(n.name, n.kind.value, os.getpid(), fm.NodeState.RUNNING, 1, 0)
            for n in SPEC.actors())))


@asynccontextmanager
async def speaking_world():
    """A world with `Everybody` in it."""
    made = World()
    made.others = Everybody(made.context("others", 1))
    async with made.running(made.others):
        yield made


@asynccontextmanager
async def page(world, airport=AIRPORT, system=SPEC, **look):
    """A page on an HMI that knows the system and an airport."""
    async with (world.hmi(hmi_port=free_port(), system=system, airport=airport) as hmi,
                browser() as tab):
        await tab.show(f"http://{await served(hmi)}/", **look)
        await tab.until(LIVE)
        await tab.until("document.querySelectorAll('#tree .event').length > 0")
        yield tab
        assert tab.errors == []


def events(kind: str) -> str:
    return (f"[...document.querySelectorAll('#tree .event.{kind} .ftm')]"
            ".map((t) => t.textContent).join()")
