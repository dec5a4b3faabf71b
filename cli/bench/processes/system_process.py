"""One Rampart system without a judge, for as long as it is measured: a process of its own.

`system_process.py PORT SYSTEM CHECKPOINTS KEYS` prints `begun` when the system's sockets are
there, and `running` when all of its processes are. It ends when its stdin closes, or at SIGTERM.
"""

from __future__ import annotations

import asyncio
import signal
import sys

from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import NodeState, NodeTable
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan
from rampart.actors.supervision.launcher import Launcher, LaunchError
from rampart.files import working_folder


class Watch(Actor):
    """Says when all is running."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._said = False

    @on(topics.NODES)
    def nodes(self, table: NodeTable, _header: Header) -> None:
        """Take the supervisor's table."""
        if not self._said and all(node.state is NodeState.RUNNING for node in table.nodes):
            self._said = True
            print("running", flush=True)


async def run(port: int, system: str, checkpoints: str, keys: str) -> None:
    """Run a system until stdin closes.

    Raises:
        LaunchError: it cannot be started.
    """
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, over.set)
    await loop.connect_read_pipe(lambda: _UntilClosed(over), sys.stdin)
    launcher = Launcher(RunPlan("bench", port, system_file=system, checkpoints=checkpoints,
                                keys=keys), "benchmark")
    try:
        await launcher.load()
        await launcher.start()
        print("begun", flush=True)
        bus, clock = launcher.observers_bus(), Clock(launcher.plan.origin_s)
        watch = Watch(Context(OBSERVER, 1, clock, bus))
        task = asyncio.create_task(watch.run())
        await over.wait()
        watch.stop()
        await task
    finally:
        await launcher.end()


class _UntilClosed(asyncio.Protocol):
    def __init__(self, over: asyncio.Event) -> None:
        self._over = over

    def connection_lost(self, _error: Exception | None) -> None:
        """Say that whoever has started this is gone."""
        self._over.set()


def main() -> int:
    """Run what the command line says."""
    working_folder.admit()
    try:
        asyncio.run(run(int(sys.argv[1]), *sys.argv[2:5]))
    except (LaunchError, ValueError, OSError) as error:
        print(f"error: {error}", flush=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
