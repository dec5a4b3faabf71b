"""Faults by hand: listed, on the operator's page, and on processes; also those of the file."""

import asyncio
import signal

import pytest
from flights import SYSTEM
from quadrotor import topics as t

from rampart import INJECTION_REPORT, parse_specification
from rampart.actors.operator.requests import InjectRequest
from rampart.actors.web.page_plan import PagePlan
from rampart.cli.main import main
from rampart.sim.faults.faults import faults_of
from rampart.testing import RealRun, VirtualSystem, eventually, free_base_port, run

MORE = """
[[node]]
name = "hmi"
actor = "rampart.actors.operator.hmi:Hmi"
kind = "non-control"

[[fault]]
name = "battery-gauge-high"
title = "The battery reads a tenth too high"
topic = "sensors/battery"
mode = "corrupt"
add = { charge = 0.1 }
kind = "sensor"
"""
"""Added to the specification: an operator's page, and a fault."""


@pytest.fixture
def file(tmp_path):
    made = tmp_path / "quadrotor.toml"
    made.write_text(SYSTEM.read_text(encoding="utf-8") + MORE)
    return made


def unjudged(file):
    """Remove the judge, so that the run continues on a busy machine."""
    head, _, rest = file.read_text(encoding="utf-8").partition("[judge]\n")
    file.write_text(head + rest[rest.index("[end]\n"):])
    return file


def test_they_are_listed(file, capsys):
    assert main(["inject", "--list", "--system", str(file)]) == 0
    rows = {line.split()[0]: " ".join(line.split()[1:])
            for line in capsys.readouterr().out.splitlines() if line}
    assert rows["weak-rotor"] == "inf the front left rotor loses 30 % of its thrust"
    assert rows["gps-dropout"].startswith("inf ")
    assert rows["battery-gauge-high"] == "10 The battery reads a tenth too high"
    assert "weak-rotor:3:0.7" in rows


def test_a_page_orders_them_of_the_world(file):
    async def scenario():
        faults = faults_of(parse_specification(file.read_text(encoding="utf-8"), file.name))
        async with VirtualSystem.load(
                file, faults=faults.offered(), page=PagePlan(free_base_port())) as system:
            for name in ("world", "hmi"):
                system.start_node(name)
            page, world = system.actors["hmi"], system.actors["world"]
            assert {"weak-rotor", "battery-drain", "battery-gauge-high", "gps-dropout"} <= {
                fault["name"] for fault in page._operating.introduction(1)["faults"]}
            reports = system.hear(INJECTION_REPORT)
            batteries = system.hear(t.BATTERY)
            await asyncio.sleep(1)
            page._fulfil(InjectRequest("weak-rotor"), 1)
            page._fulfil(InjectRequest("battery-gauge-high", duration_s=1.0), 1)
            await eventually(lambda: len({r.message.injection for r in reports}) == 2, 2, "no")
            assert world.physics.health.rotors[0] == 0.7
            await asyncio.sleep(3)
            assert max(heard.message.charge for heard in batteries) > 0.95
            last = {heard.message.injection: heard.message for heard in reports}
            assert sorted((one.node, one.affected > 0, one.finished) for one in last.values()) == [
                ("world", True, False), ("world", True, True)]

    run(scenario)


@pytest.mark.slow
@pytest.mark.processes
def test_on_processes_they_come_by_hand_and_as_planned(file, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SYSTEM.parent))
    planned = [word for fault in ("weak-rotor:1:0.95@2+1", "battery-gauge-high@2+1")
               for word in ("--fault", fault)]
    with RealRun(tmp_path, unjudged(file), "--hmi-port", str(free_base_port()), *planned,
                 hmi=True) as flight:  # its page shows permanent faults
        flight.sleep_until(4)
        by_hand = {fault: flight.tool("inject", fault, "--duration", "1")
                   for fault in ("weak-rotor:2:0.95", "battery-gauge-high")}
        by_hand["battery-drain:1.1"] = flight.tool("inject", "battery-drain:1.1")
        before = flight.pid("mission")
        by_hand["kill:mission"] = flight.tool("inject", "kill:mission")
        flight.wait_until(lambda: flight.pid("mission") not in (None, before), 10, "not back")
        flight.process.send_signal(signal.SIGINT)
        _, result = flight.result(30)
    assert {fault: done.stderr for fault, done in by_hand.items() if done.returncode} == {}
    assert "ticks changed" in by_hand["weak-rotor:2:0.95"].stdout
    assert "messages on sensors/battery affected" in by_hand["battery-gauge-high"].stdout
    assert by_hand["battery-drain:1.1"].stdout.endswith("affects world, continues\n")
    assert {fault["fault"]: fault["effective"] for fault in result["faults"]} == {
        "weak-rotor:1:0.95@2+1": True, "battery-gauge-high@2+1": True}
    assert result["restarts"]["mission"] >= 1
