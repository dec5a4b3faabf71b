"""Strangers at the operator's page: other users of this machine, too many connections."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket

import httpx
import msgspec
import pytest

from rampart.actors.web import server as web_server
from rampart.actors.web.door import user_of_peer
from rampart.testing import eventually
from tests.actors.operator.test_operating import Hand
from tests.actors.operator.world import TOKEN, open_page, served
from tests.other_user import as_nobody, needs_root


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
