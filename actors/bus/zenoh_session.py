"""How Zenoh sessions are configured and opened, and where the routers of a run listen."""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.machine.unix_peer import peer, process_state

AUTHORITY = "ca.crt"
"""Certificate of the authority in a folder of credentials."""

NEAR_LEASE_MS, FAR_LEASE_MS = 86_400_000, 2000
"""Silence after which Zenoh closes a link. Within a host the kernel closes the links of a process
that ends, and the supervisor finds a stopped one. A shorter lease would only close all links when
the whole machine pauses. A session that is linked to another host has the far lease, because a cut
cable closes no link.
"""

HANDSHAKE_MS = 300
"""Longest handshake. Zenoh has a hundred places for handshakes, and a silent client holds one."""

FAR_HANDSHAKE_MS = 2000
"""Longest handshake of a router that is linked to other hosts: four messages may be lost."""

_SOCKET_BYTES, _FAR_SOCKET_BYTES = 16_384, 65_536
"""Kernel buffer of a TCP socket in each direction; the kernel doubles it. With the kernel's
default of megabytes, the backlog of a flooding client with a key delayed an emergency stop by
0.4 s. Between hosts the buffer limits throughput: 1 MB/s at a round-trip time of 0.1 s.
"""

_NOT_FATAL = "exit_on_failure=false"

FULL_US = 20_000
"""Zenoh closes a link that takes nothing for this long, microseconds, if a message that must not be
dropped is waiting for it, such as a declaration. While a router waits for one stopped reader, it
serves no other client. Zenoh's default is 5 s.
"""

_ROOM = {"interactive_high": 16, "data": 16}
_ROOM_US = 5_000
"""Queue of a link in batches of 64 kB, and how long one waits for room.

A message is a batch, so that it leaves at once. With Zenoh's default of two batches, 51 of 720
answers of 24 nodes to the same message were lost; with 16, none. Zenoh does not wait for a full
link again until that link has taken something.
"""

_RUNTIME = "ZENOH_RUNTIME"
_THREADS = ("(app: (worker_threads: 1), tx: (worker_threads: 1), rx: (handover: app), "
            "acc: (handover: app), net: (handover: app))")
"""Zenoh's threads in a client: one reads and one writes. By default one thread waits for sockets
and wakes another, which reads, for each message. With one thread for reading and writing, the
messages of most nodes never arrived.
"""
_ROUTER_THREADS = "(acc: (handover: rx))"
"""Zenoh's threads in a router: those that read also wait for the sockets. By default a further
thread does, and its wake-ups take a quarter of a router's processor time. Reading keeps several
threads, because links come and go and Zenoh holds locks while it waits for other tasks.
"""

_REDIAL_MS = {"period_init_ms": 10, "period_max_ms": 40, "period_increase_factor": 1.5}

_PROTOCOL = "unixsock-stream"


def endpoint(folder: str, name: str) -> str:
    """Return the Zenoh endpoint of a socket in the folder of a run."""
    return f"{_PROTOCOL}/{folder}/{name}"


def endpoints(folder: str) -> list[str]:
    """Return the endpoints of the routers in the folder of a run."""
    return [endpoint(folder, name) for name in ROUTERS]


@dataclass(frozen=True, slots=True)
class Credentials:
    """Certificates for mutual TLS, by which a session authenticates itself and its router.

    Attributes:
        authority: File with the certificate of the authority that issued all others.
        own: File with the session's private key and certificate.
        doors: TLS endpoint of a router by its socket in the run's folder. In a run with
            credentials the socket only shows that the router exists and grants no right.
    """

    authority: str
    own: str
    doors: Mapping[str, str] = field(default_factory=dict)

    def door(self, where: str) -> str:
        """Return the TLS endpoint of a router, or the endpoint itself if it has none."""
        return self.doors.get(where, where)

    def settings(self) -> dict[str, Any]:
        """Return the settings of Zenoh."""
        tls = "transport/link/tls"
        return {f"{tls}/root_ca_certificate": self.authority, f"{tls}/enable_mtls": True,
                **{f"{tls}/{way}_{what}": self.own for way in ("listen", "connect")
                   for what in ("private_key", "certificate")},
                f"{tls}/close_link_on_expiration": True}


def credentials_in(keys: str, name: str, folder: str = "",
                   ports: Sequence[int] = ()) -> Credentials | None:
    """Return the credentials of an identity; None in a run without credentials.

    Args:
        keys: Folder of credentials; "" for none.
        name: Name of the identity.
        folder: Folder of the run.
        ports: Ports of the run's routers on loopback.
    """
    if not keys:
        return None
    doors = {endpoint(folder, router): f"tls/127.0.0.1:{port}"
             for router, port in zip(ROUTERS, ports, strict=False)}
    return Credentials(f"{keys}/{AUTHORITY}", key_file(keys, name), doors)


def key_file(keys: str, name: str) -> str:
    """Return the file with private key and certificate of an identity."""
    return f"{keys}/{name}.pem"


def session_config(listen: Sequence[str], dial: Sequence[str],
                   credentials: Credentials | None = None,
                   access: Mapping[str, Any] | None = None) -> zenoh.Config:
    """Return the configuration of a session that connects only where it is told.

    Args:
        listen: Endpoints of a router, the one in the run's folder first; none for a client. The
            router starts without the others if their addresses do not exist yet.
        dial: Routers. A client connects to the first one that answers, a router to all of them,
            again and again. A session without routers is a peer without links.
        credentials: None in a run without credentials.
        access: Rules of a router, from `rampart.actors.access.rules`; None allows everything.
    """
    config = zenoh.Config()
    near = list(listen[:1])
    is_far = len(listen) > 1 or any(each.startswith(("tcp/", "tls/")) for each in dial)
    handshake_ms = FAR_HANDSHAKE_MS if is_far else HANDSHAKE_MS
    if credentials is not None:
        near = list(dict.fromkeys((*map(credentials.door, near), *near)))
        dial = [credentials.door(each) for each in dial]
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client" if dial else "peer",
        "listen/endpoints": [*near, *(f"{far}#{_NOT_FATAL}" for far in listen[1:])],
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
        "transport/link/tx/lease": FAR_LEASE_MS if is_far else NEAR_LEASE_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": FULL_US,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _ROOM_US,
        **{f"transport/link/tx/queue/size/{kind}": room for kind, room in _ROOM.items()},
        **{f"transport/link/{link}/so_{side}buf": _FAR_SOCKET_BYTES if is_far else _SOCKET_BYTES
           for link in ("tcp", "tls") for side in ("snd", "rcv")},
        **(credentials.settings() if credentials is not None else {}),
        **({"access_control": access} if access is not None else {})}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def answering_first(dial: Sequence[str]) -> list[str]:
    """Return endpoints, those with a process that is not stopped first and the oldest in front.

    The list is empty if none has such a process.
    """
    found: dict[str, int] = {}
    for each in dial:
        path = each.removeprefix(f"{_PROTOCOL}/")
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.setblocking(False)
            probe.connect(path)  # raises also if the backlog is full
            if process_state(peer(probe)[0]) not in "TtX":
                found[each] = Path(path).stat().st_mtime_ns
    return sorted(dial, key=lambda each: found.get(each, math.inf)) if found else []


def open_session(dial: Sequence[str], credentials: Credentials | None = None,
                 listen: Sequence[str] = (),
                 access: Mapping[str, Any] | None = None) -> zenoh.Session:
    """Open the session of a client, or of a router if it listens; see `session_config`.

    Raises:
        ZError: No router answers the client, or an endpoint is in use or invalid.
    """
    # Zenoh reads it when a process opens its first session.
    os.environ[_RUNTIME] = _ROUTER_THREADS if listen else _THREADS
    try:
        return zenoh.open(session_config(listen, dial, credentials, access))
    finally:
        del os.environ[_RUNTIME]  # so that commands started by this process do not inherit it
