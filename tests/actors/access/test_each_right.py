"""Identities of each kind try everything, over real TLS: what they declare, and no more.

That the rules hold for all identities is checked without a router, in test_rights_and_rules.py.
"""

from __future__ import annotations

import os
import threading

import pytest
import zenoh

from rampart.actors.bus import run_folder
from rampart.actors.bus.topics import INJECT
from tests.actors.access.declared import declared_rights
from tests.actors.access.keyed import Keyed, every_key, layout_of, make_keys, wait_for

pytestmark = pytest.mark.processes

LAYOUT = layout_of("osmosis")
_, DECLARED = declared_rights(LAYOUT)
KEYS = every_key(LAYOUT)
NODES = ("safety_pilot", "ftm_manager", "supervisor", "DM4", "hmi", "observer")
PEOPLE = {"ada": "operator", "bob": "viewer"}


def may(name, what):
    return DECLARED[PEOPLE.get(name, name)].get(what, set()).intersection(KEYS)


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


def test_an_identity_publishes_its_declared_outputs_only(keyed):
    heard, arrived = Heard(), {}
    assert {"summit_xl/command", "heartbeat/DM4", "recovery/RM3/command"} <= set(KEYS)
    with keyed.joined("bob") as viewer:
        held = viewer.declare_subscriber("rampart/**", heard.take)
        for name in [*NODES, *PEOPLE]:
            arrived[name] = may(name, "says")
            with keyed.joined(name) as session:
                def tries(session=session, name=name):
                    for key in (*KEYS, "nothing/declared", "alive/DM4/9", "**", "heartbeat/*"):
                        session.put(f"rampart/{key}", name)
                    for key in KEYS:
                        session.delete(f"rampart/{key}")
                    return arrived[name] <= heard.of(name)

                assert wait_for(tries), (name, arrived[name] - heard.of(name))
                tries()
        assert {name: heard.of(name) for name in arrived} == arrived
        assert heard.of("") == set()  # nothing was deleted
        held.undeclare()


def test_an_identity_receives_its_declared_inputs_only(keyed):
    with keyed.joined("router_b") as everybody:
        for name in NODES:
            heard, expected = Heard(), may(name, "hears")
            with keyed.joined(name) as session:
                held = [session.declare_subscriber(key, heard.take) for key in (
                    *(f"rampart/{key}" for key in KEYS), "**", "rampart/**", "rampart/gone/*")]

                def is_there(name=name, expected=expected, heard=heard):
                    for key in (*KEYS, "nothing/declared"):
                        everybody.put(f"rampart/{key}", name)
                    return expected <= heard.of(name)

                assert wait_for(is_there), (name, expected - heard.of(name))
                assert wait_for(lambda heard=heard: everybody.put(INJECT.at(), "last")
                                or "inject/order" in heard.of("last"))  # each one hears it
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
                assert wait_for(lambda one=one: replies(everybody, one)), (name, one)
                del held
        all_answers = everybody.declare_queryable(
            "rampart/**", lambda q: q.reply(q.key_expr, "answer"), complete=True)
        for name in NODES:
            asks = may(name, "asks")
            with keyed.joined(name) as session:
                for key in sorted(asks)[:3]:
                    assert wait_for(lambda key=key: replies(session, key)), (name, key)
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
