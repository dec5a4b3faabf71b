"""The node's end of a command: starts its keeper, and hears what becomes of it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rampart.actors.foreign import keeper
from rampart.actors.machine import turns
from rampart.manager.spec.nodes import ChildLimits

GRACE_S = 0.3
"""Wall seconds that a command has to end in order, when it is asked to by SIGTERM."""

_KEEPER_END_S = keeper.END_S + GRACE_S
_ANSWER_BYTES = 8192


class CommandError(Exception):
    """A command cannot be started, or has ended; the text is one line."""


class Child:
    """One command, from its start to its end.

    Args:
        told: called on the event loop with what goes wrong: why it cannot be started, or how it
            has ended. Once.
    """

    def __init__(self, told: Callable[[str], None]) -> None:
        self._told = told
        self._keeper: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._text = b""

    def start(self, *, who: str, command: Sequence[str], folder: Path,
              environment: Mapping[str, str], limits: ChildLimits, log: Path,
              inherited: Sequence[int]) -> None:
        """Start it.

        Args:
            who: what its output is kept as.
            command: program and arguments.
            folder: in which it runs.
            environment: all of it.
            limits: what it may use.
            log: file for its output.
            inherited: descriptors that it gets.

        Raises:
            CommandError: not even its keeper can be started.
        """
        order = keeper.Order(who, list(command), str(folder), dict(environment), _by_name(limits),
                             list(inherited), str(log), GRACE_S)
        mine, other = socket.socketpair()
        with other:
            try:
                with turns.usual():
                    self._keeper = subprocess.Popen(  # noqa: S603 our own interpreter and file
                        [sys.executable, "-I", "-S", keeper.__file__, str(other.fileno())],
                        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                        start_new_session=True, pass_fds=[other.fileno(), *inherited])
            except OSError as error:
                mine.close()
                raise CommandError(f"its keeper cannot be started: {error.strerror}") from None
        self._control = mine
        with contextlib.suppress(OSError):  # of a keeper that has ended; that is heard below
            mine.sendall(json.dumps(order._asdict()).encode() + b"\n")
        mine.setblocking(False)
        asyncio.get_running_loop().add_reader(mine, self._hear, mine)

    def end(self) -> None:
        """Ask it to end, and return when nothing of it is left; waits `GRACE_S` and little more."""
        control, self._control = self._control, None
        if control is not None:
            asyncio.get_running_loop().remove_reader(control)
            with contextlib.suppress(OSError):
                control.send(b"stop\n")
        if self._keeper is not None:
            try:
                self._keeper.wait(_KEEPER_END_S)
            except subprocess.TimeoutExpired:
                self._keeper.kill()
                self._keeper.wait()
        if control is not None:
            control.close()

    def _hear(self, control: socket.socket) -> None:
        try:
            said = control.recv(_ANSWER_BYTES)
        except BlockingIOError:
            return
        except OSError:
            said = b""
        self._text += said
        while b"\n" in self._text:
            line, _, self._text = self._text.partition(b"\n")
            answer: dict[str, Any] = json.loads(line)
            if "ended" in answer:
                self._over(control, f"ended: {keeper.in_words(answer['ended'])}")
            elif "error" in answer:
                self._over(control, answer["error"])
        if not said:
            self._over(control, "ended: its keeper is gone")

    def _over(self, control: socket.socket, why: str) -> None:
        if self._control is not None:
            self._control = None
            asyncio.get_running_loop().remove_reader(control)
            control.close()
            self._told(why)


def _by_name(limits: ChildLimits) -> dict[str, int]:
    """Return limits as setrlimit(2) has them."""
    megabyte = 1_000_000
    said = {"RLIMIT_AS": (limits.memory_mb, megabyte), "RLIMIT_CPU": (limits.processor_s, 1),
            "RLIMIT_NOFILE": (limits.open_files, 1), "RLIMIT_FSIZE": (limits.file_mb, megabyte)}
    return {name: math.ceil(most * unit) for name, (most, unit) in said.items() if most is not None}


def environment(added: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a command: this process's, what the system adds, what is its own.

    Without the search path for modules, by which the processes of a run find this Rampart: another
    virtual environment has its own.
    """
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return {**inherited, **added, **own}
