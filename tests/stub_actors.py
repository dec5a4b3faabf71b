"""A system whose every actor only lives: the real supervision with nothing to supervise for."""

from __future__ import annotations

import os
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec

from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.run.run_plan import RunPlan
from rampart.actors.runtime.actor import Actor
from rampart.actors.supervision.launcher import Launcher
from rampart.testing import free_base_port
from tests import ROOT


class Idler(Actor):
    """Beats its heart and does nothing else; it may stand in every table of a spec."""

    class Parameters(Actor.Parameters, frozen=True, forbid_unknown_fields=False):
        """It takes any, and heeds none."""

    outputs = (topics.POSE, ftm_topics.DETECTION, ftm_topics.RECOVERY)


def write_stub_system(directory: Path) -> Path:
    """Write the shipped system with every actor replaced by an `Idler`."""
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
    file = directory / "stub.toml"
    file.write_text(re.sub(r'^actor = "[^"]+"', 'actor = "tests.stub_actors:Idler"', text,
                           flags=re.MULTILINE), encoding="utf-8")
    return file


def stub_plan(system: Path, **changes: object) -> RunPlan:
    """Return a plan that runs the stub system."""
    plan = RunPlan("stub", free_base_port(), system_file=str(system))
    return msgspec.structs.replace(plan, **changes)


@asynccontextmanager
async def launched(plan: RunPlan) -> AsyncIterator[Launcher]:
    """Start a run without observer and end it."""
    os.environ["PYTHONPATH"] = str(ROOT)
    launcher = Launcher(plan, "test")
    launcher.begin()
    try:
        await launcher.load()
        await launcher.start()
        yield launcher
    finally:
        await launcher.end()
