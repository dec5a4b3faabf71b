"""A stranger on the same machine: another user, without capabilities, who knows the program.

Run as root with a folder, the pids of the run's processes and what to do; it gives its rights away
before it does anything, and prints what it achieved as JSON.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading  # noqa: F401 zenoh imports it, and the other user cannot read the library
import time
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.bus.zenoh_session import session_config
from rampart.actors.osmosis import topics

NOBODY = 65534


def unix_sockets() -> list[str]:
    """Return the addresses of all sockets of the machine that belong to runs."""
    lines = Path("/proc/net/unix").read_text(errors="replace").splitlines()[1:]
    found = {fields[7] for line in lines if len(fields := line.split(maxsplit=7)) > 7}
    return sorted(a for a in found if "rampart" in a)


def tcp_ports() -> list[int]:
    """Return the TCP ports of the machine that somebody listens on."""
    lines = [line.split() for table in ("tcp", "tcp6")
             for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    return sorted({int(f[1].rpartition(":")[2], 16) for f in lines if f[3] == "0A"})


def knock(address: str) -> str:
    """Connect to a unix socket in each way there is, ask, and return what came of it."""
    outcomes = []
    for kind in (socket.SOCK_STREAM, socket.SOCK_SEQPACKET, socket.SOCK_DGRAM):
        with socket.socket(socket.AF_UNIX, kind) as probe:
            probe.settimeout(1)
            try:
                probe.connect(address.replace("@", "\0", 1) if address[0] == "@" else address)
                probe.send(b'{"type": "ping"}')
                outcomes.append("answered" if probe.recv(100_000) else "closed")
            except OSError as error:
                outcomes.append(type(error).__name__)
    return "answered" if "answered" in outcomes else " ".join(outcomes)


def talk_zenoh(endpoint: str, seconds: float) -> int:
    """Join by plain Zenoh, say everything to everybody, and return how much was heard."""
    heard: list[Any] = []
    try:
        session = zenoh.open(session_config((), [endpoint]))
    except zenoh.ZError:
        return 0
    with session:
        subscriber = session.declare_subscriber("**", heard.append)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for topic in topics.ALL:
                session.put(topic.at("RM1") if topic.is_family else topic.at(), b"stranger")
            time.sleep(0.05)
        subscriber.undeclare()
    return sum(sample.payload.to_bytes() != b"stranger" for sample in heard)


def squat(folder: str) -> str:
    """Try to put a socket of one's own into the folder of the run."""
    with socket.socket(socket.AF_UNIX) as own:
        try:
            own.bind(f"{folder}/router_a~")
        except OSError as error:
            return type(error).__name__
    return "bound"


def main() -> None:
    folder, names = sys.argv[1], sys.argv[2].split(",")
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    addresses = unix_sockets()
    endpoints = [f"unixsock-stream/{folder}/{name}" for name in names]
    endpoints += [f"tcp/127.0.0.1:{port}" for port in tcp_ports()]
    print(json.dumps({
        "user": os.getuid(), "knocked": {a: knock(a) for a in addresses},
        "named": {name: knock(f"{folder}/{name}") for name in names},
        "heard": sum(talk_zenoh(one, 3.0) for one in endpoints), "squatted": squat(folder),
        "listing": os.access(folder, os.R_OK | os.X_OK)}))


if __name__ == "__main__":
    main()
