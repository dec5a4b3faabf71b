"""Each identity of the full system tries everything, over real TLS: its rights and no more."""

from __future__ import annotations

import os
import threading

import pytest
import zenoh

from rampart.actors.bus import run_folder
from rampart.actors.bus.topic import Qos
from rampart.actors.bus.topics import INJECT
from tests.actors.access.keyed import (
    Keyed,
    every_key,
    layout_of,
    make_keys,
    may_hear,
    may_say,
    members_of,
    wait_for,
)

pytestmark = pytest.mark.processes

LAYOUT = layout_of("osmosis")
MEMBERS = members_of(LAYOUT)
KEYS = every_key(LAYOUT)
NODES = sorted(set(MEMBERS) - set(LAYOUT.routers))
OPERATED = {"inject/order", "manager/adapt", "manager/reset", "mission/order", "mission/request",
            "stub/trigger", "supervisor/signal", "teleoperation/joystick", "way_out/request",
            "world/actuator_fault", "world/obstacle"}
COMMANDS = {topic.key for m in MEMBERS.values() for topic in (*m.actor.outputs, *m.actor.inputs())
            if topic.qos is Qos.COMMAND} | {"inject/order", "inject/report"}


def is_kept(key):
    return key not in COMMANDS and not key.startswith("diagnostic/")


def says(name):
    return {key for key in KEYS if may_say(MEMBERS[name], key)
            or (name == "observer" and key in OPERATED)}


def hears(name):
    return {key for key in KEYS if may_hear(MEMBERS[name], key)}


@pytest.fixture(scope="module")
def keyed(tmp_path_factory):
    folder = run_folder.make(0, os.getpid())
    keys = make_keys(tmp_path_factory.mktemp("access") / "keys", LAYOUT)
    with Keyed(folder, keys, LAYOUT) as one:
        yield one
    run_folder.remove(folder)


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


def test_every_key_of_topics_md_is_tried():
    assert len(KEYS) > 150
    assert {"summit_xl/command", "heartbeat/DM4", "recovery/RM3/command"} <= set(KEYS)


def test_what_it_publishes_arrives_and_nothing_else(keyed):
    heard, arrived = Heard(), {}
    with keyed.joined("bob") as viewer:
        held = viewer.declare_subscriber("rampart/**", heard.take)
        for name in [*NODES, "ada", "bob"]:
            expected = OPERATED if name == "ada" else set() if name == "bob" else says(name)
            with keyed.joined(name) as session:
                def tries(session=session, name=name):
                    for key in KEYS:
                        session.put(f"rampart/{key}", name)
                    for key in ("nothing/declared", "alive/DM4/9", "**", "heartbeat/*"):
                        session.put(f"rampart/{key}", name)
                    for key in KEYS:
                        session.delete(f"rampart/{key}")

                def is_there(name=name, expected=expected, tries=tries):
                    tries()
                    return expected <= heard.of(name)

                assert wait_for(is_there), (name, expected - heard.of(name))
                tries()
            arrived[name] = expected
            assert heard.of(name) == arrived[name], name
        assert {name: heard.of(name) for name in arrived} == arrived  # late ones included
        assert heard.of("") == set()  # nothing was deleted
        held.undeclare()


def test_it_hears_what_it_declares_and_nothing_else(keyed):
    with keyed.joined("router_b") as everybody:
        for name in NODES:
            heard, expected = Heard(), hears(name)
            with keyed.joined(name) as session:
                held = [session.declare_subscriber(f"rampart/{key}", heard.take) for key in KEYS]
                held += [session.declare_subscriber(key, heard.take)
                         for key in ("**", "rampart/**", "rampart/gone/*")]

                def is_there(name=name, expected=expected, heard=heard):
                    for key in KEYS:
                        everybody.put(f"rampart/{key}", name)
                    everybody.put("rampart/nothing/declared", name)
                    return expected <= heard.of(name)

                assert wait_for(is_there), (name, expected - heard.of(name))
                everybody.put(INJECT.at(), "last")  # each one hears it
                assert wait_for(lambda heard=heard: "inject/order" in heard.of("last"))
                assert heard.of(name) == expected, name
                del held


def test_it_answers_for_its_own_topics_only(keyed):
    with keyed.joined("router_b") as everybody:
        for name in NODES:
            expected = {key for key in KEYS if may_say(MEMBERS[name], key) and is_kept(key)}
            with keyed.joined(name) as session:
                held = [session.declare_queryable(
                    f"rampart/{key}", lambda q, key=key, name=name: q.reply(f"rampart/{key}", name))
                    for key in (*KEYS, "**")]

                def answered(name=name):
                    found = set()
                    for reply in everybody.get("rampart/**", target=zenoh.QueryTarget.ALL,
                                               consolidation=zenoh.ConsolidationMode.NONE,
                                               timeout=5.0):
                        if reply.ok is not None and reply.ok.payload.to_bytes() == name.encode():
                            found.add(str(reply.ok.key_expr).removeprefix("rampart/"))
                    return found

                assert answered() <= expected, name
                one = min(expected)
                assert wait_for(lambda one=one: [r for r in everybody.get(
                    f"rampart/{one}", timeout=2.0) if r.ok is not None]), (name, one)
                del held


def test_it_asks_for_what_it_hears_only(keyed):
    with keyed.joined("router_b") as everybody:
        held = everybody.declare_queryable(
            "rampart/**", lambda q: q.reply(q.key_expr, "answer"), complete=True)
        for name in NODES:
            with keyed.joined(name) as session:
                def is_answered(key, session=session):
                    return any(reply.ok is not None for reply in session.get(
                        f"rampart/{key}", timeout=2.0))

                kept = {key for key in hears(name) if is_kept(key)}
                for key in sorted(kept)[:3]:
                    assert wait_for(lambda key=key: is_answered(key)), (name, key)
                for key in KEYS:
                    if key not in kept and (name in {"DM4", "hmi"} or key == "localization/pose"):
                        assert not is_answered(key), (name, key)
        held.undeclare()


def test_nobody_looks_into_the_router_itself(keyed):
    for name in ("bob", "ada", "DM4", "supervisor"):
        with keyed.joined(name) as session:
            own = f"@/{session.info.zid()}/"
            told = [r.ok.key_expr for r in session.get("@/**", timeout=0.5) if r.ok is not None]
            assert not [key for key in told if own not in str(key)], name
