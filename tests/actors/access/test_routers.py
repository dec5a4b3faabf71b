"""Routers with keys, over real TLS: an identity gets what it declares, and a stranger nothing."""

import datetime as dt
import json
import os
import threading
import time

import pytest
import zenoh

from rampart.actors.access import key_folder
from rampart.actors.access.certificates import new_authority, new_certificate, public_part
from rampart.actors.access.rights import rights_of_all
from rampart.actors.bus import run_folder
from rampart.actors.bus.bus import BusError
from rampart.actors.bus.topics import INJECT
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import Credentials, credentials_in, session_config
from rampart.testing import free_port, wait_until
from tests.actors.access.keyed import Keyed, covered, every_key, layout_of, make_keys
from tests.two_hosts import two_hosts

pytestmark = [pytest.mark.processes, pytest.mark.alone]

LAYOUT = layout_of("osmosis")
RIGHTS = rights_of_all(LAYOUT)
KEYS = every_key(LAYOUT)
NODES = ("safety_pilot", "ftm_manager", "supervisor", "DM4", "hmi", "observer")
PEOPLE = {"ada": "operator", "bob": "viewer"}


def may(name, what):
    return covered(KEYS, getattr(RIGHTS[PEOPLE.get(name, name)], what))


class Heard:
    """Keys on which something came, by what was in it."""

    def __init__(self):
        self.keys: dict[str, set[str]] = {}
        self._lock = threading.Lock()

    def take(self, sample):
        key = str(sample.key_expr).removeprefix("rampart/")
        with self._lock:
            self.keys.setdefault(sample.payload.to_bytes().decode(), set()).add(key)

    def of(self, what):
        with self._lock:
            return set(self.keys.get(what, ()))


def test_an_identity_publishes_its_declared_outputs_only(keyed):
    heard, arrived = Heard(), {}
    assert {"summit_xl/command", "heartbeat/DM4", "recovery/RM3/command"} <= set(KEYS)
    with keyed.joined("bob") as viewer:
        held = viewer.declare_subscriber("rampart/**", heard.take)
        for name in [*NODES, *PEOPLE]:
            arrived[name] = may(name, "publishes")
            with keyed.joined(name) as session:
                def tries(session=session, name=name):
                    for key in (*KEYS, "nothing/declared", "alive/DM4/9", "**", "heartbeat/*"):
                        session.put(f"rampart/{key}", name)
                    for key in KEYS:
                        session.delete(f"rampart/{key}")
                    return arrived[name] <= heard.of(name)

                wait_until(tries, 20, name)
                tries()
        assert {name: heard.of(name) for name in arrived} == arrived
        assert heard.of("") == set()  # nothing was deleted
        held.undeclare()


def test_an_identity_receives_its_declared_inputs_only(keyed):
    with keyed.joined("router_b") as everybody:
        for name in NODES:
            heard, expected = Heard(), may(name, "subscribes")
            with keyed.joined(name) as session:
                held = [session.declare_subscriber(key, heard.take) for key in (
                    *(f"rampart/{key}" for key in KEYS), "**", "rampart/**", "rampart/gone/*")]

                def is_there(name=name, expected=expected, heard=heard):
                    for key in (*KEYS, "nothing/declared"):
                        everybody.put(f"rampart/{key}", name)
                    return expected <= heard.of(name)

                wait_until(is_there, 20, name)
                wait_until(lambda heard=heard: everybody.put(INJECT.at(), "last")
                           or "inject/order" in heard.of("last"), 20)  # each one hears it
                assert heard.of(name) == expected, name
                del held


def replies(session, key, **how):
    return {str(reply.ok.key_expr).removeprefix("rampart/"): reply.ok.payload.to_bytes()
            for reply in session.get(f"rampart/{key}", timeout=2.0, **how) if reply.ok is not None}


def test_it_answers_for_its_own_topics_and_queries_its_inputs_only(keyed):
    with keyed.joined("router_b") as everybody:
        for name in NODES:
            may_answer = may(name, "answers")
            with keyed.joined(name) as session:
                held = [session.declare_queryable(
                    f"rampart/{key}", lambda q, key=key: q.reply(f"rampart/{key}", "answer"))
                    for key in (*KEYS, "**")]
                found = replies(everybody, "**", target=zenoh.QueryTarget.ALL,
                                consolidation=zenoh.ConsolidationMode.NONE)
                assert found.keys() <= may_answer, name
                one = min(may_answer)
                wait_until(lambda one=one: replies(everybody, one), 20, f"{name}: {one}")
                del held
        all_answers = everybody.declare_queryable(
            "rampart/**", lambda q: q.reply(q.key_expr, "answer"), complete=True)
        for name in NODES:
            asks = may(name, "queries")
            with keyed.joined(name) as session:
                for key in sorted(asks)[:3]:
                    wait_until(lambda key=key: replies(session, key), 20, f"{name}: {key}")
                others = [key for key in KEYS if key not in asks]
                for key in others if name in {"DM4", "hmi"} else others[:3]:
                    assert not replies(session, key), (name, key)
        all_answers.undeclare()


def test_no_identity_reads_the_router_s_admin_space(keyed):
    for name in ("bob", "ada", "DM4", "supervisor"):
        with keyed.joined(name) as session:
            own = f"@/{session.info.zid()}/"
            told = [r.ok.key_expr for r in session.get("@/**", timeout=0.5) if r.ok is not None]
            assert not [key for key in told if own not in str(key)], name


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
            with zenoh.open(config) as session:
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
    return new_certificate(authority, "safety_pilot", "node", addresses=(), now=now, days=8) + chain


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
        wait_until(lambda: not list(session.info.routers_zid()), 20)


def test_a_node_cannot_pose_as_a_router(keyed, folder):
    own = keyed.shown("DM4")
    socket = f"unixsock-stream/{folder}/router_b"
    there = Credentials(own.authority, own.own, {socket: "tls/127.0.0.1:9499"})
    with zenoh.open(session_config([socket], [], there)):
        victim = keyed.shown("safety_pilot")
        with pytest.raises(zenoh.ZError):
            zenoh.open(session_config((), ["tls/127.0.0.1:9499"], victim))


async def test_a_refused_client_reports_its_certificate(keyed, monkeypatch):
    monkeypatch.setattr("rampart.actors.bus.zenoh_bus.PATIENCE_S", 0.5)
    other = written(keyed, issued(new_authority(NOW, 9)))
    bus = ZenohBus("", [keyed.socket], credentials=other)
    with pytest.raises(BusError, match=r"no router at .* that takes the certificate in .*own\.pem"):
        await bus.open()


def test_a_host_that_is_taken_over_says_nothing_that_is_not_its_nodes(tmp_path, sockets):
    """Its router, with its key, tries every way; the robot's router lets nothing through."""
    forged = ("summit_xl/command", "supervisor/nodes", "supervisor/event",
              "recovery/RM1/command", "detection/DM4", "inject/order", "**")
    file = tmp_path / "two.toml"
    file.write_text(two_hosts({"robot": "127.0.0.1", "ground": "127.0.0.2"}))
    layout = layout_of(file)
    keys = make_keys(tmp_path / "keys", layout)
    key_folder.issue(keys, ["router_a_ground"], "router")
    with Keyed(sockets, keys, layout) as robot, robot.joined("router_b") as everybody:
        got: list[str] = []
        held = everybody.declare_subscriber("rampart/**", lambda s: got.append(str(s.key_expr)))
        taken = credentials_in(str(keys), "router_a_ground")
        at = f"tls/127.0.0.1:{free_port()}"
        with zenoh.open(session_config([at], [robot.at], taken)) as ground:
            def arrived():
                for key in forged:
                    ground.put(f"rampart/{key}", "forged")
                ground.put("rampart/detection/DM5", "own")
                return "rampart/detection/DM5" in got

            wait_until(arrived, 20)
            arrived()
            answers = [r for r in everybody.get("rampart/summit_xl/command", timeout=0.5)
                       if r.ok is not None]
        # Events are its supervisor's to say, too, and orders the page's, which is there.
        assert set(got) == {"rampart/detection/DM5", "rampart/inject/order",
                            "rampart/supervisor/event"}
        assert answers == []
        held.undeclare()
