"""What the operator's page shows, in a real Chromium: tree, laser, processes, certificates."""

from __future__ import annotations

import math
import os

import pytest
from msgspec.structs import replace

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.ftm.history import Fault, History
from rampart.manager.model.mechanisms import Clears
from rampart.testing import free_port
from tests.actors.operator.page import LIVE, events, page, show, text
from tests.actors.operator.world import SPEC, repeated

pytestmark = pytest.mark.page
LIT = "$$('#tree .line.lit').length"


async def test_detections_light_the_tree_and_lasers_processes_and_decisions_are_shown(world, tab):
    async with page(world, tab):
        await tab.until(f"{text('manager')}.includes('no message yet')")
        assert await tab.value("$$('#tree .event').length") == len(
            SPEC.events)
        assert await tab.value("$$('#tree .barrier').length") == len(
            SPEC.mechanisms)
        async with repeated(lambda: world.others.manager("FTM4", activated=("RM3",))):
            await tab.until(f"{events('active')} === 'FTM4'")
            assert await tab.value(events("ahead")) == "FTM2"
            assert await tab.value(LIT) == 1
            assert "Detected: FTM4" in await tab.value(text("tree-words"))
            running = "$$('#order .running text')[0].textContent"
            assert await tab.value(running) == "RM3"
        async with repeated(world.others.manager):
            await tab.until(f"{events('active')} === ''")
            assert await tab.value(LIT) == 0
        silent = m.ManagerStatus((), ("DM3",), (), (), "guarded-repair", 1, tuple(
            m.DetectionView(name, False, "", ()) for name in ("DM2", "DM3")))
        chips = "$$('#detections li').map((c) => c.textContent)"
        async with repeated(lambda: world.others.publish(topics.MANAGER_STATUS, silent)):
            await tab.until(f"{chips}.join() === 'DM2: idle,? DM3: silent'")

        area = "($('.sweep.lower .sweep-area').getAttribute('d') || '')"
        async with repeated(world.others.busy):
            await tab.until(f"{area}.split('L').length === 92")
            echoes = "$('.sweep.lower .sweep-echoes').getAttribute('d')"
            echo = (await tab.value(echoes)).removeprefix("M").removesuffix("h0").split()
            assert math.dist(map(float, echo), (3.0, 0.0)) < 0.05
            cells = ("$$('#nodes tr[data-node=hmi] td').map((c) => c.textContent)")
            await tab.until(f"$$('#nodes tr').length === "
                            f"{len(SPEC.actors())} && Number({cells}[6]) > 10")
            _, state, pid, _, restarts, cpu, _ = await tab.value(cells)
            assert (state, pid, restarts) == ("running", str(os.getpid()), "0")
            assert float(cpu) > 0
        await tab.until(f"{area} === ''")  # it vanishes when it is not heard

        def decide(number: int) -> None:
            world.others.publish(topics.DECISION, m.DecisionRecord(
                number, "safety-first", ("FTM1", "FTM4"), 2, ("RM1",),
                ("FTM1 > FTM2", "FTM2 > FTM4"), (("RM3", "FTM4 is dominated by FTM1"),), 1.0))

        decide(4)
        await tab.until("$$('#decisions details').length === 1")
        await tab.value("$('#decisions summary').click()")
        decide(5)
        await tab.until("$$('#decisions details').length === 2")
        opened = await tab.value("$('#decisions details[open]').textContent")
        for words in ("Certificate of decision 4", "FTM1 > FTM2", "RM3: FTM4 is dominated by FTM1"):
            assert words in opened


async def test_no_reset_is_offered_for_a_mechanism_that_never_clears(world, tab):
    spec = replace(SPEC, mechanisms=tuple(
        replace(x, clears=Clears.NEVER) if x.name == "FTM1" else x for x in SPEC.mechanisms))
    buttons = "$$('#resets button').length"
    async with page(world, tab, system=spec):
        async with repeated(lambda: world.others.manager("FTM1", latched=("RM1",))):
            await tab.until(f"{text('alarm-title')} === 'Emergency stop (RM1): latched.'")
            assert await tab.value(buttons) == 0
        async with repeated(lambda: world.others.manager("FTM2", latched=("RM1",))):
            await tab.until(f"{buttons} === 1 && {text('alarm-title')} === "
                            "'Emergency stop (RM1): latched until you reset it.'")


async def test_values_of_a_lost_connection_are_marked_as_old_and_the_next_shows_nothing_of_them(
        world, tab):
    port = free_port()
    old = "document.body.classList.contains('offline')"
    async with world.hmi(hmi_port=port, system=SPEC) as hmi:
        await show(tab, hmi)
        async with repeated(world.others.busy):
            await tab.until(f"{events('active')} === 'FTM4'")
            await tab.until("$$('#events .fault').length === 1")
            assert await tab.value(old) is False
            hmi._server._feed._pages.clear()  # as a cable that is pulled: nothing arrives
            await tab.until(old, 2.5)  # within two seconds, and half a one for this test itself
            assert "all values" in (await tab.value(text("cut"))).lower()
    world.others.manager()
    async with world.hmi(incarnation=2, hmi_port=port, system=SPEC):
        async with repeated(world.others.manager):
            await tab.until(f"{LIVE} && {events('active')} === '' && $('#alarm').hidden")
            assert await tab.value("$$('#events .fault').length") == 0
            assert await tab.value("$$('#tree .event').length") == len(
                SPEC.events)


async def test_the_faults_of_all_runs_are_listed_and_a_machine_that_is_late_is_a_banner(
        world, tab, tmp_path):
    panel, rows = "$('#history-panel')", "#history tr"
    history = History(tmp_path, "r0")
    late = m.NodeTable((m.NodeInfo("hmi", "non-control", 1, m.NodeState.RUNNING, 1, 0,
                                   late_s=5.0),))
    async with world.hmi(system=SPEC, black_box=str(tmp_path)) as hmi:
        await show(tab, hmi)
        assert await tab.value(f"{panel}.hidden") is True
        history.put([Fault(mechanism="DM7", node="localization", error="<b>gone</b>",
                           state="confirmed", times=3)], 1.8e9)
        await tab.until(f"!{panel}.hidden && $$('{rows}').length === 1")
        cells = f"$$('{rows} > *').map((cell) => cell.textContent)"
        shown = await tab.value(cells)
        assert shown[:4] + shown[5:] == ["DM7", "localization", "confirmed", "3", "<b>gone</b>"]
        async with repeated(lambda: world.others.publish(topics.NODES, late)):
            await tab.until("!$('#behind').hidden", 30)
        words = await tab.value(text("behind"))
        assert words.startswith("this machine keeps up with rate ")
    history.close()
