"""Actors in virtual time: an hour takes moments, and each run is the same.

`run` calls a coroutine function on a virtual loop; in it, `VirtualSystem` has actors on one bus.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterable
from pathlib import Path
from typing import Any, Generic, NamedTuple, Self, TypeVar

import msgspec

from rampart import systems
from rampart.actors.bus.envelope import Header, decode, encode
from rampart.actors.bus.messages import Injection
from rampart.actors.bus.run_folder import Register
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.bus.topics import INJECT
from rampart.actors.ftm.messages import ProcessEvent
from rampart.actors.ftm.topics import PROCESS_EVENT
from rampart.actors.machine.patience import AT_LEISURE
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.checkpoint import MemoryCheckpoints, Record
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import SUPERVISOR, RunPlan, load_system
from rampart.actors.system.layout import Layout, load_run
from rampart.files import working_folder
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.runs.trial import trial_class
from rampart.sim.runs.virtual_run import VirtualResult, VirtualRun
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualLoop

A = TypeVar("A", bound=Actor)
M = TypeVar("M", bound=msgspec.Struct)
T = TypeVar("T")

TESTER = "tester"


def run(scenario: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run a coroutine function in virtual time and return its result."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(scenario())


async def turns(count: int = 60) -> None:
    """Let the loop turn without advancing time; pending messages are delivered."""
    loop = asyncio.get_running_loop()
    for _ in range(count):
        turn = loop.create_future()
        loop.call_at(loop.time(), turn.set_result, None)
        await turn


class Heard(NamedTuple, Generic[M]):
    """A received message, with simulated time, key and header."""

    time_s: float
    key: str
    header: Header
    message: M


class VirtualSystem:
    """Actors on one virtual bus, and a tester that starts, kills and disturbs them.

    An asynchronous context manager within `run`. The exit kills the remaining actors, and raises
    the error of an actor that failed and was not killed or stopped afterwards.

    Args:
        context: Common context of the actors; by default no system and no application.
        layout: Classes and parameters of the nodes that `start_node` starts.
        keeps_checkpoints: Whether an incarnation finds the checkpoints of the one before.
        topics: Topics that parameters of the actors may name.

    Attributes:
        bus: The tester's access to the bus, for payloads that `say` does not make.
        incarnations: Last started incarnation by name.
        members: Names of all nodes of the system; actors bound the state kept for other senders.
        register: Returns the last issued incarnation of a node; by default, the last started one.
    """

    def __init__(self, context: RunContext | None = None, layout: Layout | None = None, *,
                 keeps_checkpoints: bool = False, topics: Iterable[Topic[Any]] = ()) -> None:
        self.hub = Hub()
        self.run = context or RunContext()
        self.layout = layout
        loop = asyncio.get_running_loop()
        self.clock = Clock(loop.time(), source=loop.time)
        self.incarnations: dict[str, int] = {}
        self.members = frozenset(layout.members if layout else ())
        self._topics = tuple(topics)
        self._shelves: dict[str, list[Record]] | None = {} if keeps_checkpoints else None
        self.register: Register = self.incarnations.get
        self.actors: dict[str, Actor] = {}
        self.tasks: dict[str, asyncio.Task[None]] = {}
        self.bus = VirtualBus(self.hub, TESTER)
        self._sequence = 0

    @classmethod
    def load(cls, system: str | Path, **plan: Any) -> VirtualSystem:
        """Load a system without starting its nodes.

        Args:
            system: Path, or name of a shipped system.
            plan: Fields of the `RunPlan`, such as `seed` and `options`.

        Raises:
            ValueError: The system is invalid, or an actor cannot be imported. The text is one line.
        """
        run = _load(system, plan)
        return cls(run, Layout(run.plan, run.system, run.application),
                   keeps_checkpoints=run.system.layers.checkpoints)

    async def __aenter__(self) -> Self:
        await self.bus.open()
        return self

    async def __aexit__(self, kind: object, *_: object) -> None:
        failed = [task for task in self.tasks.values()
                  if kind is None and task.done() and task.exception()]
        for name in list(self.tasks):
            await self.kill(name)
        await self.bus.close()
        for task in failed:
            task.result()

    def context(self, name: str, parameters: dict[str, Any]) -> Context:
        """Return the context for the next incarnation of an actor."""
        incarnation = self.incarnations[name] = self.incarnations.get(name, 0) + 1
        kept = None if self._shelves is None else MemoryCheckpoints(
            self._shelves.setdefault(name, []), incarnation)
        return Context(name, incarnation, self.clock, VirtualBus(self.hub, name, incarnation),
                       parameters, self.run, checkpoints=kept, members=self.members,
                       register=self.register, topics=self._named(parameters),
                       usage=lambda _pid: None, scheduled=lambda _pid: AT_LEISURE)

    def _named(self, parameters: dict[str, Any]) -> dict[str, Topic[Any]]:
        """Return the topics that parameters may name, by their keys there."""
        keys = {key for value in parameters.values()
                for text in (value if isinstance(value, list | tuple) else [value])
                if isinstance(text, str) for key in [text.partition(":")[0]]}
        found = dict(self.layout.topics) if self.layout else {}
        return found | {key: topic for key in keys for topic in self._topics
                        if topic.member(key) is not None}

    def start(self, name: str, cls: Callable[..., A], *others: Any, **parameters: Any) -> A:
        """Start an actor, or its next incarnation.

        Args:
            name: Name of the node.
            cls: Class of the actor.
            others: Further arguments of the class.
            parameters: Parameters as in a specification.
        """
        actor = cls(self.context(name, parameters), *others)
        self.actors[name], self.tasks[name] = actor, asyncio.create_task(actor.run())
        return actor

    def start_node(self, name: str, *others: Any, **parameters: Any) -> Actor:
        """Start a node as specified, with some parameters changed.

        Raises:
            LookupError: The system has no such node, or was not loaded from a file.
        """
        if self.layout is None or name not in self.layout.members:
            raise LookupError(f"no node {name!r} in the file of this system")
        member = self.layout.members[name]
        # A default may be a value that a file must not contain.
        given = {field.name: value for field in msgspec.structs.fields(member.parameters)
                 if (value := getattr(member.parameters, field.name)) != field.default}
        return self.start(name, member.actor, *others, **{**given, **parameters})

    async def kill(self, name: str) -> None:
        """End an actor like SIGKILL, and publish the crash as the supervisor does."""
        task = self.tasks.pop(name)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        self.say(PROCESS_EVENT, ProcessEvent(
            name, "crashed", 1, self.incarnations[name], SUPERVISOR, ""), SUPERVISOR)

    async def stop(self, name: str) -> None:
        """Stop an actor; if it had failed, raise its error."""
        self.actors[name].stop()
        await self.tasks.pop(name)

    async def settle(self) -> None:
        """Let everything happen that needs no time.

        Raises:
            AssertionError: Time has passed.
        """
        before = self.clock.now()
        await turns()
        if self.clock.now() != before:
            raise AssertionError("time has passed")

    def hear(self, topic: Topic[M], member: str = "") -> list[Heard[M]]:
        """Return a list that receives each message of a topic, or of one member of it.

        A message that cannot be decoded raises in the loop.
        """
        heard: list[Heard[M]] = []

        def deliver(key: str, payload: bytes) -> None:
            heard.append(Heard(self.clock.now(), key, *decode(topic, payload)))

        self.bus.subscribe(topic.at(member) if member else topic.pattern, deliver)
        return heard

    def overhear(self, name: str) -> list[tuple[str, Any]]:
        """Return a list that receives key and encoded body of each message that an actor sends.

        The key is below `rampart/`; the body consists of dictionaries, lists and plain values.
        """
        sent: list[tuple[str, Any]] = []

        def tap(_now_s: float, source: str, key: str, payload: bytes) -> None:
            if source == name:
                sent.append((key.removeprefix(f"{ROOT}/"), msgspec.msgpack.decode(payload)[4]))

        self.hub.taps.append(tap)
        return sent

    def say(self, topic: Topic[M], message: M, source: str = TESTER, *, member: str = "",
            incarnation: int = 1, stamp_s: float | None = None) -> None:
        """Publish a message in the name of any node.

        Args:
            topic: The topic. The member of a family is by default the source.
            message: The message.
            source: Name of the publishing node.
            member: Name in the key of a family.
            incarnation: Incarnation of the source.
            stamp_s: Simulated seconds; by default now.
        """
        self._sequence += 1
        header = Header(source, incarnation, self._sequence,
                        self.clock.now() if stamp_s is None else stamp_s)
        key = topic.at(member or source) if topic.is_family else topic.at()
        self.bus.publish(topic, key, encode(header, message))

    def inject(self, topic: Topic[Any], mode: str, duration_s: float, *, name: str = "fault",
               member: str = "", **fields: Any) -> None:
        """Inject a fault into a topic where it is published, from now on.

        Args:
            topic: The topic.
            mode: `drop`, `freeze`, `stuck`, `delay`, `duplicate`, `restamp` or `corrupt`.
            duration_s: Simulated seconds; infinity for as long as the publisher lives.
            name: Name of the injection in the reports on `inject/report`.
            member: Name in the key of a family.
            fields: Fields of `Injection`, such as `share`, `delay_s` and `set_fields`.
        """
        key = topic.key.replace("{name}", member)
        self.say(INJECT, Injection(name, key, mode, duration_s, **fields))


def virtual_run(system: str | Path, *faults: str, seconds: float | None = None,
                **plan: Any) -> VirtualResult:
    """Run a system to its end and return the result.

    Args:
        system: Path, or name of a shipped system.
        faults: As on the command line, `FAULT[@WHEN][+DURATION]`.
        seconds: Length of the run, simulated seconds; None for the value of the specification.
        plan: Fields of the `RunPlan`, such as `seed`, `ftm` and `options`.

    Returns:
        Among others `judgement`, the judge's verdict; `record`, with `decisions` and the outcomes
        of `faults`; `trace`, a hash over all messages; `speed`, simulated seconds per second; and
        `failures`, the actors that ended by an error.

    Raises:
        ValueError: The system or a fault is invalid. The text is one line.
    """
    run = _load(system, plan)
    trial = trial_class(run.system)(run, seconds)
    if not trial.patient and trial.limit_s is None:
        raise ValueError(f"{system}: has no [end]; expected seconds as an argument")
    return VirtualRun(trial, scenario=[parse_fault(text) for text in faults]).run()


def _load(system: str | Path, plan: dict[str, Any]) -> RunContext:
    file = systems.find(str(system))
    working_folder.admit(file.parent)
    chosen = RunPlan(**{"system_file": str(file), "virtual": True, **plan})
    return load_run(chosen, load_system(chosen))
