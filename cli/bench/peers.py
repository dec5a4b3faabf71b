"""Who else keeps a process alive: each peer as it is configured for a prompt restart.

All run the same program, `peer_node.py`, with the same interpreter, and none has a dependency but
its own. Peers are no part of Rampart: `make bench-peers` installs them for the benchmark, into an
environment of their own.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from rampart.cli.bench.programs import Program

INSTALL = "not installed: make bench-peers"

_LOOP = '''
import subprocess, sys
while True:
    code = subprocess.run(sys.argv[1:]).returncode
    print("ended", code, flush=True)
'''


class Peer(NamedTuple):
    """A peer.

    Attributes:
        name: As it is chosen on the command line.
        title: With what is configured.
        program: That has to be installed; "" for none.
        package: It is in.
        started: Makes its configuration in a folder, for a command, and returns what starts it.
        detected: Is found in what it prints as soon as the node has ended.
    """

    name: str
    title: str
    program: str
    package: str
    started: Callable[[Path, Sequence[str], str], list[str]]
    detected: re.Pattern[str]


def _loop(_folder: Path, node: Sequence[str], _program: str) -> list[str]:
    return [sys.executable, "-I", "-S", "-c", _LOOP, *node]


def _supervisord(folder: Path, node: Sequence[str], program: str) -> list[str]:
    file = folder / "supervisord.conf"
    file.write_text(f"""[supervisord]
nodaemon = true
logfile = /dev/null
logfile_maxbytes = 0
pidfile = {folder}/pid
[program:node]
command = {shlex.join(node)}
autorestart = true
startsecs = 0
stdout_logfile = NONE
stderr_logfile = NONE
stopsignal = KILL
""", encoding="utf-8")
    return [program, "-c", str(file)]


def _circus(folder: Path, node: Sequence[str], program: str) -> list[str]:
    file = folder / "circus.ini"
    file.write_text(f"""[circus]
check_delay = 0.1
endpoint = ipc://{folder}/endpoint
pubsub_endpoint = ipc://{folder}/pubsub
[watcher:node]
cmd = {shlex.join(node)}
copy_env = True
graceful_timeout = 0.5
""", encoding="utf-8")
    return [program, "--log-level", "debug", str(file)]


def _dora(folder: Path, node: Sequence[str], program: str) -> list[str]:
    file = folder / "dataflow.yml"
    file.write_text(json.dumps({"nodes": [{
        "id": "node", "path": node[0], "args": " ".join(node[1:]), "restart_policy": "always",
        "max_restarts": 0}]}), encoding="utf-8")  # JSON is YAML
    return [program, "run", str(file)]


PEERS = {peer.name: peer for peer in (
    Peer("dora", "dora-rs, restart_policy: always", "dora", "dora-rs-cli", _dora,
         re.compile(r"restarting node after|node exited with error")),
    Peer("supervisord", "supervisord, autorestart, startsecs 0", "supervisord", "supervisor",
         _supervisord, re.compile(r"\bexited: node\b")),
    Peer("circus", "circus, check_delay 0.1 s instead of 5 s", "circusd", "circus", _circus,
         re.compile(r"reaping process")),
    Peer("subprocess", "a loop round subprocess.run", "", "", _loop, re.compile(r"^ended")),
)}
"""By name."""

ACTOR, COMMAND = "rampart-actor", "rampart-command"
OURS = {ACTOR: "Rampart, the node as an actor",
        COMMAND: "Rampart, the same program as a command"}
"""How Rampart keeps the node, by name, as on the command line."""

KEEPERS = (*PEERS, *OURS)


def node_command(name: str, endpoint: str) -> list[str]:
    """Return the command of the node that says its output under a name."""
    program = Path(__file__).resolve().parent / "processes" / "peer_node.py"
    return [sys.executable, "-P", str(program), name, endpoint]


def start(peer: Peer, folder: Path, endpoint: str, installed: Path) -> Program | None:
    """Start a peer with its node; None if it is not installed.

    Args:
        peer: which.
        folder: for its configuration; it is made.
        endpoint: of the bus.
        installed: environment in which peers are installed.

    Raises:
        BenchError: it cannot be started.
    """
    found = installed.resolve() / "bin" / peer.program
    if peer.program and not found.is_file():
        return None
    folder.mkdir()
    command = peer.started(folder, node_command(peer.name, endpoint), str(found))
    return Program(peer.name, command, folder)


def version(peer: Peer, installed: Path) -> str:
    """Return the version of an installed peer, with a space before it; "" of what has none."""
    if not peer.package:
        return ""
    folder = next(installed.glob("lib/python*/site-packages"), installed)
    found = metadata.distributions(name=peer.package, path=[str(folder)])
    return next((f" ({one.version})" for one in found), "")
