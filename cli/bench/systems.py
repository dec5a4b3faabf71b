"""The Rampart systems that are measured: the peers' node, two that talk, many nodes; running them.

Each is as small as it can be: no world, no modules, so no manager. A killed node is brought back by
the supervisor, as the peers bring theirs back.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from rampart.actors.bus import run_info
from rampart.cli.bench.programs import BenchError, Line, Program, of_ours

START_S = 60.0
"""Wall seconds that anything may take to start."""

_HEAD = '''name = "{name}"
title = "{title}"

[timing]
heartbeat_timeout_s = 0.5
command_timeout_s = 0.5
localization_timeout_s = 0.5
scan_timeout_s = 0.5
dead_man_timeout_s = 0.5
manager_timeout_s = 0.5
detection_silence_timeout_s = 0.9

# All are killed again and again, which is no sign that something is wrong with them.
[supervision]
intensity = 10000

[orders.safer]

[[event]]
name = "none"
'''

BESIDES = 7
"""Processes of a system that are none of its nodes: the root, the process that watches the run, the
supervisor, two routers, and two of the pool."""


def peers_system(command: Sequence[str]) -> str:
    """Return a system with the peers' node: an actor, and a command."""
    return _HEAD.format(name="bench_peers", title="The peers' node") + f'''
[[node]]
name = "source"
actor = "rampart.cli.bench.actors:Source"
kind = "non-control"

[[node]]
name = "actor"
actor = "rampart.cli.bench.actors:Worker"
kind = "control"

[[node]]
name = "command"
command = {json.dumps(list(command))}
kind = "control"
env = {{ OPENBLAS_NUM_THREADS = "1", OMP_NUM_THREADS = "1" }}
'''


def talking_system() -> str:
    """Return a system of two nodes of which one asks and the other answers."""
    return _HEAD.format(name="bench_talk", title="Two that talk") + "".join(
        f'\n[[node]]\nname = "{name}"\nactor = "rampart.cli.bench.actors:{kind}"\n'
        'kind = "control"\n' for name, kind in (("asker", "Asker"), ("answerer", "Answerer")))


def sized_system(processes: int) -> str:
    """Return a system of so many processes, `BESIDES` included; each hears the two before it."""
    names = [f"n{i}" for i in range(processes - BESIDES)]
    heard = [[f"bench/tick/{names[i - back]}" for back in (1, 2) if names[i - back] != name]
             for i, name in enumerate(names)]
    return _HEAD.format(name="bench_size", title=f"{processes} processes") + "".join(
        f'\n[[node]]\nname = "{name}"\nactor = "rampart.cli.bench.actors:Ticker"\n'
        f'kind = "control"\nparameters = {{ hears = {json.dumps(keys)} }}\n'
        for name, keys in zip(names, heard, strict=True))


class System:
    """A Rampart system that runs, and an observer in it; a context manager.

    Args:
        file: Its specification.
        folder: For what it keeps.
        first: Keys of which the first message of each process is observed.
        changes: Keys of which each message that says something new is.
        keys: Folder of keys; "" for none.

    Attributes:
        port: Its base port.
        ear: The observer; its lines are those of `observer.Heard`.
        start_s: From the command until all of its processes ran.

    Raises:
        BenchError: It cannot be started.
    """

    def __init__(self, file: Path, folder: Path, first: Sequence[str] = (),
                 changes: Sequence[str] = (), keys: str = "") -> None:
        self.port = free_port()
        begun_s = time.monotonic()
        with contextlib.ExitStack() as running:
            self.program = running.enter_context(Program(file.stem, of_ours(
                "system_process", str(self.port), str(file), str(folder / "checkpoints"), keys),
                folder))
            self.program.wait_for(_begun, START_S, "its sockets")
            ran_s = self.program.wait_for(_running, START_S, "the last of its processes")
            self.start_s = ran_s - begun_s
            heard = [("--first", key) for key in first] + [("--changes", key) for key in changes]
            self.ear = running.enter_context(observer(
                "system", str(self.port), *(word for pair in heard for word in pair)))
            self._running = running.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._running.close()


def observer(*arguments: str) -> Program:
    """Start an observer, and return it when it hears.

    Raises:
        BenchError: it cannot be started.
    """
    with contextlib.ExitStack() as running:
        program = running.enter_context(Program(
            "the observer", of_ours("observer", *arguments), Path.cwd()))
        program.wait_for(lambda line: line.text == "ready" or None, START_S, "its first line")
        running.pop_all()
    return program


def _begun(line: Line) -> bool | None:
    if line.text.startswith("error: "):
        raise BenchError(line.text.removeprefix("error: "))
    return line.text == "begun" or None


def _running(line: Line) -> float | None:
    return line.at_s if line.text == "running" else None


def free_port() -> int:
    """Return a base port that no run has.

    Raises:
        BenchError: all that were looked at are taken.
    """
    for port in range(20_000 + os.getpid() % 5_000, 32_000):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe, \
                contextlib.suppress(OSError):
            probe.bind(run_info.address(port))
            return port
    raise BenchError("no base port is free")
