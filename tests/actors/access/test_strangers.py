"""Strangers at the port of a router with keys: nothing read, nothing accepted."""

from __future__ import annotations

import datetime as dt
import json
import os
import time

import pytest
import zenoh

from rampart.actors.access.certificates import new_authority, new_certificate, public_part
from rampart.actors.bus import run_folder
from rampart.actors.bus.bus import BusError
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import Credentials, session_config
from tests.actors.access.keyed import Keyed, layout_of, make_keys, opened, wait_for

pytestmark = [pytest.mark.processes, pytest.mark.alone]

LAYOUT = layout_of("osmosis")
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


def written(keyed, content, name="own"):
    file = keyed.keys / f"{name}.pem"
    file.write_bytes(content)
    return Credentials(str(keyed.keys / "ca.crt"), str(file), {keyed.socket: keyed.at})


def gets_through(keyed, config):
    """Whether anything arrives from who joins like this, in safety_pilot's name, and at him."""
    seen, heard = [], []
    with keyed.joined("router_b") as everybody, keyed.joined("bob") as viewer:
        held = viewer.declare_subscriber("rampart/**", lambda s: seen.append(
            s.key_expr) if s.payload.to_bytes() == b"stranger" else None)
        try:
            with opened(config) as session:
                own = [session.declare_subscriber(key, lambda s: heard.append(
                    s.key_expr) if s.payload.to_bytes() != b"stranger" else None)
                    for key in ("**", "rampart/control/command")]
                end = time.monotonic() + 1.0
                while time.monotonic() < end and not (seen and heard):
                    everybody.put("rampart/control/command", "robot")
                    for key in ("summit_xl/command", "inject/order", "heartbeat/DM4"):
                        session.put(f"rampart/{key}", "stranger")
                    heard += [r.ok for r in session.get("rampart/**", timeout=0.1) if r.ok]
                del own
        except zenoh.ZError:
            pass
        held.undeclare()
    return bool(seen), bool(heard)


def issued(authority, now=NOW, chain=b""):
    return new_certificate(authority, "safety_pilot", "node", addresses=(), now=now,
                           days=8) + chain


@pytest.mark.parametrize("what", [
    "the authority's", "expired", "of another authority", "signed by a node", "no certificate",
    "plain TCP", "the socket in the folder"])
def test_only_a_certificate_of_the_authority_that_is_valid_is_let_in(keyed, what):
    authority, node = ((keyed.keys / name).read_bytes() for name in ("authority.key", "DM4.pem"))
    made = {"the authority's": lambda: issued(authority),
            "expired": lambda: issued(authority, NOW - dt.timedelta(days=9)),
            "of another authority": lambda: issued(new_authority(NOW, 9)),
            "signed by a node": lambda: issued(node, chain=public_part(node))}.get(what)
    if made is not None:
        config = session_config((), [keyed.socket], written(keyed, made()))
    else:
        config = session_config((), [{
            "no certificate": keyed.at, "plain TCP": f"tcp/127.0.0.1:{keyed.port}"
            }.get(what, keyed.socket)])
        config.insert_json5("transport/link/tls/root_ca_certificate",
                            json.dumps(str(keyed.keys / "ca.crt")))
    assert gets_through(keyed, config) == ((what == "the authority's",) * 2)


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
