"""What a spare does before anybody needs it: once, and for nobody, what every new node does.

A fork shares its parent's memory until it writes there, and Python writes to whatever it uses: it
counts references. So the first time that forked code runs takes ten times as long as the second,
for some seven hundred pages that the kernel copies one by one. A spare has that behind it: it makes
an actor, opens its checkpoints, has it hear itself, and forgets it.

Only the engine's code runs, none of the system's classes: a constructor of theirs may do what is
good for one process only.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

import msgspec

from rampart.actors.bus.bus import SharedBus
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.run.run_plan import RunPlan
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.checkpoint import CheckpointStore, NoCheckpoints, StateFormat
from rampart.actors.runtime.checkpoint_file import SUFFIXES, beside
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints
from rampart.actors.runtime.clock import Clock

_PATIENCE_S = 0.05
"""Seconds after which it is over, whatever has not come."""


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
    name, file = f"{os.getpid()}", Path(plan.folder, f"rehearsal-{os.getpid()}.sqlite")
    store: CheckpointStore = SqliteCheckpoints(
        file, plan.run_id, 1, sync_period_s=0) if plan.checkpoints else NoCheckpoints()
    actor = _Understudy(Context(
        name, 1, Clock(time.monotonic()), SharedBus(bus), {"number": 2.0},
        checkpoints=store, topics={LINE.key: LINE}))
    try:
        await actor.run()
    finally:
        bus.forget()
        for suffix in SUFFIXES:
            with contextlib.suppress(OSError):
                beside(file, suffix).unlink()
