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
from tests.actors.operator.page import LIVE, events, page, show
from tests.actors.operator.world import SPEC, repeated

pytestmark = pytest.mark.page


async def test_the_fault_tree_is_lit_when_a_detection_comes_and_dark_when_it_goes(world, tab):
    async with page(world, tab):
        assert await tab.value("document.querySelectorAll('#tree .event').length") == len(
            SPEC.events)
        assert await tab.value("document.querySelectorAll('#tree .barrier').length") == len(
            SPEC.mechanisms)
        async with repeated(lambda: world.others.manager("FTM4", activated=("RM3",))):
            await tab.until(f"{events('active')} === 'FTM4'")
            assert await tab.value(events("ahead")) == "FTM2"
            assert await tab.value("document.querySelectorAll('#tree .line.lit').length") == 1
            words = await tab.value("document.getElementById('tree-words').textContent")
            assert words == ("Detected: FTM4, Control node crash: detected · RM3 runs "
                             "(DM4: a test).")
            running = "[...document.querySelectorAll('#order .running text')][0].textContent"
            assert await tab.value(running) == "RM3"
        async with repeated(world.others.manager):
            await tab.until(f"{events('active')} === ''")
            assert await tab.value("document.querySelectorAll('#tree .line.lit').length") == 0
            assert await tab.value("document.querySelectorAll('#order .running').length") == 0


async def test_no_reset_is_offered_for_a_mechanism_that_never_clears(world, tab):
    spec = replace(SPEC, mechanisms=tuple(
        replace(x, clears=Clears.NEVER) if x.name == "FTM1" else x for x in SPEC.mechanisms))
    buttons = "document.querySelectorAll('#resets button').length"
    title = "document.getElementById('alarm-title').textContent"
    async with page(world, tab, system=spec):
        async with repeated(lambda: world.others.manager("FTM1", latched=("RM1",))):
            await tab.until(f"{title} === 'Emergency stop (RM1): latched.'")
            assert await tab.value(buttons) == 0
        async with repeated(lambda: world.others.manager("FTM2", latched=("RM1",))):
            await tab.until(f"{buttons} === 1")
            assert await tab.value(title) == "Emergency stop (RM1): latched until you reset it."


async def test_the_laser_is_drawn_in_the_robots_frame_and_vanishes_when_it_is_not_heard(world, tab):
    area = "(document.querySelector('.sweep.lower .sweep-area').getAttribute('d') || '')"
    echoes = "(document.querySelector('.sweep.lower .sweep-echoes').getAttribute('d') || '')"
    async with page(world, tab):
        async with repeated(world.others.sweep):
            await tab.until(f"{area}.split('L').length === 92")
            echo = (await tab.value(echoes)).removeprefix("M").removesuffix("h0").split()
            assert math.dist(map(float, echo), (3.0, 0.0)) < 0.05
            parent = "document.querySelector('.sweep.lower').parentElement.classList.contains"
            assert await tab.value(f"{parent}('robot')") is True
        await tab.until(f"{area} === ''")


async def test_a_page_that_reconnects_shows_the_whole_new_picture_and_nothing_of_the_old(
        world, tab):
    port = free_port()
    async with world.hmi(hmi_port=port, system=SPEC) as hmi:
        await show(tab, hmi)
        async with repeated(world.others.busy):
            await tab.until(f"{events('active')} === 'FTM4'")
            await tab.until("document.querySelectorAll('#events .fault').length === 1")
    await tab.until("document.body.classList.contains('offline')")
    world.others.manager()
    async with world.hmi(incarnation=2, hmi_port=port, system=SPEC):
        async with repeated(world.others.manager):
            await tab.until(f"{LIVE} && {events('active')} === ''"
                            " && document.getElementById('alarm').hidden")
            assert await tab.value("document.querySelectorAll('#events .fault').length") == 0
            assert await tab.value("document.querySelectorAll('#tree .event').length") == len(
                SPEC.events)


async def test_every_process_has_its_state_age_processor_share_and_memory(world, tab):
    cells = "[...document.querySelectorAll('#nodes tr[data-node=hmi] td')].map(" \
            "(c) => c.textContent)"
    async with page(world, tab), repeated(world.others.busy):
        await tab.until(f"document.querySelectorAll('#nodes tr').length === {len(SPEC.actors())}")
        await tab.until(f"Number({cells}[6]) > 10")
        _, state, pid, age, restarts, cpu, _ = await tab.value(cells)
        assert (state, pid, restarts) == ("running", str(os.getpid()), "0")
        assert age.endswith((" s", " min"))
        assert float(cpu) > 0


async def test_a_certificate_can_be_opened_and_stays_open_when_decisions_follow(world, tab):
    def decide(number: int) -> None:
        world.others.publish(topics.DECISION, m.DecisionRecord(
            number, "safety-first", ("FTM1", "FTM4"), 2, ("RM1",), ("FTM1 > FTM2", "FTM2 > FTM4"),
            (("RM3", "FTM4 is dominated by FTM1"),), 1.0))

    async with page(world, tab):
        decide(4)
        await tab.until("document.querySelectorAll('#decisions details').length === 1")
        await tab.value("document.querySelector('#decisions summary').click()")
        decide(5)
        await tab.until("document.querySelectorAll('#decisions details').length === 2")
        opened = "document.querySelector('#decisions details[open]').textContent"
        text = await tab.value(opened)
        assert "Certificate of decision 4" in text
        assert "FTM1 > FTM2" in text
        assert "RM3: FTM4 is dominated by FTM1" in text


async def test_values_of_a_connection_that_is_cut_are_marked_as_old_within_two_seconds(world, tab):
    async with page(world, tab) as hmi, repeated(world.others.busy):
        await tab.until(f"{events('active')} === 'FTM4'")
        old = "document.body.classList.contains('offline')"
        assert await tab.value(old) is False
        hmi._server._feed._pages.clear()  # as a cable that is pulled: nothing arrives
        await tab.until(old, 2.5)  # with half a second for this test itself
        assert "all values" in (await tab.value(
            "document.getElementById('cut').textContent")).lower()


async def test_a_module_that_is_not_heard_is_shown_apart_from_one_that_is_idle(world, tab):
    chips = "[...document.querySelectorAll('#detections li')].map((c) => c.textContent)"
    status = m.ManagerStatus((), ("DM3",), (), (), "guarded-repair", 1, tuple(
        m.DetectionView(name, False, "", ()) for name in ("DM2", "DM3")))
    async with page(world, tab):
        assert "no message yet" in await tab.value("document.getElementById('manager').textContent")
        async with repeated(lambda: world.others.publish(topics.MANAGER_STATUS, status)):
            await tab.until(f"{chips}.join() === 'DM2: idle,? DM3: silent'")


async def test_a_machine_that_does_not_keep_up_with_the_rate_is_a_banner(world, tab):
    late = m.NodeTable((m.NodeInfo("hmi", "non-control", 1, m.NodeState.RUNNING, 1, 0,
                                   late_s=5.0),))
    async with page(world, tab):
        async with repeated(lambda: world.others.publish(topics.NODES, late)):
            await tab.until("!document.getElementById('behind').hidden", 30)
        words = await tab.value("document.getElementById('behind').textContent")
        assert words.startswith("this machine keeps up with rate ")


async def test_the_faults_of_all_runs_are_listed_with_their_states(world, tab, tmp_path):
    panel, rows = "document.getElementById('history-panel')", "#history tr"
    history = History(tmp_path, "r0")
    async with world.hmi(system=SPEC, black_box=str(tmp_path)) as hmi:
        await show(tab, hmi)
        assert await tab.value(f"{panel}.hidden") is True
        history.put([Fault(mechanism="DM7", node="localization", error="<b>gone</b>",
                           state="confirmed", times=3)], 1.8e9)
        await tab.until(f"document.querySelectorAll('{rows}').length === 1")
        assert await tab.value(f"{panel}.hidden") is False
        cells = f"[...document.querySelectorAll('{rows} > *')].map((cell) => cell.textContent)"
        shown = await tab.value(cells)
        assert shown[:4] + shown[5:] == ["DM7", "localization", "confirmed", "3", "<b>gone</b>"]
        history.put([Fault(mechanism="DM6", node="", error="late", state="healed", times=1)], 1.9e9)
        await tab.until(f"document.querySelectorAll('{rows}').length === 2")
        assert await tab.value(f"document.querySelector('{rows} th').textContent") == "DM6"
    history.close()
