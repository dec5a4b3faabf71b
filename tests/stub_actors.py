"""A system whose every actor only lives: the real supervision with nothing to supervise for."""

from __future__ import annotations

import os
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec

from benchmarks.own_root import OwnLauncher
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.launcher import Launcher
from rampart.testing import free_base_port
from tests import ROOT


class Idler(Actor):
    """Beats its heart and does nothing else."""

    class Parameters(Actor.Parameters, frozen=True, forbid_unknown_fields=False):
        """It takes any, and heeds none."""


class IdlePose(Idler):
    """As the localization."""

    outputs = (topics.POSE,)


class IdleDetection(Idler):
    """As a detection module."""

    outputs = (ftm_topics.DETECTION,)


class IdleRecovery(Idler):
    """As a recovery module."""

    outputs = (ftm_topics.RECOVERY,)


class IdleManager(Idler):
    """As the manager."""

    outputs = (ftm_topics.MANAGER_STATUS,)


_IDLE = {"localization": "IdlePose", "ftm_manager": "IdleManager", "detection": "IdleDetection",
         "recovery": "IdleRecovery"}


def write_stub_system(directory: Path, *changes: tuple[str, str]) -> Path:
    """Write the shipped system with every actor replaced by an `Idler` of its kind.

    Args:
        directory: Folder of the new file.
        changes: Further replacements of text.
    """
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")

    def idle(row: re.Match[str]) -> str:
        kind = _IDLE.get(row["name"]) or _IDLE.get(row["table"], "Idler")
        return f'{row["head"]}actor = "tests.stub_actors:{kind}"'

    text = re.sub(
        r'(?m)^(?P<head>\[\[(?P<table>\w+)\]\]\n'
        r'(?:(?!\[)(?!actor)(?:name = "(?P<name>\w+)")?.*\n)*?)'
        r'actor = "[^"]+"', idle, text)
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    file = directory / "stub.toml"
    file.write_text(text, encoding="utf-8")
    return file


def stub_plan(system: Path, **changes: object) -> RunPlan:
    """Return a plan that runs the stub system."""
    plan = RunPlan("stub", free_base_port(), system_file=str(system))
    return msgspec.structs.replace(plan, **changes)


@asynccontextmanager
async def launched(plan: RunPlan) -> AsyncIterator[Launcher]:
    """Start a run without observer and end it."""
    os.environ["PYTHONPATH"] = str(ROOT)
    launcher = OwnLauncher(plan, "test")
    try:
        await launcher.load()
        await launcher.start()
        yield launcher
    finally:
        await launcher.end()
