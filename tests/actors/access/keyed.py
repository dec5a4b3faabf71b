"""A router with keys in the process of a test, sessions by any certificate, what they achieve."""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zenoh

from rampart import systems
from rampart.actors.access import key_folder
from rampart.actors.access.certificates import new_authority, new_certificate
from rampart.actors.access.rules import access_of
from rampart.actors.bus.zenoh_session import Credentials, credentials_in, endpoint, session_config
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision.root import reserve_ports
from rampart.actors.system.layout import Layout
from tests import ROOT

PATIENCE_S = 20.0
STRANGER = ROOT / "tests/actors/access/tls_stranger.py"


def layout_of(system: str) -> Layout:
    plan = RunPlan(system_file=str(systems.find(system)))
    return Layout(plan, load_system(plan))


def make_keys(folder: Path, layout: Layout, addresses=()) -> Path:
    key_folder.init(folder)
    key_folder.issue(folder, tuple(layout.routers), "router", addresses)
    key_folder.issue(folder, tuple(layout.members), "node")
    key_folder.issue(folder, ("ada",), "operator")
    key_folder.issue(folder, ("bob",), "viewer")
    return folder


def every_key(layout: Layout) -> list[str]:
    """All keys of topics.md below the root, families spelt out for each member of the system."""
    table = (line.split("`")[1] for line in
             (ROOT / "topics.md").read_text().splitlines() if line.startswith("| `"))
    names = sorted((*layout.routers, *layout.members))
    return [key for row in table for key in (
        [row.replace("{name}", name) for name in names] if "{name}" in row else [row])]


def shown_by_strangers(public: Path, keys: Path, forged: str = "safety_pilot", kind: str = "node",
                       addresses: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Return what a stranger may show, by name: configurations of Zenoh's TLS.

    Args:
        public: folder for what he has: the authority's certificate, and one of his own authority
            in the name of `forged`.
        keys: folder of keys of the run.
    """
    now = dt.datetime.now(dt.UTC)
    shutil.copy(keys / "ca.crt", public / "ca.crt")
    (public / "forged.pem").write_bytes(new_certificate(
        new_authority(now, 10), forged, kind, addresses=addresses, now=now, days=5))
    for file in (public / "ca.crt", public / "forged.pem"):
        file.chmod(0o644)
    own = str(public / "forged.pem")
    return {"nothing": {},
            "no certificate": {"root_ca_certificate": str(public / "ca.crt")},
            "one of his own": {"root_ca_certificate": str(public / "ca.crt"), "enable_mtls": True,
                               "connect_private_key": own, "connect_certificate": own}}


def try_all(endpoints: Sequence[str], shown: dict[str, dict[str, Any]], keys: Sequence[str], *,
            becomes_nobody: bool = False, before: Sequence[str] = ()) -> dict[str, Any]:
    """Try everything as a stranger in a process of its own; return what came of it.

    Args:
        endpoints: where.
        shown: what is shown there, by name.
        keys: what is said and asked for.
        becomes_nobody: as another user.
        before: command line that runs another in another place.
    """
    order = {"endpoints": endpoints, "shown": shown, "keys": keys,
             "becomes_nobody": becomes_nobody}
    done = subprocess.run([*before, sys.executable, str(STRANGER)], input=json.dumps(order),
                          env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True,
                          text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@contextlib.contextmanager
def opened(config: zenoh.Config):
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()


class Keyed:
    """A router, and by whose certificate what can be done there."""

    def __init__(self, folder: str, keys: Path, layout: Layout, where: str = "127.0.0.1"):
        self.folder, self.keys, self.layout = folder, keys, layout
        self._kept = reserve_ports(9_000)
        self.port = self._kept[0].getsockname()[1]
        self.at = f"tls/{where}:{self.port}"
        self.socket = endpoint(folder, "router_a")
        self._where = where

    def shown(self, name: str) -> Credentials:
        found = credentials_in(str(self.keys), name)
        return Credentials(found.authority, found.own, {self.socket: self.at})

    def __enter__(self):
        self.router = zenoh.open(session_config(
            [self.socket], [], self.shown("router_a"), access_of(self.layout, str(self.keys))))
        return self

    def __exit__(self, *_):
        self.router.close()
        for one in self._kept:
            one.close()

    def joined(self, name: str, credentials: Credentials | None = None):
        return opened(session_config((), [self.socket], credentials or self.shown(name)))


def wait_for(what, seconds: float = PATIENCE_S) -> bool:
    end = time.monotonic() + seconds
    while not what():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True
