"""Logging in to the page in Chromium, over TLS, and what a role shows and takes away."""

from __future__ import annotations

from contextlib import asynccontextmanager

import pytest

from rampart.actors.ftm import messages as fm
from rampart.actors.web.visitors import Role, issue, revoke
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from rampart.testing import eventually, free_port
from tests.actors.operator.browser import Browser, browser
from tests.actors.operator.page import LIVE, SPEC, speaking_world
from tests.actors.operator.test_operating import TOKEN
from tests.actors.operator.world import repeated, served
from tests.actors.web.pems import pair

pytestmark = pytest.mark.page
ASKED = "document.getElementById('login').open"
TEXT = "document.getElementById('login-text').textContent"
WHY = "[...document.querySelectorAll('.why-barred')].filter((n) => !n.hidden && n.textContent)"


def notes(kind: str = "") -> str:
    return f"{WHY}.map((n) => n.textContent).filter((t) => t.includes('{kind}')).length"


async def enter(tab: Browser, token: str) -> None:
    """Type a token into the form, as a person does, and press Enter."""
    await tab.until(ASKED)
    await tab.value("document.getElementById('login-token').value = ''")
    await tab.call("Input.insertText", text=token)
    for kind in ("keyDown", "keyUp"):
        await tab.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter",
                       windowsVirtualKeyCode=13, text="\r")


@asynccontextmanager
async def encrypted(tmp_path, **fields):
    """An HMI over TLS on all addresses, in a world that speaks, and a tab."""
    certificate, key = pair(tmp_path)
    async with speaking_world() as world, browser() as tab:
        async with world.hmi(
                hmi_port=free_port(), hmi_host="0.0.0.0", hmi_cert=str(certificate),
                hmi_key=str(key), system=SPEC, launcher_pid=1, faults=OsmosisFaults().offered(),
                **fields) as hmi, repeated(world.others.busy, 0.05):
            await tab.call("Security.setIgnoreCertificateErrors", ignore=True)
            await tab.show(f"https://{await served(hmi)}/")
            yield world, hmi, tab


async def test_one_logs_in_stays_in_over_a_reload_and_logs_out(tmp_path):
    async with encrypted(tmp_path, hmi_token=TOKEN) as (_, _, tab):
        await tab.until(f"{ASKED} && {TEXT} === 'Log in with your token.'")
        await tab.screenshot(tmp_path / "login.png")
        await enter(tab, "wrong-wrong-wrong-wrong")
        await tab.until(f"{TEXT} === 'unknown token.'")
        await enter(tab, TOKEN)
        await tab.until(LIVE)
        assert await tab.value("document.cookie") == ""  # scripts do not see it
        assert await tab.value("JSON.stringify([{...localStorage}, {...sessionStorage}])"
                               f".includes('{TOKEN}')") is False
        assert await tab.value("document.getElementById('login-token').value") == ""
        assert await tab.value("document.getElementById('visitor').textContent") == (
            "operator · inject")
        assert await tab.value(notes()) == 0
        await tab.until("document.getElementById('credentials').textContent"
                        ".includes('days left')")  # the page's certificate expires first
        await tab.value("window.before = true")
        await tab.call("Page.reload")
        await tab.until(f"window.before === undefined && {LIVE}")
        await tab.value("document.getElementById('logout').click()")
        await tab.until(ASKED)
        await tab.call("Page.reload")
        await tab.until(f"document.readyState === 'complete' && {ASKED}")
        assert [url for url in tab.requests if TOKEN in url] == []
        assert [e for e in tab.errors if "403" not in e] == []  # Chromium logs the wrong token


async def test_the_page_comes_back_by_itself_when_its_node_does(tmp_path):
    certificate, key = pair(tmp_path)
    port = free_port()
    fields = {"hmi_port": port, "hmi_cert": str(certificate), "hmi_key": str(key),
              "hmi_token": TOKEN, "hmi_secret": "of the run", "system": SPEC}
    async with speaking_world() as world, browser() as tab:
        await tab.call("Security.setIgnoreCertificateErrors", ignore=True)
        async with world.hmi(**fields) as hmi:
            await tab.show(f"https://{await served(hmi)}/")
            await enter(tab, TOKEN)
            await tab.until(LIVE)
        await tab.until(f"!({LIVE})")
        async with world.hmi(2, **fields):
            await tab.until(LIVE)
            assert await tab.value(ASKED) is False


@pytest.mark.parametrize("role", Role)
async def test_what_a_role_lacks_is_out_of_use_and_says_why(tmp_path, role):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna", role)
    drives, injects = role.may(Role.DRIVE), role.may(Role.INJECT)
    async with encrypted(tmp_path, hmi_token_file=str(file)) as (world, _, tab):
        await enter(tab, token)
        await tab.until(LIVE)
        await tab.until("document.querySelectorAll('#resets button').length === 1")
        await tab.until("document.querySelectorAll('tr[data-node] button.signal').length > 0")
        await tab.until("document.querySelector('.stick-state').textContent !== 'not connected'")
        assert await tab.value("document.getElementById('visitor').textContent") == (
            f"anna · {role}")
        for part, may in (("#resets", drives), (".stick-row", drives), ("#inject", injects),
                          ("#strategy", injects), ("div:has(> #orders)", drives)):
            assert await tab.value(f"document.querySelector('{part}').inert") is not may, part
        assert await tab.value(notes("Needs the role drive")) == (0 if drives else 3)
        assert await tab.value(notes("Needs the role inject")) == (0 if injects else 3)
        seen = "getComputedStyle(document.querySelector('button.signal')).display !== 'none'"
        assert await tab.value(seen) is injects
        await tab.screenshot(tmp_path / f"{role}.png")

        await tab.value("document.querySelector('#resets button').click()")  # as a script would
        if drives:
            await eventually(lambda: world.others.resets == [fm.Reset("RM1", "hmi")])
        else:
            why = f"Needs the role drive; anna has the role {role}"
            await tab.until(f"document.getElementById('toast').textContent === '{why}'")
            assert world.others.resets == []
        await tab.value("document.querySelector('.stick').focus()")
        await tab.call("Input.dispatchKeyEvent", type="rawKeyDown", key="ArrowUp", code="ArrowUp")
        if drives:
            await eventually(lambda: any(s.dead_man for s in world.others.stick))
        await tab.call("Input.dispatchKeyEvent", type="keyUp", key="ArrowUp", code="ArrowUp")
        if not drives:
            assert not any(s.dead_man for s in world.others.stick)
            assert await tab.value("document.querySelector('.stick-state').textContent") == (
                "not permitted")
        assert tab.errors == []


async def test_on_a_phone_the_form_and_who_one_is_fit_the_screen(tmp_path):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna-of-the-control-room@airport.example", Role.LOOK)
    async with encrypted(tmp_path, hmi_token_file=str(file)) as (_, hmi, tab):
        await tab.show(f"https://{await served(hmi)}/", width=360, height=740)
        await tab.until(ASKED)
        assert await tab.value("document.documentElement.scrollWidth") == 360
        box = "document.getElementById('login').getBoundingClientRect()"
        assert await tab.value(f"{box}.left >= 0 && {box}.right <= 360") is True
        await enter(tab, token)
        await tab.until(f"{LIVE} && document.querySelectorAll('#resets button').length === 1")
        assert await tab.value("document.documentElement.scrollWidth") == 360
        await tab.screenshot(tmp_path / "phone.png")


async def test_a_withdrawn_token_brings_the_form_back_and_a_new_one_opens_again(tmp_path):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna", Role.LOOK)
    async with encrypted(tmp_path, hmi_token_file=str(file)) as (_, _, tab):
        await enter(tab, token)
        await tab.until(f"{LIVE} && document.getElementById('inject').inert")
        revoke(file, "anna")
        await tab.until(f"{ASKED} && {TEXT}.startsWith('Your token was revoked')")
        await enter(tab, issue(file, "anna", Role.INJECT))
        await tab.until(f"{LIVE} && !document.getElementById('inject').inert")
        assert await tab.value(notes()) == 0
