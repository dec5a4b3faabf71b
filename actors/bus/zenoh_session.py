"""How Zenoh sessions are configured and opened, and where the routers of a run listen."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.bus.run_folder import ROUTERS, socket_path
from rampart.actors.machine.unix_peer import peer, process_state

AUTHORITY = "ca.crt"
"""In a folder of keys: the certificate of the authority."""

NEAR_LEASE_MS, FAR_LEASE_MS = 86_400_000, 2000
"""A link that is silent for so long is closed. Within a host the kernel closes the links of a
process that ends, and the supervisor finds a stopped one. A shorter lease would only close all
links in a pause of everybody, and the run would be deaf until they are open again. A session that
is linked to another host has the far lease: a cut cable closes no link.
"""

HANDSHAKE_MS = 300
"""A handshake that takes longer is given up on either side: what connects and says nothing holds
one of the hundred places that Zenoh has for handshakes no longer than this."""

FAR_HANDSHAKE_MS = 2000
"""Of a router that other hosts are linked to: four messages, some of which may be lost."""

_SOCKET_BYTES, _FAR_SOCKET_BYTES = 16_384, 65_536
"""What the kernel keeps for a TCP socket on either side; it takes twice that. Left to itself it
keeps megabytes: what a flooding member with a key had sent stood before an emergency stop for 0.4
s. Between hosts it is what may be under way: with 0.1 s there and back 1 MB a second."""

_NOT_FATAL = "exit_on_failure=false"

FULL_US = 20_000
"""A link that takes nothing for so long is closed, microseconds, when there is something to be sent
that may not be left out: declarations of who is new. While a router waits for one reader, which is
stopped or cut off, no other hears anything, and by default it waits for 5 s."""

_ROOM = {"interactive_high": 16, "data": 16}
_ROOM_US = 5_000
"""How much may wait for a link, in batches of 64 kB, and how long what finds no room waits before
it is left out. A message is a batch of its own, so that it goes at once: with the two batches that
Zenoh has by default, 51 of 720 answers of 24 nodes to the same message were lost, now none. Once a
link is full nobody waits for it until it has taken something.
"""

_RUNTIME = "ZENOH_RUNTIME"
_THREADS = ("(app: (worker_threads: 1), tx: (worker_threads: 1), rx: (handover: app), "
            "acc: (handover: app), net: (handover: app))")
"""Of Zenoh in a client: one that reads and one that writes. By default a thread that waits for
sockets wakes one of two others for each message that has come, which reads it. Reading and writing
on one thread is no choice: most nodes were never heard then.
"""
_ROUTER_THREADS = "(acc: (handover: rx))"
"""Of Zenoh in a router: those that read wait for the sockets as well. By default another thread
does, and wakes them for each message: a quarter of what a router costs. It keeps several threads
for reading, and others for the rest: many links come and go there, and Zenoh holds locks while it
waits for other tasks.
"""

_REDIAL_MS = {"period_init_ms": 10, "period_max_ms": 40, "period_increase_factor": 1.5}

_PROTOCOL = "unixsock-stream"


def endpoint(folder: str, name: str) -> str:
    """Return the Zenoh endpoint of a node in the folder of a run."""
    return f"{_PROTOCOL}/{socket_path(folder, name)}"


def endpoints(folder: str) -> list[str]:
    """Return the endpoints of the routers in the folder of a run."""
    return [endpoint(folder, name) for name in ROUTERS]


@dataclass(frozen=True, slots=True)
class Credentials:
    """By what a session shows who it is, and knows whom it has reached: mutual TLS.

    Attributes:
        authority: file with the certificate of the authority that everybody's has to be of.
        own: file with the session's own private key and certificate.
        doors: by the socket of a router in the folder of the run, where it is spoken with. The
            socket says no more than that the router is there: by it nobody may anything.
    """

    authority: str
    own: str
    doors: Mapping[str, str] = field(default_factory=dict)

    def door(self, where: str) -> str:
        """Return where a router is spoken with."""
        return self.doors.get(where, where)

    def settings(self) -> dict[str, Any]:
        """Return what Zenoh has to know."""
        tls = "transport/link/tls"
        return {f"{tls}/root_ca_certificate": self.authority, f"{tls}/enable_mtls": True,
                **{f"{tls}/{way}_{what}": self.own for way in ("listen", "connect")
                   for what in ("private_key", "certificate")},
                f"{tls}/close_link_on_expiration": True}


def credentials_in(keys: str, name: str, folder: str = "",
                   ports: Sequence[int] = ()) -> Credentials | None:
    """Return the credentials of an identity; None in a run without keys.

    Args:
        keys: folder of keys; "" for none.
        name: of the identity.
        folder: of the run.
        ports: of loopback, on which its routers are spoken with.
    """
    if not keys:
        return None
    doors = {endpoint(folder, router): f"tls/127.0.0.1:{port}"
             for router, port in zip(ROUTERS, ports, strict=False)}
    return Credentials(f"{keys}/{AUTHORITY}", key_file(keys, name), doors)


def key_file(keys: str, name: str) -> str:
    """Return the file in a folder of keys with the private key of an identity, and certificate."""
    return f"{keys}/{name}.pem"


def session_config(listen: Sequence[str], dial: Sequence[str],
                   credentials: Credentials | None = None,
                   access: Mapping[str, Any] | None = None) -> zenoh.Config:
    """Return the configuration of a session that finds others only where it is told.

    Args:
        listen: where a router listens, in the folder first; none for a client. It goes on
            without the others: an address that is not there now may come.
        dial: a client goes to the first of these that answers, a router to all, again and again.
        credentials: None in a run without keys.
        access: what a router lets through, as `rampart.actors.access.rules` has it; None for
            everything.
    """
    config = zenoh.Config()
    near = list(listen[:1])
    is_far = len(listen) > 1 or any(one.startswith(("tcp/", "tls/")) for one in dial)
    handshake_ms = FAR_HANDSHAKE_MS if is_far else HANDSHAKE_MS
    if credentials is not None:
        near = list(dict.fromkeys((*map(credentials.door, near), *near)))
        dial = [credentials.door(one) for one in dial]
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client",
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


def open_client(dial: Sequence[str], credentials: Credentials | None = None) -> zenoh.Session:
    """Open the session of a client of the first router that answers.

    Raises:
        ZError: none does.
    """
    return _open(session_config((), dial, credentials))


def open_router(listen: Sequence[str], dial: Sequence[str], credentials: Credentials | None,
                access: Mapping[str, Any] | None) -> zenoh.Session:
    """Open the session of a router; see `session_config`.

    Raises:
        ZError: an endpoint is in use, or invalid.
    """
    return _open(session_config(listen, dial, credentials, access), _ROUTER_THREADS)


def open_alone(credentials: Credentials | None = None) -> zenoh.Session:
    """Open a session without any link; the next one of this process opens sooner."""
    config = session_config((), [], credentials)
    config.insert_json5("mode", '"peer"')
    return _open(config)


def _open(config: zenoh.Config, threads: str = _THREADS) -> zenoh.Session:
    if _RUNTIME in os.environ:
        return zenoh.open(config)
    os.environ[_RUNTIME] = threads  # read when a process opens its first session
    try:
        return zenoh.open(config)
    finally:
        del os.environ[_RUNTIME]  # commands that this process starts have their own
