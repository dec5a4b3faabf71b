"""The operator's page on a real run: processes, Zenoh, Chromium."""

from __future__ import annotations

import asyncio
import json
import ssl
import subprocess
from pathlib import Path

import httpx
import pytest
from mcap.reader import make_reader
from websockets.sync.client import connect

from rampart.actors.supervision.process_title import find_processes
from rampart.actors.web.visitors import Role, issue
from rampart.testing import RealRun, free_base_port
from tests.actors.operator.browser import browser
from tests.actors.operator.page import text
from tests.actors.operator.test_page_operating import key
from tests.actors.web.pems import pair

pytestmark = [pytest.mark.processes, pytest.mark.alone]
TOKEN = "secret-of-the-hangar-7"


ROW = "document.querySelector('tr[data-node=localization]')"
STICK = "document.querySelector('.stick-state').textContent"
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


def short(tmp_path) -> str:
    """Write a mission of one goal, and return its file."""
    file = tmp_path / "SHORT.miss"
    file.write_text("x=-27,y=-8,taxi=1\n")
    return str(file)


async def kill(tab, node: str) -> None:
    await tab.value(f"document.querySelector('tr[data-node={node}] button').click();"
                    "[...document.querySelectorAll('#signals button')]"
                    ".find((b) => b.textContent === 'KILL').click();"
                    "document.getElementById('signal-confirm').click()")


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


def answers(port: int, trusting: ssl.SSLContext) -> bool:
    try:
        return httpx.get(f"https://127.0.0.1:{port}/", verify=trusting).status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.slow
def test_what_visitors_do_over_tls_is_in_the_report_though_the_node_of_the_page_is_killed(tmp_path):
    port, tokens = free_base_port(), tmp_path / "page.tokens"
    certificate, key = pair(tmp_path)
    anna, bob = issue(tokens, "anna", Role.INJECT), issue(tokens, "bob", Role.LOOK)
    trusting = ssl.create_default_context(cafile=str(certificate))
    with RealRun(tmp_path, "paper", "--mission", short(tmp_path), "--hmi-port", str(port),
                 *ELSEWHERE, "--hmi-cert", str(certificate), "--hmi-key", str(key),
                 "--hmi-token-file", str(tokens), hmi=True) as run:
        run.sleep_until(2.0)
        told: list[str] = []

        def ask(token: str, **wish: object) -> None:
            with httpx.Client(verify=trusting, base_url=f"https://127.0.0.1:{port}") as client:
                assert client.post("/login", json={"token": token}).status_code == 200
                cookie = "; ".join(f"{k}={v}" for k, v in client.cookies.items())
            with connect(f"wss://127.0.0.1:{port}/ws", ssl=trusting,
                         additional_headers={"Cookie": cookie}) as page:
                page.send(json.dumps(wish))
                while (message := json.loads(page.recv(10)))["type"] not in ("done", "error"):
                    pass
                told.append(message["type"])

        ask(bob, type="signal", node="localization", signal="KILL")
        ask(anna, type="signal", node="localization", signal="KILL")
        before = run.pid("hmi")
        run.kill("hmi")
        run.wait_until(lambda: run.pid("hmi") not in (None, before), 20, "no other HMI")
        run.wait_until(lambda: answers(port, trusting), 10, "the page did not come back")
        ask(anna, type="strategy", name="mission-first")
        code, result = run.result()
    assert (code, told) == (0, ["error", "done", "done"])
    record = json.loads(Path(result["record"]).read_text())
    page = Path(result["report"]).read_text()
    kept = [(line["who"], line["what"], line["outcome"]) for line in record["audit"]]
    assert [line for line in kept if line[1] in ("signal", "strategy")] == [
        ("bob", "signal", "refused"), ("anna", "signal", "accepted"),
        ("anna", "strategy", "accepted")]
    assert kept.count(("anna", "log in", "accepted")) == 2
    assert all(line["utc"] and line["address"] == "127.0.0.1" for line in record["audit"])
    assert "On the operator&#39;s page" in page or "On the operator's page" in page
    assert "Needs the role inject; bob has the role look" in page
    (log,) = Path(result["report"]).parent.glob("audit-*.jsonl")
    assert len(log.read_text().splitlines()) == len(record["audit"])
    for file in tmp_path.rglob("*"):
        content = file.read_bytes() if file.is_file() else b""
        assert anna.encode() not in content
        assert bob.encode() not in content


def test_the_operators_own_token_opens_the_page_and_turns_up_nowhere(tmp_path, monkeypatch):
    monkeypatch.setenv("RAMPART_HMI_TOKEN", TOKEN)
    port, bag = free_base_port(), tmp_path / "run.mcap"
    with RealRun(tmp_path, "paper", "--mission", short(tmp_path), "--rate", "4", "--hmi-port",
                 str(port), "--record", str(bag), hmi=True) as run:
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
    assert f"http://127.0.0.1:{port}/ asks for your token" in run.story
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
