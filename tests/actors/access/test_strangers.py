"""Strangers at the port of a router with keys: nothing read, nothing accepted."""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import tempfile
import threading
import time
from pathlib import Path

import pytest
import zenoh

from rampart.actors.access.certificates import new_authority, new_certificate, public_part
from rampart.actors.bus import run_folder
from rampart.actors.bus.bus import BusError
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import Credentials, session_config
from tests.actors.access.keyed import (
    Keyed,
    every_key,
    layout_of,
    make_keys,
    opened,
    shown_by_strangers,
    try_all,
    wait_for,
)
from tests.other_user import needs_root

pytestmark = [pytest.mark.processes, pytest.mark.alone]

LAYOUT = layout_of("osmosis")
KEYS = every_key(LAYOUT)
NOW = dt.datetime.now(dt.UTC)


@pytest.fixture(scope="module")
def folder():
    made = run_folder.make(0, os.getpid())
    yield made
    run_folder.remove(made)


@pytest.fixture(scope="module")
def keyed(folder, tmp_path_factory):
    keys = make_keys(tmp_path_factory.mktemp("strangers") / "keys", LAYOUT)
    with Keyed(folder, keys, LAYOUT) as one:
        yield one


@contextlib.contextmanager
def a_busy_bus(keyed):
    """Something comes on every key all the time; yields what of strangers' arrives."""
    accepted: list[str] = []
    over = threading.Event()
    with keyed.joined("router_b") as everybody, keyed.joined("bob") as viewer:
        held = viewer.declare_subscriber("rampart/**", lambda s: accepted.append(
            str(s.key_expr)) if s.payload.to_bytes() == b"stranger" else None)

        def work():
            while not over.wait(0.05):
                for key in KEYS:
                    everybody.put(f"rampart/{key}", "robot")

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield accepted
        finally:
            over.set()
            thread.join()
            del held


@needs_root
def test_another_user_reads_nothing_and_is_not_heard(keyed):
    with tempfile.TemporaryDirectory(prefix="stranger-", dir="/tmp") as place:
        Path(place).chmod(0o755)
        with a_busy_bus(keyed) as accepted:
            plain = f"tcp/127.0.0.1:{keyed.port}"
            found = try_all([keyed.at, plain, keyed.socket],
                            shown_by_strangers(Path(place), keyed.keys), KEYS, becomes_nobody=True)
        assert found["user"] == 65534
        assert len(found["tried"]) == 9
        assert sum(one["heard"] for one in found["tried"].values()) == 0, found
        assert accepted == []


def test_the_same_attempts_succeed_with_a_key(keyed):
    """So the others fail for want of one; the socket in the folder lets nothing through."""
    own, ours = str(keyed.keys / "ada.pem"), str(keyed.keys / "ca.crt")
    with a_busy_bus(keyed) as accepted:
        assert try_all([keyed.socket], {"nothing": {}}, KEYS)["tried"][
            f"{keyed.socket} nothing"]["heard"] == 0
        assert accepted == []
        found = try_all([keyed.at], {"a key": {
            "root_ca_certificate": ours, "enable_mtls": True,
            "connect_private_key": own, "connect_certificate": own}}, KEYS)
        (one,) = found["tried"].values()
        assert one["joined"]
        assert one["heard"] > len(KEYS)
        assert set(accepted) == {"rampart/" + key for key in (
            "inject/order", "manager/adapt", "manager/reset", "mission/order", "mission/request",
            "stub/trigger", "supervisor/signal",
            "teleoperation/joystick", "way_out/request", "world/actuator_fault",
            "world/obstacle")}


def written(keyed, content, name="own"):
    file = keyed.keys / f"{name}.pem"
    file.write_bytes(content)
    return Credentials(str(keyed.keys / "ca.crt"), str(file), {keyed.socket: keyed.at})


def is_let_in(keyed, credentials):
    """Whether a message on a key that is safety_pilot's arrives from who shows this."""
    seen: list[bytes] = []
    with keyed.joined("bob") as viewer:
        held = viewer.declare_subscriber(
            "rampart/summit_xl/command", lambda s: seen.append(s.payload.to_bytes()))
        try:
            with keyed.joined("", credentials) as session:
                end = time.monotonic() + 1.0
                while time.monotonic() < end and not seen:
                    session.put("rampart/summit_xl/command", "stranger")
                    time.sleep(0.02)
        except zenoh.ZError:
            pass
        held.undeclare()
    return bool(seen)


def issued(authority, now=NOW, chain=b""):
    return new_certificate(authority, "safety_pilot", "node", addresses=(), now=now,
                           days=8) + chain


@pytest.mark.parametrize(("what", "taken"), [
    ("of the authority", True), ("expired", False), ("of another authority", False),
    ("signed by a node", False)])
def test_only_a_certificate_of_the_authority_that_is_valid_is_let_in(keyed, what, taken):
    authority, node = ((keyed.keys / name).read_bytes() for name in ("authority.key", "DM4.pem"))
    made = {"of the authority": lambda: issued(authority),
            "expired": lambda: issued(authority, NOW - dt.timedelta(days=9)),
            "of another authority": lambda: issued(new_authority(NOW, 9)),
            "signed by a node": lambda: issued(node, chain=public_part(node))}[what]()
    assert is_let_in(keyed, written(keyed, made)) == taken


def test_a_link_is_closed_when_its_certificate_expires(keyed):
    authority = (keyed.keys / "authority.key").read_bytes()
    short = written(keyed, new_certificate(
        authority, "safety_pilot", "node", addresses=(), now=dt.datetime.now(dt.UTC),
        days=3 / 86_400))
    with keyed.joined("", short) as session:
        assert list(session.info.routers_zid())
        assert wait_for(lambda: not list(session.info.routers_zid()))


def test_a_node_cannot_pose_as_a_router(keyed, folder):
    own = keyed.shown("DM4")
    socket = f"unixsock-stream/{folder}/router_b"
    there = Credentials(own.authority, own.own, {socket: "tls/127.0.0.1:9499"})
    with opened(session_config([socket], [], there)):
        victim = keyed.shown("safety_pilot")
        with pytest.raises(zenoh.ZError):
            zenoh.open(session_config((), ["tls/127.0.0.1:9499"], victim))


async def test_a_refused_client_reports_its_certificate(keyed, monkeypatch):
    monkeypatch.setattr("rampart.actors.bus.zenoh_bus.PATIENCE_S", 0.5)
    other = written(keyed, issued(new_authority(NOW, 9)))
    bus = ZenohBus("", [keyed.socket], credentials=other)
    with pytest.raises(BusError, match=r"no router at .* that takes the certificate in .*own\.pem"):
        await bus.open()
