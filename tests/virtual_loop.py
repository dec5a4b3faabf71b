"""Virtual time for tests of actors.

`run(scenario)` calls a coroutine function on a virtual loop; `System` starts actors on one hub.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import cache
from typing import Any, TypeVar

from rampart import systems
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.run.application import Application
from rampart.actors.run.run_context import NO_SYSTEM, RunContext
from rampart.actors.run.run_plan import RunPlan
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.clock import Clock
from rampart.manager.spec.specification import SystemSpec, parse_specification
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualLoop

A = TypeVar("A", bound=Actor)
T = TypeVar("T")


def run(scenario: Callable[[], Coroutine[Any, Any, T]]) -> T:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(scenario())


@cache
def shipped_system() -> SystemSpec:
    """Return the spec of the shipped system."""
    path = systems.SHIPPED / "paper.toml"
    return parse_specification(path.read_text(), path.name)


def run_context(*, system: SystemSpec = NO_SYSTEM, document: Any = None, adapted: Any = None,
                airport: Any = None, mission: Any = None, world: Any = None, **plan: Any
                ) -> RunContext:
    """Return what actors have in common in a test; `plan` are fields of the `RunPlan`."""
    application = Osmosis.on_map(airport, mission, world) if airport else Application()
    return RunContext(RunPlan(**plan), system, document or {}, application, adapted)


class System:
    """Actors on one virtual hub, and the means to kill and respawn them."""

    def __init__(self, **known: Any) -> None:
        self.hub = Hub()
        self.run = run_context(**known)
        loop = asyncio.get_running_loop()
        self.clock = Clock(loop.time(), source=loop.time)
        self.incarnations: dict[str, int] = {}
        self.tasks: dict[str, asyncio.Task[None]] = {}

    async def __aenter__(self) -> System:
        return self

    async def __aexit__(self, *_: object) -> None:
        for name in list(self.tasks):
            await self.kill(name)

    def start(self, name: str, cls: type[A], **parameters: Any) -> A:
        """Start an actor, or its next incarnation."""
        life = self.incarnations[name] = self.incarnations.get(name, 0) + 1
        actor = cls(Context(name, life, self.clock, VirtualBus(self.hub, name, life),
                            parameters, self.run))
        actor.around = self  # type: ignore[attr-defined]
        self.tasks[name] = asyncio.create_task(actor.run())
        return actor

    async def kill(self, name: str) -> None:
        """End an actor as SIGKILL would: its token vanishes, it says nothing more."""
        task = self.tasks.pop(name)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    async def settle(self) -> None:
        """Let everything happen that needs no time."""
        before = self.clock.now()
        await turns()
        assert self.clock.now() == before, "time has passed"


async def turns(count: int = 60) -> None:
    """Let the loop turn without time passing; messages, posted for now, are handed over too."""
    loop = asyncio.get_running_loop()
    for _ in range(count):
        turn = loop.create_future()
        loop.call_at(loop.time(), turn.set_result, None)
        await turn


async def until(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    deadline = asyncio.get_running_loop().time() + timeout_s
    while not condition():
        assert asyncio.get_running_loop().time() < deadline, "it did not happen in time"
        await asyncio.sleep(0.005)
