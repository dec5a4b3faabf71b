"""Logging in to the page in Chromium, over TLS, and what a role shows and takes away."""

from __future__ import annotations

from contextlib import asynccontextmanager

import pytest

from rampart.actors.ftm import messages as fm
from rampart.actors.web.visitors import Role, issue, revoke
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from rampart.testing import eventually
from tests.actors.operator.browser import Browser, browser
from tests.actors.operator.page import LIVE
from tests.actors.operator.world import SPEC, repeated, served
from tests.actors.web.pems import pair

pytestmark = pytest.mark.page
ASKED = "$('#login').open"
TEXT = "$('#login-text').textContent"
WHY = "$$('.why-barred').filter((n) => !n.hidden && n.textContent)"


def notes(kind: str = "") -> str:
    return f"{WHY}.map((n) => n.textContent).filter((t) => t.includes('{kind}')).length"


async def enter(tab: Browser, token: str) -> None:
    """Type a token into the form, as a person does, and press Enter."""
    await tab.until(ASKED)
    await tab.value("$('#login-token').value = ''")
    await tab.call("Input.insertText", text=token)
    for kind in ("keyDown", "keyUp"):
        await tab.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter",
                       windowsVirtualKeyCode=13, text="\r")


@pytest.fixture
def encrypted(world, tmp_path):
    """Return what shows the page of an HMI over TLS, in a world that speaks, in a tab."""
    certificate, key = pair(tmp_path)

    @asynccontextmanager
    async def shown(**fields):
        async with world.hmi(
                hmi_host="0.0.0.0", hmi_cert=str(certificate), hmi_key=str(key), system=SPEC,
                launcher_pid=1, faults=OsmosisFaults().offered(), **fields) as hmi, repeated(
                world.others.busy, 0.05):
            async with browser() as tab:
                await tab.call("Security.setIgnoreCertificateErrors", ignore=True)
                await tab.show(f"https://{await served(hmi)}/")
                yield hmi, tab
                assert tab.errors == []
            await eventually(lambda: not hmi._server._server._state.connections)

    return shown


async def test_one_logs_in_on_a_phone_stays_in_over_a_reload_until_revoked_and_logs_out(
        encrypted, tmp_path):
    file = tmp_path / "page.tokens"
    who = "anna-of-the-control-room@airport.example"
    token = issue(file, who, Role.LOOK)
    async with encrypted(hmi_token_file=str(file)) as (hmi, tab):
        await tab.show(f"https://{await served(hmi)}/", width=360, height=740)
        await tab.until(f"{ASKED} && {TEXT} === 'Log in with your token.'")
        assert await tab.value("document.documentElement.scrollWidth") == 360
        box = "$('#login').getBoundingClientRect()"
        assert await tab.value(f"{box}.left >= 0 && {box}.right <= 360") is True
        await enter(tab, "wrong-wrong-wrong-wrong")
        await tab.until(f"{TEXT} === 'unknown token.'")
        await enter(tab, token)
        await tab.until(f"{LIVE} && $$('#resets button').length === 1")
        assert await tab.value("document.documentElement.scrollWidth") == 360
        assert await tab.value("document.cookie") == ""  # scripts do not see it
        assert await tab.value("JSON.stringify([{...localStorage}, {...sessionStorage}])"
                               f".includes('{token}')") is False
        assert await tab.value("$('#login-token').value") == ""
        assert await tab.value("$('#visitor').textContent") == f"{who} · look"
        await tab.until("$('#credentials').textContent"
                        ".includes('days left')")  # the page's certificate expires first
        await tab.value("window.before = true")
        await tab.call("Page.reload")
        await tab.until(f"window.before === undefined && {LIVE} && $('#inject').inert")
        revoke(file, who)
        await tab.until(f"{ASKED} && {TEXT}.startsWith('Your token was revoked')")
        await enter(tab, issue(file, who, Role.INJECT))
        await tab.until(f"{LIVE} && !$('#inject').inert")
        assert await tab.value(notes()) == 0
        await tab.value("$('#logout').click()")
        await tab.until(ASKED)
        await tab.call("Page.reload")
        await tab.until(f"document.readyState === 'complete' && {ASKED}")
        assert [url for url in tab.requests if token in url] == []
        tab.errors[:] = [e for e in tab.errors if "403" not in e]  # it logs the wrong token


@pytest.mark.parametrize("role", Role)
async def test_what_a_role_lacks_is_out_of_use_and_says_why(world, encrypted, tmp_path, role):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna", role)
    drives, injects = role.may(Role.DRIVE), role.may(Role.INJECT)
    async with encrypted(hmi_token_file=str(file)) as (_, tab):
        await enter(tab, token)
        await tab.until(LIVE)
        await tab.until("$$('#resets button').length === 1")
        await tab.until("$$('tr[data-node] button.signal').length > 0")
        await tab.until("$('.stick-state').textContent !== 'not connected'")
        assert await tab.value("$('#visitor').textContent") == (f"anna · {role}")
        for part, may in (("#resets", drives), (".stick-row", drives), ("#inject", injects),
                          ("#strategy", injects), ("div:has(> #orders)", drives)):
            assert await tab.value(f"$('{part}').inert") is not may, part
        assert await tab.value(notes("Needs the role drive")) == (0 if drives else 3)
        assert await tab.value(notes("Needs the role inject")) == (0 if injects else 3)
        seen = "getComputedStyle($('button.signal')).display !== 'none'"
        assert await tab.value(seen) is injects
        await tab.value("$('#resets button').click()")  # as a script would
        await tab.value("$('.stick').focus()")
        await tab.call("Input.dispatchKeyEvent", type="rawKeyDown", key="ArrowUp", code="ArrowUp")
        if drives:
            await eventually(lambda: world.others.resets == [fm.Reset("RM1", "hmi")])
            await eventually(lambda: any(s.dead_man for s in world.others.stick))
        else:
            why = f"Needs the role drive; anna has the role {role}"
            await tab.until(f"$('#toast').textContent === '{why}'")
            assert world.others.resets == []
            assert not any(s.dead_man for s in world.others.stick)
            assert await tab.value("$('.stick-state').textContent") == ("not permitted")
        await tab.call("Input.dispatchKeyEvent", type="keyUp", key="ArrowUp", code="ArrowUp")
