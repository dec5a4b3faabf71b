"""A rehearsal runs a node, and nothing of it is left, heard or kept."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import msgspec
import pytest

from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.actors.runtime.checkpoint_file import FileCheckpoints, read
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision import rehearsal
from rampart.actors.supervision.rehearsal import Stage, run_for_a_moment


class Count(msgspec.Struct, frozen=True):
    number: int = 0


COUNT = Topic("stub/count", Count, Qos.STATE, 50.0, "", "For this test.")
FORM = StateFormat(Count)


class Counter(Actor):
    """Counts on from what was kept, fifty times a second."""

    outputs = (COUNT,)
    most_spare = "warm"
    fails = False

    def on_start(self) -> None:
        self.began = self.count = (self.kept(FORM) or Count()).number
        self._go_on()

    def _go_on(self) -> None:
        self.count += 1
        self.keep(FORM, Count(self.count))
        self.publish(COUNT, Count(self.count))
        if self.fails:
            raise RuntimeError("as it would when it counts")
        self.call_later(0.02, self._go_on)


class FailingCounter(Counter):
    fails = True


def plan(folder: Path) -> RunPlan:
    for name in ("run", "checkpoints"):
        (folder / name).mkdir()
    return RunPlan(run_id="r", folder=str(folder / "run"),
                   checkpoints=str(folder / "checkpoints"))


async def rehearsed(plan: RunPlan, kind: type[Counter], wanted: asyncio.Event) -> Counter:
    """Return an actor after its rehearsal; nothing may have been heard of it meanwhile."""
    heard: list[str] = []
    bus = ZenohBus("counter", 2, [])
    await bus.open(announce=False)
    stage = Stage(plan, bus, "counter", 2)
    stage.subscribe(COUNT, COUNT.at(), lambda key, _payload: heard.append(key))
    actor = kind(Context("counter", 2, Clock(time.monotonic()), stage, checkpoints=stage.store))
    try:
        await run_for_a_moment([actor], wanted)
    finally:
        stage.clear()
    done = actor.count
    await asyncio.sleep(0.06)
    assert actor.count == done, "it went on after its rehearsal"
    assert heard == []
    assert not list(Path(plan.folder).iterdir()), "files are left of it"
    await bus.close()
    return actor


async def test_a_node_runs_from_a_copy_of_its_checkpoint_and_keeps_nothing(tmp_path):
    run = plan(tmp_path)
    original = FileCheckpoints(Path(run.checkpoints), "counter", "r", 1)
    original.save(1, 0, FORM.encode(Count(41)))
    actor = await rehearsed(run, Counter, asyncio.Event())
    assert actor.began == 41
    assert actor.count > 42, "it ran for some turns"
    original.save(1, 0, FORM.encode(Count(42)))
    original.close()
    kept = read(Path(run.checkpoints), "counter", "r").records[0]
    assert (kept.incarnation, FORM.decode(1, kept.state)) == (1, Count(42))


async def test_one_that_is_wanted_does_not_rehearse_to_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(rehearsal, "_RUN_S", 60.0)
    wanted = asyncio.Event()
    asyncio.get_running_loop().call_later(0.05, wanted.set)
    async with asyncio.timeout(10):
        await rehearsed(plan(tmp_path), Counter, wanted)


@pytest.mark.parametrize("damaged", [False, True])
async def test_what_fails_or_is_damaged_ends_no_rehearsal(tmp_path, damaged):
    run = plan(tmp_path)
    if damaged:
        Path(run.checkpoints, "counter.1.1").write_bytes(b"no state" * 100)
    actor = await rehearsed(run, FailingCounter, asyncio.Event())
    assert (actor.began, actor.count) == (0, 1)
    assert Path(run.checkpoints, "counter.1.1").exists() == damaged
