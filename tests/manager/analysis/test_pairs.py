"""The table of all ordered pairs is what the running manager does."""

import asyncio
import json

import pytest
from msgspec.structs import replace

from rampart.cli.main import main
from rampart.manager.analysis.pairs import Pair, causes_of, pairs
from rampart.testing import run
from tests import ROOT
from tests.manager.bench import Managed, full_system, paper

SOON_S = 0.05


async def become(system: Managed, *mechanisms: str) -> tuple[str, ...]:
    """Make exactly these mechanisms active; return the recoveries that are in force then."""
    spec = system.run.system
    system.detect(*(cause for name in mechanisms for cause in causes_of(spec, name)))
    await asyncio.sleep(SOON_S)
    return tuple(r.name for r in spec.recoveries if system.actors[r.name].activated)


async def played(system: Managed, first: str, second: str) -> Pair:
    found = []
    for remaining in (second, first):
        await become(system, first)
        both = await become(system, first, second)
        found += [await become(system, remaining), await become(system)]
        for latched in system.status.latched:
            await system.reset(latched)
        assert await become(system) == ()
    return Pair(first, second, both, found[0], found[2], found[1])


@pytest.mark.parametrize("system", [full_system, paper])
def test_the_running_manager_does_what_the_table_lists_for_each_ordered_pair(system):
    spec = system()
    spec = replace(spec, timing=replace(spec.timing, release_hold_s=0.0, release_hold_max_s=0.0))
    table = pairs(spec)
    count = len(spec.mechanisms)
    assert len(table) == count * (count - 1)

    async def scenario() -> None:
        async with Managed(spec) as managed:
            for pair in table:
                assert await played(managed, pair.first, pair.second) == pair

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
