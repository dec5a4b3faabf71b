"""A router with keys in the process of a test, sessions by any certificate, what they achieve."""

from collections.abc import Iterable
from pathlib import Path

import zenoh

from rampart import systems
from rampart.actors.access import key_folder
from rampart.actors.access.rules import access_of
from rampart.actors.bus.zenoh_session import Credentials, credentials_in, endpoint, session_config
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision.root import reserve_ports
from rampart.actors.system.layout import Layout
from tests import ROOT


def layout_of(system: str) -> Layout:
    plan = RunPlan(system_file=str(systems.find(system)))
    return Layout(plan, load_system(plan))


def make_keys(folder: Path, layout: Layout) -> Path:
    key_folder.init(folder)
    key_folder.issue(folder, tuple(layout.routers), "router")
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


def covered(keys: Iterable[str], expressions: Iterable[str]) -> set[str]:
    """Those of some keys below the root that one of the expressions includes."""
    wanted = [zenoh.KeyExpr(one) for one in expressions]
    return {key for key in keys
            if any(one.includes(zenoh.KeyExpr(f"rampart/{key}")) for one in wanted)}


class Keyed:
    """A router, and by whose certificate what can be done there."""

    def __init__(self, folder: str, keys: Path, layout: Layout):
        self.folder, self.keys, self.layout = folder, keys, layout
        self._kept = reserve_ports(9_000)
        self.port = self._kept[0].getsockname()[1]
        self.at = f"tls/127.0.0.1:{self.port}"
        self.socket = endpoint(folder, "router_a")

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
        return zenoh.open(session_config((), [self.socket], credentials or self.shown(name)))
