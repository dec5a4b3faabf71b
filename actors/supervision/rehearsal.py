"""What a spare does before anybody needs it: once, and for nobody, what every new node does.

A fork shares its parent's memory until it writes there, and Python writes to whatever it uses: it
counts references. So the first time that forked code runs takes ten times as long as the second,
for some seven hundred pages that the kernel copies one by one. A spare has that behind it.

A pooled one, which may become any node, makes an actor of the engine's, opens its checkpoints, has
it hear itself, and forgets it (`rehearse`). A spare of a node's own runs that node for a moment,
from a copy of its checkpoints and with what is published meanwhile, on a bus that lets nothing out
(`Stage`).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.bus import SharedBus
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.checkpoint import CheckpointStore, NoCheckpoints, StateFormat
from rampart.actors.runtime.checkpoint_file import FileCheckpoints, files_of, put, read
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import RunPlan

_PATIENCE_S = 0.05
"""Seconds after which it is over, whatever has not come."""

_RUN_S = 0.3
"""Seconds for which a node of the system is run: some turns of what works at 10 Hz or more."""


class Line(msgspec.Struct, frozen=True, array_like=True):
    """What is said in a rehearsal, and kept."""

    number: int = 0
    words: tuple[str, ...] = ()


LINE = Topic("rehearsal/{name}", Line, Qos.STATE, 0, "", "What a spare says to itself.")
_KEPT = StateFormat(Line, version=1)


class _Understudy(Actor):
    """Hears itself once, and ends."""

    class Parameters(Actor.Parameters, frozen=True):
        """Of each kind one, to be read."""

        number: float = 1.0
        words: tuple[str, ...] = ()

    outputs = (LINE,)

    def on_start(self) -> None:
        """Go on from what was kept, keep it, and say it."""
        line = self.kept(_KEPT) or Line(1, (self.name,))
        self.keep(_KEPT, line)
        self.publish(LINE, line)
        self.call_later(_PATIENCE_S, self.stop)

    @classmethod
    def watches(cls, name: str, parameters: Actor.Parameters) -> tuple[str, ...]:  # noqa: ARG003
        """Watch itself."""
        return (name,)

    @on(LINE)
    def line(self, _message: Line, _header: Header) -> None:
        """Be done."""
        self.stop()

    def is_well(self) -> bool:
        """Send no heartbeat: this is no node."""
        return False


async def rehearse(plan: RunPlan, bus: ZenohBus) -> None:
    """Set an actor up and end it, with an open session, from which nothing of it remains.

    Args:
        plan: of the run.
        bus: of the spare.

    Raises:
        BusError: the session was closed.
    """
    name, folder = f"{os.getpid()}", _folder(plan)
    store: CheckpointStore = FileCheckpoints(
        folder, name, plan.run_id, 1, syncs=False) if plan.checkpoints else NoCheckpoints()
    actor = _Understudy(Context(
        name, 1, Clock(time.monotonic()), SharedBus(bus), {"number": 2.0},
        checkpoints=store, topics={LINE.key: LINE}))
    try:
        await actor.run()
    finally:
        bus.forget()
        _remove(folder, name)


class Stage(SharedBus):
    """Where a node is rehearsed: it hears what a bus hears, and nothing that it says gets out.

    Args:
        plan: of the run.
        bus: of the spare, open.
        name: of the node.
        incarnation: that the spare is to be.
    """

    def __init__(self, plan: RunPlan, bus: ZenohBus, name: str, incarnation: int) -> None:
        super().__init__(bus)
        self._bus = bus
        self._folder, self._name = _folder(plan), name
        self.store: CheckpointStore = NoCheckpoints()
        if plan.checkpoints:
            self.store = self._copy(plan, incarnation)

    def _copy(self, plan: RunPlan, incarnation: int) -> CheckpointStore:
        with contextlib.suppress(Exception):  # whatever is wrong with it, the node will report
            kept = read(Path(plan.checkpoints), self._name, plan.run_id).records
            if kept:
                put(self._folder, self._name, plan.run_id, kept[0])
        return FileCheckpoints(self._folder, self._name, plan.run_id, incarnation, syncs=False)

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Nothing."""

    def gone(self, node: str, incarnation: int) -> None:
        """Nothing."""

    def clear(self) -> None:
        """Leave nothing of what was played here."""
        self._open = False
        self._bus.forget()
        self.store.close()
        _remove(self._folder, self._name)


async def run_for_a_moment(actors: Sequence[Actor], wanted: asyncio.Event) -> None:
    """Run actors, each on a stage of its own, until they are wanted, or for a moment.

    What goes wrong in a rehearsal goes wrong again when it counts, and is reported then.
    """
    tasks = [asyncio.create_task(actor.run()) for actor in actors]
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(wanted.wait(), _RUN_S)
    for actor, task in zip(actors, tasks, strict=True):
        actor.abandon()
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _folder(plan: RunPlan) -> Path:
    return Path(plan.folder, f"rehearsal-{os.getpid()}")


def _remove(folder: Path, node: str) -> None:
    with contextlib.suppress(OSError):
        for file in files_of(folder, node).values():
            file.unlink()
        folder.rmdir()
