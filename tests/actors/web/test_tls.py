"""A page that is encrypted: its certificate and key, and who connects to it how."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import socket
import ssl

import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from rampart.actors.web.server import WebServer
from rampart.actors.web.tls import Tls, TlsError, holds_key, load
from rampart.testing import eventually
from tests.actors.web.pems import PEMS, pair, pem

# ---- the files ----------------------------------------------------------------------------------


def test_a_certificate_says_for_which_names_it_is_and_one_file_may_hold_its_key(tmp_path):
    certificate, key = pair(tmp_path)
    _, found = load(certificate, key)
    assert found.names == ("robot.local", "*.robots.example", "127.0.0.1", "::1")
    assert found.plain_names == ("robot.local", "127.0.0.1", "::1")
    for host, covered in (("ROBOT.local", True), ("one.robots.example", True),
                          ("one.two.robots.example", False), ("192.168.0.7", False)):
        assert found.covers(host) is covered
    assert [holds_key(file) for file in (key, certificate, tmp_path / "nothing")] == [
        True, False, False]
    key.write_text(PEMS["robot.key"] + PEMS["robot.crt"])
    assert load(key, key)[1] == found


@pytest.mark.parametrize(("certificate", "key", "why"), [
    ("robot.crt", "other.key", "key {key}: does not fit certificate {certificate}"),
    ("old.crt", "old.key", "certificate {certificate}: certificate has expired"),
    ("client.crt", "client.key", "certificate {certificate}: unsuitable certificate purpose"),
    ("robot.crt", "locked.key", "key {key}: needs a passphrase; expected a key without, in a file "
                                "of mode 0600"),
    ("robot.key", "robot.key", "certificate {certificate}: expected a certificate in PEM"),
    ("robot.crt", "other.crt", "key {key}: expected a private key in PEM")])
def test_what_cannot_encrypt_a_page_is_one_line_that_names_the_file(tmp_path, certificate, key,
                                                                    why):
    files = pem(tmp_path, certificate), pem(tmp_path, key)
    with pytest.raises(TlsError) as error:
        load(*files)
    assert str(error.value) == why.format(certificate=files[0], key=files[1])


def test_files_that_are_not_there_torn_or_open_to_others_are_refused(tmp_path):
    certificate, key = pair(tmp_path)
    torn_pair = pair(tmp_path, "other")
    for file in torn_pair:
        file.write_text(file.read_text()[:200])
    for files, why in (((tmp_path / "no", key), "cannot be read (No such file or directory)"),
                       ((certificate, tmp_path / "no"), "cannot be read (No such file"),
                       ((tmp_path, key), "cannot be read (Is a directory)"),
                       ((torn_pair[0], key), f"certificate {torn_pair[0]}, key {key}: cannot be "),
                       ((certificate, torn_pair[1]), "cannot be loaded (")):
        with pytest.raises(TlsError, match=r"^[^\n]*$") as error:
            load(*files)
        assert why in str(error.value)
    key.chmod(0o640)
    with pytest.raises(TlsError, match="mode 0640: others can access it"):
        load(certificate, key)


def test_a_renewed_certificate_is_taken_and_one_that_does_not_fit_is_not(tmp_path):
    certificate, key = pair(tmp_path)
    told: list[str] = []
    tls = Tls(certificate, key, told.append)
    before = tls.context()
    assert tls.context() is before

    certificate.write_text(PEMS["other.crt"])  # its key is not there yet
    assert tls.context() is before
    assert told == [f"key {key}: does not fit certificate {certificate}; the previous one stays in "
                    "force"]
    tls.context()
    assert len(told) == 1
    key.write_text(PEMS["other.key"])
    after = tls.context()
    assert after is not before
    assert tls.says.names == ("other.local",)
    key.unlink()
    assert tls.context() is after
    assert len(told) == 2


# ---- connections --------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def served(tmp_path, **settings):
    """A server with one page, over TLS, on a port of loopback."""
    async def front(_request):
        return PlainTextResponse("here")

    listening = socket.create_server(("127.0.0.1", 0))
    port = listening.getsockname()[1]
    server = WebServer(Starlette(routes=[Route("/", front)]), listening,
                       tls=Tls(*pair(tmp_path)).serving(), **settings)
    server.start()
    try:
        yield server, port
    finally:
        server.stop()
        await eventually(lambda: not server._state.connections)


def trusting(tmp_path) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=str(pem(tmp_path, "robot.crt")))


async def ask(port: int, tls: ssl.SSLContext | None) -> bytes:
    reader, writer = await asyncio.open_connection(
        "127.0.0.1", port, ssl=tls, server_hostname="robot.local" if tls else None)
    writer.write(b"GET / HTTP/1.1\r\nHost: robot.local\r\nConnection: close\r\n\r\n")
    answer = await asyncio.wait_for(reader.read(), 5)
    writer.close()
    with contextlib.suppress(OSError, ssl.SSLError):
        await writer.wait_closed()
    return answer


async def test_a_page_is_served_over_tls_1_3_and_a_renewed_certificate_from_the_next_connection_on(
        tmp_path):
    files, others = tmp_path / "served", tmp_path / "other"
    files.mkdir()
    others.mkdir()
    async with served(files) as (server, port):
        assert (await ask(port, trusting(tmp_path))).endswith(b"here")
        old = trusting(tmp_path)
        old.maximum_version = ssl.TLSVersion.TLSv1_2
        with pytest.raises((ssl.SSLError, ConnectionError)):
            await ask(port, old)
        with pytest.raises(ssl.SSLCertVerificationError):
            await ask(port, ssl.create_default_context())
        await eventually(lambda: not server._state.connections)
        for kind in ("crt", "key"):
            shutil.copy2(pem(others, f"other.{kind}"), files / f"robot.{kind}")
        with pytest.raises(ssl.SSLCertVerificationError):
            await ask(port, trusting(tmp_path))
