"""The operator's page on a real run: processes, Zenoh, Chromium."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
from html import unescape
from pathlib import Path

import httpx
import pytest
from mcap.reader import make_reader
from websockets.sync.client import connect

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun, free_base_port
from tests.actors.operator.browser import browser
from tests.actors.operator.test_page_operating import key
from tests.actors.operator.world import text
from tests.actors.web.pems import pair

pytestmark = [pytest.mark.processes, pytest.mark.alone]
TOKEN = "secret-of-the-hangar-7"


ROW = "$('tr[data-node=localization]')"
STICK = "$('.stick-state').textContent"
STATE = f"(({ROW}) || document.createElement('p')).textContent"


@pytest.mark.slow
@pytest.mark.page
async def test_a_mission_is_started_from_the_page_disturbed_from_it_and_followed_to_its_report(
        tmp_path):
    port = free_base_port()
    with RealRun(tmp_path, "paper", "--mission", short(tmp_path), "--rate", "1", "--hmi-port",
                 str(port), "--wait", hmi=True) as run:
        await asyncio.to_thread(run.sleep_until, 1.0)
        async with browser() as tab:
            await tab.show(f"http://127.0.0.1:{port}/")
            await tab.until(f"{STICK} === 'free'", 60)
            run.wait_for(f"Operator's page: http://127.0.0.1:{port}/")
            assert await tab.value(f"{text('mission-phase')}") == "idle"
            await tab.until("$('#mission-name').value === 'SHORT'")
            await tab.value("$('#start').requestSubmit()")
            await tab.until(f"{text('mission-phase')} === 'running'")

            await tab.value("$('.stick').focus()")
            await key(tab, "ArrowUp", down=True)
            await tab.until(f"{text('pilot-reason')}.includes('the joystick pre-empts')")
            await key(tab, "ArrowUp", down=False)
            await tab.until(f"!{text('pilot-reason')}.includes('the joystick pre-empts')")

            before = run.pid("localization")
            await kill(tab, "localization")
            await tab.until(f"{text('events')}.includes('localization respawned by RM4')")
            assert run.pid("localization") not in (None, before)
            await tab.until(f"{STATE}.includes('running')")

            await tab.value("$('#fault').value = 'duplicate:';"
                            "$('#fault-topic').value = 'detection/DM1';"
                            "$('#fault-duration').value = '1';$('#inject').requestSubmit()")
            await tab.until(f"/duplicate:detection.DM1: over, \\d+ messages changed/.test("
                            f"{text('faults')})")

            await tab.value("$('#strategy-name').value = 'mission-first';"
                            "$('#strategy-set').click()")
            await tab.until(f"{text('strategy-now')} === 'in force: mission-first'")

            before = run.pid("hmi")
            await kill(tab, "hmi")  # the page's own
            await asyncio.to_thread(
                run.wait_until, lambda: run.pid("hmi") not in (None, before), 20, "no other HMI")
            await tab.until(f"{text('link')} === 'live' && {STICK} === 'free'")
            assert await tab.value(text("strategy-now")) == "in force: mission-first"
            await tab.until(f"{text('mission-phase')} === 'succeeded'", 120)
        code, result = await asyncio.to_thread(run.result)
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe")
    assert result["restarts"].keys() >= {"localization", "hmi"}
    assert Path(result["report"]).is_file()


def short(tmp_path) -> str:
    """Write a mission of one goal, and return its file."""
    file = tmp_path / "SHORT.miss"
    file.write_text("x=-27,y=-8,taxi=1\n")
    return str(file)


async def kill(tab, node: str) -> None:
    await tab.value(f"$('tr[data-node={node}] button').click();$$('#signals button')"
                    ".find((b) => b.textContent === 'KILL').click();$('#signal-confirm').click()")


ELSEWHERE = ["--hmi-host", "0.0.0.0"]


def test_a_page_for_the_network_prints_its_new_token_once_and_tools_are_not_told_it(tmp_path):
    port = free_base_port()
    certificate, key = pair(tmp_path)
    with RealRun(tmp_path, "paper", "--mission", "A", "--hmi-port", str(port), *ELSEWHERE,
                 "--hmi-cert", str(certificate), "--hmi-key", str(key), hmi=True) as run:
        run.wait_for("asks for the token")
        line = next(line for line in run.story.splitlines() if "asks for the token" in line)
        assert f"https://robot.local:{port}/ asks for the token " in line
        assert run.info.page == f"https://robot.local:{port}/"
        token = line.split()[-1]
        assert len(token) == 22
        titles = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True)
        assert token not in titles.stdout
        assert run.story.count(token) == 1


def test_the_operators_own_token_opens_the_page_and_turns_up_nowhere(tmp_path, monkeypatch):
    monkeypatch.setenv("RAMPART_HMI_TOKEN", TOKEN)
    port, bag = free_base_port(), tmp_path / "run.mcap"
    with RealRun(tmp_path, "paper", "--mission", short(tmp_path), "--rate", "2", "--hmi-port",
                 str(port), "--record", str(bag), hmi=True) as run:
        run.wait_for(f"http://127.0.0.1:{port}/ asks for your token")
        said = run.tool("status").stdout + run.tool("status", "--json").stdout
        assert f"http://127.0.0.1:{port}/" in said
        assert TOKEN not in said
        at = f"http://127.0.0.1:{port}/nothing"
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        assert [httpx.get(at, headers=h).status_code for h in ({}, bearer)] == [401, 404]
        with connect(f"ws://127.0.0.1:{port}/ws", additional_headers=bearer) as page:
            page.send('{"type": "signal", "node": "localization", "signal": "KILL"}')
            while json.loads(page.recv(10))["type"] != "done":
                pass
        run.kill("hmi")  # its traceback, its successor
        for pid in (process.pid for process in find_processes(run.port)):
            with contextlib.suppress(ProcessLookupError, FileNotFoundError):  # it has just ended
                for told in ("cmdline", "environ"):
                    assert TOKEN.encode() not in Path(f"/proc/{pid}/{told}").read_bytes()
        assert TOKEN.encode() not in Path(f"/proc/{run.process.pid}/cmdline").read_bytes()
        code, result = run.result()
    assert code == 0
    record = json.loads(Path(result["record"]).read_text())
    assert [(line["who"], line["what"], line["outcome"], line["address"])
            for line in record["audit"] if line["what"] == "signal"] == [
        ("operator", "signal", "accepted", "127.0.0.1")], "though the page's node was killed"
    assert "On the operator's page" in unescape(Path(result["report"]).read_text())
    with bag.open("rb") as recorded:
        reader = make_reader(recorded)
        parts = [*(message.data for _, _, message in reader.iter_messages()),
                 *(attached.data for attached in reader.iter_attachments()),
                 *(str(kept.metadata).encode() for kept in reader.iter_metadata())]
    assert len(parts) > 100
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert len(files) > 4
    assert [part for part in (*parts, *(file.read_bytes() for file in files))
            if TOKEN.encode() in part] == []
