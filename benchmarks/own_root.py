"""A root of a run that is a child of this process, for benchmarks and tests without `launch.py`."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys

from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.launcher import Launcher
from rampart.files import working_folder

_ROOT = """
import socket, sys
from rampart.actors.supervision.root import Root
from rampart.files import streams, working_folder
working_folder.admit()
streams.secure()
Root().serve(socket.socket(fileno=int(sys.argv[1])))
"""


def new_root() -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start a root; return its process and the connection, with which it ends."""
    ours, theirs = socket.socketpair()
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _ROOT, str(theirs.fileno())], stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()], process_group=0, env=working_folder.environment())
    return process, ours


class OwnLauncher(Launcher):
    """A launcher that starts its root."""

    def __init__(self, plan: RunPlan, title: str) -> None:
        self._process, link = new_root()
        super().__init__(plan, title, link)

    async def end(self) -> None:
        """End the run, and wait for the root."""
        await super().end()
        await asyncio.to_thread(self._process.wait)
