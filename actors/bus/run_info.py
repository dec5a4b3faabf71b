"""How a tool finds the runs on this machine: it asks their launchers.

A launcher answers on an abstract unix socket, `rampart.PORT.launcher`, with one JSON object. The
kernel lists these sockets in /proc/net/unix, so no file can be stale.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.zenoh_session import endpoint, endpoints
from rampart.actors.machine.unix_peer import is_same_user, peer, process_state

REPLAY = "replay"
"""Name of the only socket in the folder of a replay, which plays all nodes."""

_NAME = re.compile(r"@rampart\.(\d+)\.launcher$", re.MULTILINE)
_TIMEOUT_S = 1.0


class RunInfo(msgspec.Struct, frozen=True):
    """What a launcher tells of its run.

    Attributes:
        origin_s: Start of simulated time, by the machine's monotonic clock.
        folder: Folder of the run.
        page: Address of the operator's page, without its token.
        plan: The part of the run's plan that a recording keeps.
        replay_of: File of a replay; "" for a run.
        host: Name of this machine; "" for the first or only one.
        keys: Folder of credentials; "" without.
        ports: Ports of the routers on loopback in a run with credentials.
        hosts: Name of the supervisor by host, the first host first; empty for a single machine.
        recording: File of `--record`; "" without one.
        recording_problem: Why the recording ended; "" if it did not.
    """

    pid: int
    base_port: int
    rate: float
    origin_s: float
    system_file: str
    folder: str
    nodes: tuple[str, ...]
    run_id: str
    hmi_port: int
    title: str
    page: str = ""
    plan: dict[str, Any] = {}
    replay_of: str = ""
    host: str = ""
    keys: str = ""
    ports: tuple[int, ...] = ()
    hosts: dict[str, str] = {}
    recording: str = ""
    recording_problem: str = ""

    def recording_data(self) -> dict[str, str] | None:
        """Return file and problem of the recording; None without a recording."""
        return {"file": self.recording, "problem": self.recording_problem
                } if self.recording else None

    @property
    def recording_in_words(self) -> str:
        """State of the recording; "" without one."""
        return f"ENDED: {self.recording_problem}" if self.recording_problem else self.recording

    @property
    def own_host(self) -> str:
        """Name of this machine; "" in a run on a single machine."""
        return self.host or next(iter(self.hosts), "")

    @property
    def endpoints(self) -> list[str]:
        """Endpoints for tools."""
        return [endpoint(self.folder, REPLAY)] if self.replay_of else endpoints(self.folder)


class NoRunError(Exception):
    """There is no run, or several without a choice. The text is one line for the user."""


def address(port: int) -> str:
    """Return the abstract socket address of the launcher of the run on a base port."""
    return f"\0rampart.{port}.launcher"


def find_runs() -> list[RunInfo]:
    """Return all runs of this machine whose launcher answers."""
    return [info for port in _ports() if (info := ask(port)) is not None]


def _ports() -> list[int]:
    try:
        table = Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return sorted(set(map(int, _NAME.findall(table))))


def find_run(port: int | None = None) -> RunInfo:
    """Return the only run, or the one on a base port. Without a port, runs go before replays.

    Raises:
        NoRunError: There is none, or there are several and no port was given.
    """
    found = find_runs()
    if port is not None:
        runs = [run for run in found if run.base_port == port]
    else:
        runs = [run for run in found if not run.replay_of] or found
    if not runs:
        if stopped := ", ".join(_stopped([port] if port is not None else _ports())):
            raise NoRunError(f"the launcher is stopped: {stopped}; `kill -CONT PID` continues it")
        known = ", ".join(str(run.base_port) for run in found) or "none"
        raise NoRunError("no run found; start one with `python launch.py`" if port is None else
                         f"--port {port}: no run there; runs found: {known}")
    if len(runs) > 1:
        listed = ", ".join(f"{r.base_port} ({r.title})" for r in runs)
        raise NoRunError(f"several runs, choose one with --port: {listed}")
    return runs[0]


def _stopped(ports: Iterable[int]) -> Iterator[str]:
    """Yield port and pid of each launcher of this user that is stopped (SIGSTOP)."""
    for port in ports:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.setblocking(False)
            with contextlib.suppress(OSError):
                connection.connect(address(port))
                pid, uid = peer(connection)
                if uid == os.getuid() and process_state(pid) == "T":
                    yield f"--port {port}, PID {pid}"


def ask(port: int) -> RunInfo | None:
    """Return the run on a base port; None if no launcher of this user answers."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(_TIMEOUT_S)
        try:
            connection.connect(address(port))
            if not is_same_user(connection):
                return None
            return read_info(connection.recv(65536))
        except (OSError, *UNREADABLE):
            return None


def answer(listener: socket.socket, info: RunInfo) -> None:
    """Send the run to one tool of this user that waits on the launcher's socket."""
    with contextlib.suppress(OSError):
        connection, _ = listener.accept()
        with connection:
            if is_same_user(connection):
                connection.send(msgspec.json.encode(info))


def read_info(data: bytes) -> RunInfo:
    """Decode the answer of a launcher.

    Raises:
        ValueError, RecursionError: The data are not a `RunInfo`.
    """
    return msgspec.json.decode(data, type=RunInfo)
