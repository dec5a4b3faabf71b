"""The table of all ordered pairs is what the running manager does."""

from __future__ import annotations

import asyncio
import json

import pytest
from msgspec.structs import replace

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.recovery.stub import StubRecovery
from rampart.actors.runtime.run_context import RunContext
from rampart.cli.main import main
from rampart.manager.actor import FtmManager
from rampart.manager.analysis.pairs import Pair, causes_of, pairs
from rampart.manager.spec.schema import SystemSpec
from rampart.testing import VirtualSystem, run
from tests import ROOT
from tests.manager.bench import full_system, paper

SOON_S = 0.05


class Played(VirtualSystem):
    """The running manager of a system, with recoveries that succeed at once."""

    def __init__(self, spec: SystemSpec) -> None:
        super().__init__(RunContext(system=spec))
        self.spec = spec
        self.since: dict[str, float] = {}
        self.commands = {r.name: self.hear(topics.RECOVERY_COMMAND, r.name)
                         for r in spec.recoveries}

    async def begin(self) -> None:
        for recovery in self.spec.recoveries:
            self.start(recovery.name, StubRecovery, takes_s=0.0,
                       ends="done" if recovery.kind.repairs else "degraded")
        self.start("ftm_manager", FtmManager)
        await self.become()

    async def become(self, *mechanisms: str) -> tuple[str, ...]:
        """Make exactly these mechanisms active; return the recoveries that are in force then."""
        active = {d for name in mechanisms for d in causes_of(self.spec, name)}
        now_s = self.clock.now()
        self.since = {name: self.since.get(name, now_s) for name in active}
        for detection in self.spec.detections:
            is_active = detection.name in active
            state = m.DetectionState.ACTIVE if is_active else m.DetectionState.IDLE
            self.say(topics.DETECTION, m.DetectionReport(
                state, "told" if is_active else "", (), self.since.get(detection.name, now_s)),
                detection.name)
        await asyncio.sleep(SOON_S)
        return tuple(name for name, heard in self.commands.items()
                     if heard and heard[-1].message.activate)


async def played(spec: SystemSpec, first: str, second: str) -> Pair:
    found = []
    for remaining in ((second,), (first,)):
        async with Played(spec) as system:
            await system.begin()
            await system.become(first)
            both = await system.become(first, second)
            found += [await system.become(*remaining), await system.become()]
    return Pair(first, second, both, found[0], found[2], found[1])


@pytest.mark.parametrize("system", [full_system, paper])
def test_the_running_manager_does_what_the_table_lists_for_each_ordered_pair(system):
    spec = system()
    spec = replace(spec, timing=replace(spec.timing, release_hold_s=0.0, release_hold_max_s=0.0))
    table = pairs(spec)
    count = len(spec.mechanisms)
    assert len(table) == count * (count - 1)

    async def scenario() -> None:
        for pair in table:
            assert await played(spec, pair.first, pair.second) == pair

    run(scenario)


def test_the_page_has_what_the_command_prints(capsys):
    assert main(["explain", "--pairs"]) == 0
    page = (ROOT / "docs/case-study/pairs.md").read_text(encoding="utf-8")
    assert f"```\n{capsys.readouterr().out}```\n" in page, (
        "make it anew: `rampart explain --pairs`")


def test_the_rows_as_json(capsys):
    assert main(["explain", "paper", "--pairs", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 42
    assert {"first": "FTM4", "second": "FTM6", "both": ["RM5"], "first_clears": ["RM5"],
            "second_clears": ["RM3"], "both_clear": []} in rows


def test_a_mechanism_with_a_gate_is_made_active_by_the_fewest_modules():
    spec = replace(paper(), mechanisms=tuple(
        replace(each, detect="(DM1 and DM3) or (DM2 and DM3 and DM6)")
        if each.name == "FTM1" else each for each in paper().mechanisms))
    assert causes_of(spec, "FTM1") == ("DM1", "DM3")
