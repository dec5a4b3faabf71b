"""The operator's page on a real run: processes, Zenoh, Chromium."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from mcap.reader import make_reader

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun, free_base_port
from tests import ROOT
from tests.actors.operator.browser import browser

pytestmark = pytest.mark.processes
TOKEN = "secret-of-the-hangar-7"


def text(name: str) -> str:
    return f"document.getElementById('{name}').textContent"


ROW = "document.querySelector('tr[data-node=localization]')"
STICK = "document.querySelector('.stick-state').textContent"
STATE = f"(({ROW}) || document.createElement('p')).textContent"


@pytest.mark.page
async def test_a_mission_is_started_from_the_page_disturbed_from_it_and_followed_to_its_report(
        tmp_path):
    port = free_base_port()
    short = tmp_path / "SHORT.miss"
    short.write_text("x=-27,y=-8,taxi=1\n")
    with RealRun(tmp_path, "paper", "--mission", str(short), "--rate", "1", "--hmi-port", str(port),
                 "--wait", hmi=True) as run:
        await asyncio.to_thread(run.sleep_until, 1.0)
        async with browser() as tab:
            await tab.show(f"http://127.0.0.1:{port}/")
            await tab.until(f"{STICK} === 'free'", 60)
            assert await tab.value(f"{text('mission-phase')}") == "idle"
            await tab.until("document.getElementById('mission-name').value === 'SHORT'")
            await tab.value("document.getElementById('start').requestSubmit()")
            await tab.until(f"{text('mission-phase')} === 'running'")

            await tab.value("document.querySelector('.stick').focus()")
            await key(tab, "ArrowUp", down=True)
            await tab.until(f"{text('pilot-reason')}.includes('the joystick pre-empts')")
            await key(tab, "ArrowUp", down=False)
            await tab.until(f"!{text('pilot-reason')}.includes('the joystick pre-empts')")

            before = run.pid("localization")
            await kill(tab, "localization")
            await tab.until(f"{text('events')}.includes('localization respawned by RM4')")
            assert run.pid("localization") not in (None, before)
            await tab.until(f"{STATE}.includes('running')")

            await tab.value("document.getElementById('fault').value = 'duplicate:';"
                            "document.getElementById('fault-topic').value = 'detection/DM1';"
                            "document.getElementById('fault-duration').value = '1';"
                            "document.getElementById('inject').requestSubmit()")
            await tab.until(f"/duplicate:detection.DM1: over, \\d+ messages changed/.test("
                            f"{text('faults')})")

            await tab.value("document.getElementById('strategy-name').value = 'mission-first';"
                            "document.getElementById('strategy-set').click()")
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


async def kill(tab, node: str) -> None:
    await tab.value(f"document.querySelector('tr[data-node={node}] button').click();"
                    "[...document.querySelectorAll('#signals button')]"
                    ".find((b) => b.textContent === 'KILL').click();"
                    "document.getElementById('signal-confirm').click()")


async def key(tab, name: str, *, down: bool) -> None:
    await tab.call("Input.dispatchKeyEvent", type="rawKeyDown" if down else "keyUp", key=name,
                   code=name)


@pytest.mark.parametrize(("arguments", "words"), [
    (["--hmi-host", "192.0.2.1"], "--hmi-host 192.0.2.1: no address of this machine"),
    (["--hmi-host", "no such host"], "--hmi-host no such host: no address of this machine"),
])
def test_an_address_that_cannot_be_served_is_one_clear_line(tmp_path, arguments, words):
    done = subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), "--report", str(tmp_path), *arguments],
        check=False, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_page_for_the_network_prints_its_new_token_once_and_tools_are_not_told_it(tmp_path):
    port = free_base_port()
    with RealRun(tmp_path, "paper", "--mission", "A", "--hmi-port", str(port),
                 "--hmi-host", "0.0.0.0", hmi=True) as run:
        run.wait_for("#token=")
        address = next(w for w in run.story.split() if "#token=" in w)
        assert address.startswith(f"http://127.0.0.1:{port}/#token=")
        assert run.info.page == f"http://127.0.0.1:{port}/"
        token = address.partition("#token=")[2]
        titles = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True)
        assert token not in titles.stdout
        assert run.story.count(token) == 1


def test_the_operators_own_token_opens_the_page_and_turns_up_nowhere(tmp_path, monkeypatch):
    monkeypatch.setenv("RAMPART_HMI_TOKEN", TOKEN)
    port, bag = free_base_port(), tmp_path / "run.mcap"
    short = tmp_path / "SHORT.miss"
    short.write_text("x=-27,y=-8,taxi=1\n")
    with RealRun(tmp_path, "paper", "--mission", str(short), "--rate", "4", "--hmi-port", str(port),
                 "--record", str(bag), hmi=True) as run:
        run.sleep_until(2.0)
        at = f"http://127.0.0.1:{port}/nothing"
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        assert [httpx.get(at, headers=h).status_code for h in ({}, bearer)] == [401, 404]
        run.kill("hmi")  # its traceback, its successor
        pids = [run.process.pid, *(process.pid for process in find_processes(run.port))]
        for pid in pids:
            assert TOKEN.encode() not in Path(f"/proc/{pid}/cmdline").read_bytes()
        inherited = [pid for pid in pids[1:]
                     if TOKEN.encode() in Path(f"/proc/{pid}/environ").read_bytes()]
        assert inherited == []
        said = run.tool("status").stdout + run.tool("status", "--json").stdout
        assert f"http://127.0.0.1:{port}/" in said
        assert TOKEN not in said
        code, _ = run.result()
    assert code == 0
    assert f"http://127.0.0.1:{port}/ (open it with #token= and your token behind)" in run.story
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
