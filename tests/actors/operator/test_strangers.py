"""Floods of strangers at the operator's page: who holds a connection, and who gets in meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading

import httpx
import msgspec
import pytest

from rampart.actors.web import guests as web_guests
from rampart.actors.web import server as web_server
from rampart.actors.web.tcp_peer import user_of_peer
from rampart.testing import eventually, free_port
from tests.actors.operator.test_operating import RELEASED, TOKEN, Hand, ask, open_page
from tests.actors.operator.world import served
from tests.other_user import NOBODY, as_nobody, needs_root

BEARER = {"Authorization": f"Bearer {TOKEN}"}
MANY = 3 * web_guests.ROOM


@pytest.fixture
def hasty(monkeypatch):
    """Patience that a test can wait for."""
    monkeypatch.setattr(web_guests, "PATIENCE_S", 0.4)
    monkeypatch.setattr(web_server, "_SWEEP_S", 0.05)
    monkeypatch.setattr(web_server, "PING_S", 0.2)


@contextlib.asynccontextmanager
async def idle(at: str, count: int, say: bytes = b""):
    """Hold connections that say something once, or nothing."""
    host, port = at.split(":")
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as all_of_them:
        made = []
        for _ in range(count):
            made.append(one := all_of_them.enter_context(socket.socket()))
            one.setblocking(False)
            await loop.sock_connect(one, (host, int(port)))
            with contextlib.suppress(OSError):
                await loop.sock_sendall(one, say)
        yield made


def reception(hmi) -> web_server.Reception:
    return hmi._server._server.reception


async def all_gone(hmi) -> None:
    """Wait until nobody is connected, or in the kernel's queue: who asks last comes last."""
    async with httpx.AsyncClient(timeout=10) as client:
        assert (await client.get(f"http://127.0.0.1:{hmi._server.port}/")).status_code == 200
    await eventually(lambda: len(reception(hmi)) == hmi._server.pages == 0)


async def closed(connection: socket.socket) -> None:
    """Wait until the other end has closed a connection."""
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(5):
        with contextlib.suppress(ConnectionError):
            while await loop.sock_recv(connection, 65536):
                pass


async def loads_and_drives(world, at: str, **options) -> None:
    """Load the page as a browser does, open its WebSocket, drive, and stop."""
    async with httpx.AsyncClient() as client:
        for name in ("", "app.js", "style.css", "robot/map.js"):
            assert (await client.get(f"http://{at}/{name}")).status_code == 200
    async with open_page(at, **options) as page:
        await Hand(page).take()
        await eventually(lambda: world.others.stick[-1].dead_man)
        assert (await ask(page, type="stick", panel="Drive", held=False))["grip"] == "free"
        await eventually(lambda: world.others.stick[-1] == RELEASED)


# ---- connections that say nothing, or little at a time -------------------------------------------


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("say", [
    b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ", b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    b"Content-Length: 1000000\r\n\r\n"], ids=["idle", "half a head", "half a body"])
@pytest.mark.parametrize("token", ["", TOKEN])
async def test_however_many_connections_idle_an_operator_gets_in_and_drives(world, say, token):
    async with world.hmi(hmi_port=free_port(), hmi_token=token) as hmi:
        at = await served(hmi)
        async with idle(at, MANY, say):
            await loads_and_drives(world, at, additional_headers=BEARER if token else {})
            assert len(reception(hmi)) <= web_guests.ROOM
        await all_gone(hmi)


@pytest.mark.slow
@pytest.mark.usefixtures("patient")
async def test_strangers_who_come_again_and_again_take_no_stick_and_close_no_page(world):
    async with world.hmi(hmi_port=free_port(), hmi_token=TOKEN) as hmi:
        at = await served(hmi)
        over = threading.Event()

        def flood() -> None:
            host, port = at.split(":")
            while not over.is_set():
                with contextlib.suppress(OSError), contextlib.ExitStack() as held:
                    for _ in range(40):
                        held.enter_context(socket.create_connection((host, int(port)), 5)).sendall(
                            b"GET / HTTP/1.1\r\n")

        async with open_page(at, additional_headers=BEARER) as page:
            hand = Hand(page)
            await hand.take()
            flooding = asyncio.create_task(asyncio.to_thread(flood))
            try:
                for _ in range(200):
                    assert (await hand.hold(0.25))["grip"] == "drives"
                    await asyncio.sleep(0.01)
                await loads_beside(at)
                assert (await hand.hold(0.25))["grip"] in ("drives", "lapsed")
                assert (await ask(page, type="stick", panel="Drive", held=False))["grip"] == "free"
                await eventually(lambda: world.others.stick[-1] == RELEASED)
            finally:
                over.set()
                await flooding
        await all_gone(hmi)


async def loads_beside(at: str) -> None:
    async with httpx.AsyncClient(timeout=10) as client:
        assert (await client.get(f"http://{at}/")).status_code == 200
    async with open_page(at, additional_headers=BEARER):
        pass


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("say", [
    b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ",
    b"POST / HTTP/1.1\r\nHost: %b\r\nContent-Length: 1000000\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: %b\r\n\r\n"],
    ids=["nothing", "half a line", "half a head", "half a body", "kept alive"])
async def test_who_makes_no_whole_request_is_closed_though_it_drips(world, say):
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with idle(at, 1, say.replace(b"%b", at.encode())) as (slow,):
            dripping = asyncio.create_task(drip(slow))
            await closed(slow)
            dripping.cancel()
        await all_gone(hmi)


async def drip(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while True:
            await asyncio.sleep(0.05)
            connection.send(b"a")


HANDSHAKE = (b"GET /ws HTTP/1.1\r\nHost: %b\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
             b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n")


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("token", ["", TOKEN], ids=["let in", "refused"])
async def test_a_websocket_that_answers_nothing_is_closed(world, token):
    async with world.hmi(hmi_port=free_port(), hmi_token=token) as hmi:
        at = await served(hmi)
        async with idle(at, 1, HANDSHAKE % at.encode()) as (mute,):
            await closed(mute)
        await all_gone(hmi)


@pytest.mark.usefixtures("hasty")
async def test_a_websocket_that_pings_and_never_reads_does_not_fill_the_memory(world, monkeypatch):
    monkeypatch.setattr(web_server, "UNREAD_BYTES", 100_000)
    monkeypatch.setattr(web_guests, "BYTES_PER_S", 1e9)
    monkeypatch.setattr(web_guests, "BYTES_AT_ONCE", 1e9)
    ping = b"\x89\xfd" + bytes(4) + bytes(125)
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        async with idle(at, 1, HANDSHAKE % at.encode()) as (mute,):
            with pytest.raises(ConnectionError):
                await flooded(mute, ping * 100)
        await all_gone(hmi)


async def flooded(connection: socket.socket, what: bytes) -> None:
    async with asyncio.timeout(20):
        while True:
            await asyncio.get_running_loop().sock_sendall(connection, what)


async def test_who_sends_far_more_than_a_page_is_closed(world):
    empty_part = b"\x00\x80" + bytes(4)  # of a message that has begun and never ends
    async with world.hmi(hmi_port=free_port()) as hmi:
        at = await served(hmi)
        begun = b"\x01\x80" + bytes(4)
        async with idle(at, 1, HANDSHAKE % at.encode() + begun) as (flooder,):
            with pytest.raises(ConnectionError):
                await flooded(flooder, empty_part * 1000)
        await all_gone(hmi)


# ---- other users of this machine ----------------------------------------------------------------


def test_the_kernel_tells_whose_a_connection_is_and_of_a_closed_one_nothing():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        client = socket.create_connection(listening.getsockname())
        served_, peer = listening.accept()
        with served_:
            assert user_of_peer(served_.getsockname(), peer) == os.getuid()
            client.close()
            assert user_of_peer(served_.getsockname(), peer) is None


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_the_kernel_tells_it_of_ipv4_that_is_written_as_ipv6_too(family):
    with socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True) as listening:
        port = listening.getsockname()[1]
        for host in ("::1", "::ffff:127.0.0.1") if family == socket.AF_INET6 else ("127.0.0.1",):
            with socket.socket(family) as client:
                client.connect((host, port))
                served_, peer = listening.accept()
                with served_:
                    assert user_of_peer(served_.getsockname()[:2], peer[:2]) == os.getuid()


async def output(process) -> str:
    told, _ = await asyncio.to_thread(process.communicate)
    assert process.returncode == 0
    return told


GET = 'b"GET / HTTP/1.1\\r\\nHost: " + sys.argv[1].encode() + b"\\r\\n%s\\r\\n"'


@needs_root
@pytest.mark.parametrize("code", [
    f'c = connect(); c.sendall({GET % ""}); print(told(c))',
    "print(told(connect()))",
], ids=["asks", "only connects"])
async def test_on_loopback_another_user_is_refused_in_one_clear_line(world, code):
    async with world.hmi(hmi_port=free_port()) as hmi:
        told = await output(as_nobody(await served(hmi), code))
        assert told.startswith("HTTP/1.1 403 Forbidden\n")
        assert told.rstrip().endswith("With a token others get in too: "
                                      "launch.py --hmi-token-file FILE.")
        assert "<html" not in told


@needs_root
async def test_another_user_who_is_gone_before_it_is_looked_at_is_not_taken_for_root(world):
    """Of a socket without a process the kernel says that it is user 0's, who runs this test."""
    code = f"""
for _ in range(200):
    c = connect()
    c.sendall({GET % ""} + b'')
    c.close()
"""
    async with world.hmi(hmi_port=free_port()) as hmi:
        seen = []
        handlers = hmi._server._handlers
        hmi._server._handlers = msgspec.structs.replace(
            handlers, came=lambda page: (seen.append(page), handlers.came(page))[1])
        upgrade = code.replace("\\r\\n\\r\\n", "\\r\\n").replace("GET / ", "GET /ws ").replace(
            "b''", 'b"Upgrade: websocket\\r\\nConnection: Upgrade\\r\\nSec-WebSocket-Version: 13'
                   '\\r\\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\\r\\n\\r\\n"')
        assert await output(as_nobody(await served(hmi), upgrade)) == ""
        await all_gone(hmi)
        assert seen == []


@needs_root
async def test_a_token_lets_another_user_in(world):
    code = f'c = connect(); c.sendall({GET % "Connection: close"}); print(told(c))'
    async with world.hmi(hmi_port=free_port(), hmi_token=TOKEN) as hmi:
        at = await served(hmi)
        told = await output(as_nobody(at, code.replace("close\\r\\n", "close\\r\\n\\r\\n")))
        assert told.startswith("HTTP/1.1 200 OK\n")
        told = await output(as_nobody(at, code.replace("GET / ", "GET /camera.jpg ").replace(
            "close\\r\\n", f"close\\r\\nAuthorization: Bearer {TOKEN}\\r\\n\\r\\n")))
        assert told.startswith("HTTP/1.1 503 ")  # this HMI has no camera


@needs_root
async def test_on_loopback_users_are_told_apart_and_one_does_not_displace_another(
        world, monkeypatch):
    monkeypatch.setattr(web_guests, "PATIENCE_S", 60.0)
    hold = f"""
held = [connect() for _ in range({MANY})]
print("here", flush=True)
sys.stdin.read()
"""
    async with world.hmi(hmi_port=free_port(), hmi_token=TOKEN) as hmi:
        at = await served(hmi)
        async with idle(at, 3) as own:
            flood = as_nobody(at, hold)
            try:
                assert await asyncio.to_thread(flood.stdout.readline) == "here\n"
                guests = reception(hmi)._guests._guests
                await eventually(lambda: sum(
                    guest.source == f"user {NOBODY}" for guest in guests.values()
                ) == web_guests.WAITING_ROOM)
                for one in own:  # idle themselves, and still there
                    one.send(b"GET / HTTP/1.1\r\nHost: " + at.encode() + b"\r\n\r\n")
                    answer = await asyncio.wait_for(
                        asyncio.get_running_loop().sock_recv(one, 100), 5)
                    assert answer.startswith(b"HTTP/1.1 200 OK")
            finally:
                await output(flood)
        await all_gone(hmi)
