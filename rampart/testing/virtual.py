"""Actors in virtual time: hours take moments, and each run is the same.

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
    """Return what a coroutine function returns that is called in virtual time."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(scenario())


async def turns(count: int = 60) -> None:
    """Let the loop turn without time passing; messages, posted for now, are handed over too."""
    loop = asyncio.get_running_loop()
    for _ in range(count):
        turn = loop.create_future()
        loop.call_at(loop.time(), turn.set_result, None)
        await turn


class Heard(NamedTuple, Generic[M]):
    """A message as a tester receives it: when (simulated seconds), on which key, from whom."""

    time_s: float
    key: str
    header: Header
    message: M


class VirtualSystem:
    """Actors on one virtual bus, and a tester who starts, kills and disturbs them.

    An asynchronous context manager within `run`. Actors that live at its end are killed; an error
    by which an actor ended, that was not killed or stopped since, is raised there.

    Args:
        context: what all actors have in common; by default no system and no application.
        layout: class and parameters of the nodes that `start_node` starts.
        keeps_checkpoints: whether an incarnation finds what the one before it kept.
        topics: that parameters of the actors may name.

    Attributes:
        bus: the tester's own access to the bus, for payloads that `say` would not make.
        incarnations: those that were started last, by name.
        members: names of all nodes of the system; what others make an actor remember is bounded.
        register: tells actors which incarnation was issued last; by default, what was started.
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
        """Return the system of a file, or of the name of a shipped one; no node is started yet.

        Args:
            system: path or name.
            plan: fields of the `RunPlan`, such as `seed` and `options`.

        Raises:
            ValueError: the system is unsound, or an actor cannot be imported; one line says where.
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
            name: of the node.
            cls: its class.
            others: what the class takes besides the context.
            parameters: as in the file of a system.
        """
        actor = cls(self.context(name, parameters), *others)
        self.actors[name], self.tasks[name] = actor, asyncio.create_task(actor.run())
        return actor

    def start_node(self, name: str, *others: Any, **parameters: Any) -> Actor:
        """Start a node as the file of the system specifies, with some parameters changed.

        Raises:
            LookupError: the system has no node of this name, or no file.
        """
        if self.layout is None or name not in self.layout.members:
            raise LookupError(f"no node {name!r} in the file of this system")
        member = self.layout.members[name]
        # A value that a file must not contain may be the default all the same.
        given = {field.name: value for field in msgspec.structs.fields(member.parameters)
                 if (value := getattr(member.parameters, field.name)) != field.default}
        return self.start(name, member.actor, *others, **{**given, **parameters})

    async def kill(self, name: str) -> None:
        """End an actor as SIGKILL would, and publish that as the supervisor does."""
        task = self.tasks.pop(name)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        self.say(PROCESS_EVENT, ProcessEvent(
            name, "crashed", 1, self.incarnations[name], SUPERVISOR, ""), SUPERVISOR)

    async def stop(self, name: str) -> None:
        """End an actor in order; what it raised, if it had ended by itself, is raised."""
        self.actors[name].stop()
        await self.tasks.pop(name)

    async def settle(self) -> None:
        """Let everything happen that needs no time.

        Raises:
            AssertionError: time has passed.
        """
        before = self.clock.now()
        await turns()
        if self.clock.now() != before:
            raise AssertionError("time has passed")

    def hear(self, topic: Topic[M], member: str = "") -> list[Heard[M]]:
        """Return a list to which each message of a topic, or of one member of it, is added.

        What cannot be decoded raises in the loop, as a defect of the test.
        """
        heard: list[Heard[M]] = []

        def deliver(key: str, payload: bytes) -> None:
            heard.append(Heard(self.clock.now(), key, *decode(topic, payload)))

        self.bus.subscribe(topic.at(member) if member else topic.pattern, deliver)
        return heard

    def overhear(self, name: str) -> list[tuple[str, Any]]:
        """Return a list to which all that an actor sends is added: key, and body as it travels.

        The key is below `rampart/`; the body consists of dictionaries, lists and numbers.
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
            topic: a family of topics needs a member, by default the source.
            message: what is published.
            source: name of the node that publishes.
            member: name in the key of a family.
            incarnation: of the source.
            stamp_s: simulated seconds; by default now.
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
            topic: what is disturbed.
            mode: `drop`, `freeze`, `stuck`, `delay`, `duplicate`, `restamp` or `corrupt`.
            duration_s: simulated seconds; infinity for as long as the publisher lives.
            name: of the injection, in the reports on `injection/report/NODE`.
            member: name in the key of a family.
            fields: of `Injection`, such as `share`, `delay_s` and `set_fields`.
        """
        key = topic.key.replace("{name}", member)
        self.say(INJECT, Injection(name, key, mode, duration_s, **fields))


def virtual_run(system: str | Path, *faults: str, seconds: float | None = None,
                **plan: Any) -> VirtualResult:
    """Run a system to its end, and return what came of it.

    Args:
        system: path, or name of one that ships.
        faults: as on the command line, `FAULT[@WHEN][+DURATION]`.
        seconds: simulated, after which the run is over; those of the specification if None.
        plan: fields of the `RunPlan`, such as `seed`, `ftm` and `options`.

    Returns:
        Among others `judgement`, the judge's verdict; `record`, with `decisions` and what became
        of `faults`; `trace`, a hash over all messages; `speed`, simulated seconds per second; and
        `failures`, the actors that ended by an error.

    Raises:
        ValueError: the system or a fault is unsound; one line says where.
    """
    run = _load(system, plan)
    trial = trial_class(run.system)(run, seconds)
    if not trial.patient and trial.limit_s is None:
        raise ValueError(f"{system}: has no [end]; say after how many seconds the run is over")
    return VirtualRun(trial, scenario=[parse_fault(text) for text in faults]).run()


def _load(system: str | Path, plan: dict[str, Any]) -> RunContext:
    file = systems.find(str(system))
    working_folder.admit(file.parent)
    chosen = RunPlan(**{"system_file": str(file), "virtual": True, **plan})
    return load_run(chosen, load_system(chosen))
