"""Who may use the page: tokens, cookies, roles, strangers, and what is kept of it all."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from contextlib import asynccontextmanager

import httpx
import msgspec
import pytest
import websockets

from rampart.actors.ftm import messages as fm
from rampart.actors.operator.requests import Request
from rampart.actors.web import server as web_server
from rampart.actors.web.audit import read_audit
from rampart.actors.web.door import user_of_peer
from rampart.actors.web.visitors import Role, issue, revoke
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from rampart.testing import eventually, free_port
from tests.actors.operator.browser import Browser, browser
from tests.actors.operator.test_operating import RELEASED, Hand
from tests.actors.operator.world import LIVE, TOKEN, ask, hear, open_page, repeated, served, visited
from tests.actors.web.pems import pair
from tests.osmosis_system import shipped_system
from tests.other_user import as_nobody, needs_root


async def log_in(client: httpx.AsyncClient, token: object, **headers: str) -> httpx.Response:
    return await client.post("/login", json={"token": token}, headers=headers)


async def turned_away(page) -> str:
    """Wait until a page is closed for want of a token, and return the reason."""
    with pytest.raises(websockets.ConnectionClosedError) as closed:
        await hear(page, "never")
    assert closed.value.rcvd.code == 4401
    return closed.value.rcvd.reason


def cookie_of(client: httpx.AsyncClient) -> dict[str, str]:
    return {"Cookie": "; ".join(f"{name}={value}" for name, value in client.cookies.items())}


@pytest.mark.usefixtures("patient")
async def test_who_logs_in_gets_a_cookie_drives_and_logs_out_and_all_others_see_only_files(world):
    async with world.hmi(hmi_token=TOKEN) as hmi:
        at = await served(hmi)
        for token, path in (("", "/ws"), ("wrong", "/ws"), ("", f"/ws?token={TOKEN}")):
            async with open_page(at, token, path, subprotocols=["rampart", f"token.{TOKEN}"]
                                 ) as page:
                assert await turned_away(page) == "log in with your token"
        with pytest.raises(websockets.InvalidStatus, match="403"):
            await open_page(at, TOKEN, origin="http://evil.example")
        async with httpx.AsyncClient(base_url=f"http://{at}") as client:
            for path in ("/", "/app.js"):
                assert (await client.get(path)).status_code == 200
                assert (await client.get(path, headers={"host": "evil.example"})).status_code == 400
            for path in ("/other", f"/other?token={TOKEN}", "/logout", "/ws"):
                refused = await client.get(path)
                assert refused.status_code == 401
                assert "Authorization: Bearer TOKEN" in refused.text
            by_header = {"Authorization": f"Bearer {TOKEN}"}
            assert (await client.get("/other", headers=by_header)).status_code == 404
            answer = await log_in(client, TOKEN)
            assert (answer.status_code, answer.json()) == (
                200, {"name": "operator", "role": "inject"})
            set_cookie = answer.headers["set-cookie"]
            assert "HttpOnly; SameSite=Strict" in set_cookie
            assert "Secure" not in set_cookie  # plain HTTP: it would never be sent
            assert TOKEN not in set_cookie
            assert (await client.get("/other")).status_code == 404
            assert set(world.others.stick) <= {RELEASED}
            async with open_page(at, additional_headers=cookie_of(client)) as page:
                told = await hear(page, "visitor")
                assert (told["name"], told["role"], told["barred"]) == ("operator", "inject", {})
                await Hand(page).take()
            assert (await client.post("/logout")).status_code == 204
            assert (await client.get("/other")).status_code == 401


async def test_the_next_incarnation_knows_a_visitor_and_another_run_does_not(world):
    port = free_port()
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}") as client:
        for incarnation, secret, status in ((1, "of the run", 401), (2, "of the run", 404),
                                            (3, "of another", 401)):
            async with world.hmi(incarnation, hmi_port=port, hmi_token=TOKEN, hmi_secret=secret
                                 ) as hmi:
                await served(hmi)
                assert (await client.get("/other")).status_code == status
                if incarnation == 1:
                    await log_in(client, TOKEN)


async def test_what_is_no_login_is_refused(world, tmp_path):
    log = tmp_path / "audit.jsonl"
    async with world.hmi(hmi_token=TOKEN, hmi_audit_log=str(log)) as hmi:
        async with httpx.AsyncClient(base_url=f"http://{await served(hmi)}") as client:
            for body in (b"", b"{", b'{"token": 3}', b'{"token": "a", "more": 1}', b"[]",
                         b'{"token": "' + b"x" * 2000 + b'"}', TOKEN.encode()):
                assert (await client.post("/login", content=body)).status_code == 400
            evil = await log_in(client, TOKEN, Origin="http://evil.example")
            assert evil.status_code == 403
            assert "set-cookie" not in evil.headers
            assert (await client.get("/login")).status_code == 405
            answer = await log_in(client, "wrong-token-0000000001")
            assert (answer.status_code, answer.text) == (403, "unknown token")
            assert client.cookies == {}
    assert {(line.what, line.who, line.address, line.outcome) for line in read_audit(log)} == {
        ("log in", "", "127.0.0.1", "refused")}
    assert "wrong-token" not in log.read_text()
    assert TOKEN not in log.read_text()


# ---- several visitors ---------------------------------------------------------------------------


async def test_a_changed_role_has_its_pages_come_again_and_a_lost_file_closes_all(world, tmp_path):
    file = tmp_path / "page.tokens"
    anna, bob = issue(file, "anna", Role.DRIVE), issue(file, "bob", Role.LOOK)
    async with world.hmi(hmi_token_file=str(file)) as hmi:
        at = await served(hmi)
        async with open_page(at, anna) as page, open_page(at, bob) as other:
            file.write_text(file.read_text().replace("anna drive", "anna inject"))
            assert await turned_away(page) == "your token was revoked, or your role has changed"
            async with open_page(at, anna) as again:
                assert (await hear(again, "visitor"))["role"] == "inject"
            assert (await hear(other, "visitor"))["name"] == "bob"
            file.unlink()
            await turned_away(other)
        await eventually(lambda: bool(world.others.diagnostics))
        assert "it admits no visitors" in world.others.diagnostics[0].reason


@pytest.mark.usefixtures("patient")
async def test_a_reset_needs_the_role_that_a_mechanism_names(world, tmp_path):
    system = shipped_system()
    system = msgspec.structs.replace(system, mechanisms=tuple(
        msgspec.structs.replace(m, cleared_by="inject") if m.name == "FTM1" else m
        for m in system.mechanisms))
    file = tmp_path / "page.tokens"
    tokens = {role: issue(file, role.value, role) for role in Role}
    world.say_latched("RM1", "RM2")
    async with world.hmi(hmi_token_file=str(file), system=system) as hmi:
        at = await served(hmi)
        await eventually(lambda: hmi._state.latched == ("RM1", "RM2"))
        for role, recovery, refusal in (
                (Role.LOOK, "RM2", "Needs the role drive; look has the role look"),
                (Role.DRIVE, "RM1", "Needs the role inject; drive has the role drive"),
                (Role.DRIVE, "RM2", ""), (Role.INJECT, "RM1", "")):
            async with open_page(at, tokens[role]) as page:
                await hear(page, "operating")
                assert await ask(page, type="reset", recovery=recovery) == {
                    "type": "error" if refusal else "done",
                    "text": refusal or f"reset of {recovery} requested"}
        await eventually(lambda: [r.recovery for r in world.others.resets] == ["RM2", "RM1"])


@pytest.mark.usefixtures("patient")
async def test_what_is_done_on_pages_is_written_down(world, tmp_path):
    file, log = tmp_path / "page.tokens", tmp_path / "audit.jsonl"
    anna, bob = issue(file, "anna", Role.INJECT), issue(file, "bob", Role.LOOK)
    async with world.hmi(hmi_token_file=str(file), hmi_audit_log=str(log)) as hmi:
        at = await served(hmi)
        async with httpx.AsyncClient(base_url=f"http://{at}") as client:
            await log_in(client, anna)
            async with open_page(at, additional_headers=cookie_of(client)) as page:
                await hear(page, "operating")
                await ask(page, type="reset", recovery="RM1")
                await ask(page, type="strategy", name="mission-first")
                await ask(page, type="nonsense")
                hand = Hand(page)
                await hand.take()
                await hand.let_go()
                await hand.hold()
            await eventually(lambda: hmi._server.pages == 0)
        async with open_page(at, bob) as page:
            await hear(page, "operating")
            await ask(page, type="stick", panel="Drive", held=True)
            found = read_audit(log)  # written before the page is told
    assert [(line.who, line.role, line.page, line.what, line.outcome) for line in found] == [
        ("anna", "inject", 0, "log in", "accepted"),
        *(("anna", "inject", 1, what, outcome) for what, outcome in (
            ("open", "accepted"), ("reset", "refused"), ("strategy", "accepted"),
            ("message", "refused"), ("take the stick", "accepted"), ("let go", "accepted"),
            ("take the stick", "accepted"), ("let go", "accepted"), ("close", "accepted"))),
        ("bob", "look", 2, "open", "accepted"), ("bob", "look", 2, "stick", "refused")]
    assert [line.asked for line in found[2:4]] == [{"recovery": "RM1"}, {"name": "mission-first"}]
    assert [line.why for line in (*found[2:4], found[8], found[-1])] == [
        "'RM1' does not wait for a reset; waiting: none", "strategy mission-first requested",
        "the page that drove was closed", "Needs the role drive; bob has the role look"]
    assert {line.address for line in found} == {"127.0.0.1"}
    assert not [token for token in (anna, bob) if token in log.read_text()]


# ---- off loopback -------------------------------------------------------------------------------


async def test_a_page_that_cannot_or_must_not_be_served_is_not_and_the_reason_reported(world):
    everywhere = {"hmi_host": "0.0.0.0"}
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for incarnation, (fields, why) in enumerate((
                (everywhere, "needs a token"),
                ({**everywhere, "hmi_token": TOKEN}, "has to be encrypted"),
                ({**everywhere, "hmi_token": TOKEN, "hmi_cert": "/no/cert", "hmi_key": "/no/key"},
                 "key /no/key: cannot be"),
                ({"hmi_port": taken.getsockname()[1]},
                 "Address already in use; choose another port")), 1):
            world.others.diagnostics.clear()
            async with world.hmi(incarnation, **fields) as hmi:
                await eventually(lambda: bool(world.others.diagnostics))
                assert hmi._server is None
            assert why in world.others.diagnostics[0].reason


# -- Every request of a page with every role: the server decides, whatever the page shows --


SAMPLES = {
    "reset": (Role.DRIVE, {"recovery": "RM1"}),
    "stick": (Role.DRIVE, {"panel": "Drive", "held": True}),
    "mission": (Role.DRIVE, {"name": "A"}), "order": (Role.DRIVE, {"action": "pause"}),
    "strategy": (Role.INJECT, {"name": "mission-first"}),
    "signal": (Role.INJECT, {"node": "localization", "signal": "KILL"}),
    "inject": (Role.INJECT, {"fault": "gps-bias"}), "end-fault": (Role.INJECT, {"injection": "x"})}
"""Each kind of request that there is, and who may make it: a new one has to be put here."""


def test_a_request_of_ones_own_is_for_those_who_may_do_everything_unless_it_says_otherwise():
    class Flush(Request, frozen=True, tag="flush"):
        """Declares no role."""

    assert Flush.role is Role.INJECT


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("role", Role)
async def test_what_a_role_lacks_the_server_refuses_and_nothing_happens(world, tmp_path, role):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna", role)
    async with visited(world, token, hmi_token_file=str(file)) as (hmi, page):
        asked: list[str] = []
        handlers = hmi._server._handlers

        def fulfil(request: Request, page: int):
            asked.append(str(request.__struct_config__.tag))
            return handlers.fulfil(request, page)

        hmi._server._handlers = msgspec.structs.replace(handlers, fulfil=fulfil)
        barred = (await hear(page, "visitor"))["barred"]
        for kind, (needed, sample) in SAMPLES.items():
            answer = await ask(page, type=kind, **sample)
            if not role.may(needed):
                why = f"Needs the role {needed}; anna has the role {role}"
                assert answer == {"type": "error", "text": why}
                assert barred.pop(kind) == why
        assert asked == [kind for kind, (needed, _) in SAMPLES.items() if role.may(needed)]
        assert barred == {}
    if not asked:
        assert [*world.others.requests, *world.others.orders, *world.others.resets,
                *world.others.adaptations, *world.others.injections] == []


# -- In Chromium, over TLS: logging in, and what a role shows and takes away --


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
                hmi_host="0.0.0.0", hmi_cert=str(certificate), hmi_key=str(key),
                system=shipped_system(), launcher_pid=1, faults=OsmosisFaults().offered(),
                **fields) as hmi, repeated(world.others.busy, 0.05):
            async with browser() as tab:
                await tab.call("Security.setIgnoreCertificateErrors", ignore=True)
                await tab.show(f"https://{await served(hmi)}/")
                yield hmi, tab
                assert tab.errors == []
            await eventually(lambda: not hmi._server._server._state.connections)

    return shown


@pytest.mark.page
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


@pytest.mark.page
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


# -- Strangers: other users of this machine, too many connections --


@pytest.mark.usefixtures("patient")
async def test_beyond_so_many_connections_requests_are_refused_and_an_open_page_drives_on(
        world, monkeypatch):
    monkeypatch.setattr(web_server, "ROOM", 8)
    async with world.hmi(hmi_token=TOKEN) as hmi:
        at = await served(hmi)
        async with open_page(at, TOKEN) as page:
            hand = Hand(page)
            await hand.take()
            with contextlib.ExitStack() as idle:
                host, port = at.split(":")
                for _ in range(10):
                    idle.enter_context(socket.create_connection((host, int(port))))
                async with httpx.AsyncClient() as client:
                    await eventually(lambda: len(hmi._server._server._state.connections) > 8)
                    assert (await client.get(f"http://{at}/")).status_code == 503
                assert (await hand.hold(0.25))["drives"]
            await hand.let_go()
        async with httpx.AsyncClient() as client:
            assert (await client.get(f"http://{at}/")).status_code == 200


# ---- other users of this machine ----------------------------------------------------------------


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "::ffff:127.0.0.1"])
def test_the_kernel_tells_whose_a_connection_is_and_of_a_closed_one_nothing(host):
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True) as listening:
        with socket.socket(family) as client:
            client.connect((host, listening.getsockname()[1]))
            served_, peer = listening.accept()
        with served_:
            assert user_of_peer(served_.getsockname()[:2], peer[:2]) is None
        with socket.create_connection((host, listening.getsockname()[1])):
            served_, peer = listening.accept()
            with served_:
                assert user_of_peer(served_.getsockname()[:2], peer[:2]) == os.getuid()


async def output(process) -> str:
    told, _ = await asyncio.to_thread(process.communicate)
    assert process.returncode == 0
    return told


def request(path: str, *headers: str) -> str:
    """Return code that sends a request over the connection `c`."""
    head = "\\r\\n".join((f"GET {path} HTTP/1.1", "Host: ", ""))
    more = "\\r\\n".join((*headers, "", ""))
    return f'c = connect(); c.sendall(b"{head[:-4]}" + sys.argv[1].encode() + b"\\r\\n{more}")'


@needs_root
async def test_another_user_who_is_gone_before_it_is_looked_at_is_not_taken_for_root(hmi):
    """Of a socket without a process the kernel says that it is user 0's, who runs this test."""
    upgrade = request("/ws", "Upgrade: websocket", "Connection: Upgrade",
                      "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==")
    seen = []
    handlers = hmi._server._handlers
    hmi._server._handlers = msgspec.structs.replace(
        handlers, came=lambda page: (seen.append(page), handlers.came(page))[1])
    code = f"for _ in range(200): {upgrade}; c.close()"
    assert await output(as_nobody(await served(hmi), code)) == ""
    assert seen == []


@needs_root
async def test_another_user_is_refused_in_one_clear_line_and_let_in_by_a_token(world):
    needs = "403 Forbidden\n"
    for token, path, header, status in (
            ("", "/", "A: b", needs), (TOKEN, "/", "A: b", "200 OK\n"),
            (TOKEN, "/other", f"Authorization: Bearer {TOKEN}", "404 ")):
        async with world.hmi(hmi_token=token) as hmi:
            code = f'{request(path, "Connection: close", header)}; print(told(c))'
            told = await output(as_nobody(await served(hmi), code))
        assert told.startswith(f"HTTP/1.1 {status}")
        assert ("Other users need a token: launch.py --hmi-token-file FILE." in told) == (
            status == needs)
