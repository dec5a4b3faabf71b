"""Ends of processes as the kernel tells them: pidfd_open(2), which works for other's children."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Hashable

from rampart.actors.bus.unix_peer import ProcessId, process_id


class ProcessEnds:
    """Hears of the ends of processes of this machine, on the running loop, each once."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._held: dict[Hashable, int] = {}

    def hold(self, name: Hashable, process: ProcessId, ended: Callable[[], None]) -> None:
        """Have `ended` called when a process ends; not for one that is held, or is gone already.

        Without a descriptor left to hold it by it is not: there are other signs.
        """
        if name in self._held:
            return
        try:
            descriptor = os.pidfd_open(process.pid)
        except OSError:
            return
        if process_id(process.pid) != process:  # looked at last: now its number stays its own
            os.close(descriptor)
            return
        self._held[name] = descriptor

        def readable() -> None:
            self.let_go(name)
            ended()

        self._loop.add_reader(descriptor, readable)

    def let_go(self, name: Hashable) -> None:
        """Hear no more of one; harmless if it is not held."""
        descriptor = self._held.pop(name, -1)
        if descriptor >= 0:
            self._loop.remove_reader(descriptor)
            os.close(descriptor)

    def close(self) -> None:
        """Hear no more of any."""
        for name in list(self._held):
            self.let_go(name)
