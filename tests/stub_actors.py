"""A system whose every actor only lives: the real supervision with nothing to supervise for."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from itertools import cycle, islice
from pathlib import Path

import msgspec

from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.run import run_info
from rampart.actors.run.run_plan import RunPlan
from rampart.actors.runtime.actor import Actor
from rampart.actors.supervision.launcher import Launcher
from tests import ROOT


def bases() -> Iterator[int]:
    """Yield bases that no other worker of this test run takes, below the ephemeral ports.

    Two workers with the same bases meet between the look for a free one and its use.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    of_this_worker = range(10_000 + worker * 40, 32_000, workers * 40)
    test_run = os.getppid() if workers > 1 else os.getpid()  # two runs of one test differ
    start = test_run % len(of_this_worker)
    return cycle((*of_this_worker[start:], *of_this_worker[:start]))


_BASES = bases()


class Idler(Actor):
    """Beats its heart and does nothing else; it may stand in every table of a spec."""

    outputs = (topics.POSE, ftm_topics.DETECTION, ftm_topics.RECOVERY)


def write_stub_system(directory: Path) -> Path:
    """Write the shipped system with every actor replaced by an `Idler`."""
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
    file = directory / "stub.toml"
    file.write_text(re.sub(r'^actor = "[^"]+"', 'actor = "tests.stub_actors:Idler"', text,
                           flags=re.MULTILINE), encoding="utf-8")
    return file


def free_base_port() -> int:
    """Return a number that no run has."""
    for base in islice(_BASES, 1000):
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
                probe.bind(run_info.address(base))
            with socket.create_server(("127.0.0.1", base)):  # for a page of its own
                pass
        except OSError:
            continue
        return base
    raise RuntimeError("no free number")


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
