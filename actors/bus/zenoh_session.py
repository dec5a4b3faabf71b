"""How Zenoh sessions are configured and opened, and where the routers of a run listen."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.bus.run_folder import ROUTERS, socket_path
from rampart.actors.bus.unix_peer import peer, process_state

LEASE_MS = 2000
"""A link that is silent for so long is closed; a stopped process is found sooner by heartbeat."""

HANDSHAKE_MS = 300
"""A handshake that takes longer is given up on either side: what connects and says nothing holds
one of the hundred places that Zenoh has for handshakes no longer than this."""

FAR_HANDSHAKE_MS = 2000
"""Of a router that other hosts are linked to: four messages, some of which may be lost."""

_NOT_FATAL = "exit_on_failure=false"

FULL_US = 20_000
"""A link that takes nothing for so long is closed, microseconds: its reader is stopped, or cut off.
By default a session waits for 5 s when it has something to send that may not be left out, and while
a router waits for one reader, no other hears anything."""

_RUNTIME = "ZENOH_RUNTIME"
_THREADS = ("(app: (worker_threads: 1), tx: (worker_threads: 1), rx: (handover: app), "
            "acc: (handover: app), net: (handover: app))")
"""Of Zenoh in a client: one that reads and one that writes. By default a thread that waits for
sockets wakes one of two others for each message that has come, which reads it. Reading and writing
on one thread is no choice: most nodes were never heard then. Routers keep a thread for each
task: many links come and go there, and Zenoh holds locks while it waits for other tasks.
"""

_REDIAL_MS = {"period_init_ms": 10, "period_max_ms": 40, "period_increase_factor": 1.5}

_PROTOCOL = "unixsock-stream"


def endpoint(folder: str, name: str) -> str:
    """Return the Zenoh endpoint of a node in the folder of a run."""
    return f"{_PROTOCOL}/{socket_path(folder, name)}"


def endpoints(folder: str) -> list[str]:
    """Return the endpoints of the routers in the folder of a run."""
    return [endpoint(folder, name) for name in ROUTERS]


def session_config(listen: Sequence[str], dial: Sequence[str]) -> zenoh.Config:
    """Return the configuration of a session that finds others only where it is told.

    Args:
        listen: where a router listens, in the folder first; none for a client. It goes on
            without the others: an address that is not there now may come.
        dial: a client goes to the first of these that answers, a router to all, again and again.
    """
    config = zenoh.Config()
    is_far = any(not one.startswith(_PROTOCOL) for one in (*listen, *dial))
    handshake_ms = FAR_HANDSHAKE_MS if is_far else HANDSHAKE_MS
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client",
        "listen/endpoints": [*listen[:1], *(f"{far}#{_NOT_FATAL}" for far in listen[1:])],
        "listen/exit_on_failure": True,
        "connect/endpoints": list(dial),
        "connect/timeout_ms": -1 if listen else 0,  # in the background, or each once
        "connect/retry": _REDIAL_MS,
        "connect/exit_on_failure": False,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,  # a SIGKILL would leave its segment behind
        "transport/unicast/open_timeout": handshake_ms,
        "transport/unicast/accept_timeout": handshake_ms,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": FULL_US}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def answering(where: Sequence[str]) -> list[str]:
    """Return the endpoints at which there is a process that is not stopped, the oldest first."""
    found = []
    for one in where:
        path = one.removeprefix(f"{_PROTOCOL}/")
        with socket.socket(socket.AF_UNIX) as probe:
            probe.setblocking(False)
            try:
                probe.connect(path)
                if process_state(peer(probe)[0]) not in "TtX":
                    found.append((Path(path).stat().st_mtime_ns, one))
            except OSError:  # none, or so many wait to be let in that none is
                continue
    return [one for _, one in sorted(found)]


def open_client(dial: Sequence[str]) -> zenoh.Session:
    """Open the session of a client of the first router that answers.

    Raises:
        ZError: none does.
    """
    if _RUNTIME in os.environ:
        return zenoh.open(session_config((), dial))
    os.environ[_RUNTIME] = _THREADS  # read when a process opens its first session
    try:
        return zenoh.open(session_config((), dial))
    finally:
        del os.environ[_RUNTIME]  # commands that this process starts have their own
