"""docs/how-to/ready-modules.md: its system is sound, its table complete."""

from __future__ import annotations

import asyncio
import re
import tomllib

import msgspec
import pytest

from rampart.actors.ftm import topics
from rampart.actors.system.members import load_class
from rampart.testing import VirtualSystem, run
from tests import ROOT
from tests.documents.page import Page

PAGE = Page("how-to/ready-modules")
ROWS = re.findall(r"^\| `(\w+):(\w+)` \| (.*) \|$", PAGE.text, re.MULTILINE)


def test_the_check_points_are_supervised_in_their_order():
    (row,) = tomllib.loads(PAGE.block("toml", "[[detection]]"))["detection"]
    chosen = msgspec.convert(row["parameters"], load_class(row["actor"]).Parameters)
    assert chosen.each
    assert [step.at for step in chosen.steps] == ["measured", "checked", "commanded"]


def test_the_system_detects_and_shuts_the_inlet(tmp_path, monkeypatch):
    (tmp_path / "tank.py").write_text(PAGE.block("python"))
    (tmp_path / "tank.toml").write_text(PAGE.block("toml", "name = "))
    monkeypatch.syspath_prepend(tmp_path)

    async def scenario() -> None:
        async with VirtualSystem.load(tmp_path / "tank.toml") as system:
            states = system.hear(topics.RECOVERY)
            reports = system.hear(topics.DETECTION)
            valve = system.hear(system.layout.topics["tank/valve"])
            for name in system.layout.members:
                if name not in {"supervisor", "observer"}:
                    system.start_node(name)
            await asyncio.sleep(60.0)
            assert {heard.message.state.value for heard in reports
                    if heard.header.source != "D_PUMP"} == {"idle"}
            first_s = min(heard.time_s for heard in reports if heard.message.state == "active")
            assert first_s == pytest.approx(20 + 10, abs=0.5)  # filling, and busy for ever
            assert any(heard.message.phase.value == "degraded" for heard in states)
            assert valve[-1].message.shut
            await asyncio.sleep(50.0)
            assert any(heard.header.source == "D_LEVEL" and heard.message.state == "active"
                       for heard in reports)

    run(scenario)


@pytest.mark.parametrize(("module", "name", "said"), ROWS, ids=[row[1] for row in ROWS])
def test_the_table_has_the_parameters_there_are(module, name, said):
    room = "detection" if (ROOT / "actors" / "detection" / f"{module}.py").is_file() else "recovery"
    actor = load_class(f"rampart.actors.{room}.{module}:{name}")
    known = {field.name for field in msgspec.structs.fields(actor.Parameters)}
    assert set(re.findall(r"`([a-z_]+)`", said)) <= known
