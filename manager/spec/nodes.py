"""The table of nodes: actors, and commands that are nodes; and whether a command makes sense."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from enum import StrEnum
from itertools import chain
from typing import Annotated, Any, Literal

import msgspec

from rampart.manager.spec.tables import Finding, Name, OptionalName, Positive, Table

_A_CLASS = "'module:Class', e.g. 'rampart.actors.operator.hmi:Hmi'"
ClassPath = Annotated[str, msgspec.Meta(
    pattern=r"^[a-z_]\w*(\.[a-z_]\w*)*:[A-Z]\w*\Z", description=_A_CLASS)]
OptionalClassPath = Annotated[str, msgspec.Meta(
    pattern=r"^([a-z_]\w*(\.[a-z_]\w*)*:[A-Z]\w*)?\Z", description=_A_CLASS)]


class Kind(StrEnum):
    """What a node is, which decides who guards it and who brings it back."""

    CONTROL = "control"
    NON_CONTROL = "non-control"
    PILOT = "pilot"
    MANAGER = "manager"
    WORLD = "world"
    SUPERVISION = "supervision"
    DETECTION = "detection"
    RECOVERY = "recovery"


NODE_KINDS = (Kind.CONTROL, Kind.NON_CONTROL, Kind.PILOT, Kind.MANAGER, Kind.WORLD)
"""What a `[[node]]` can be; the others are the supervisor, and what has a table of its own."""


class ChildHeartbeat(Table, frozen=True):
    """By what a command shows that it turns: one of the three, and how long it may be silent.

    Attributes:
        timeout_s: Simulated seconds.
        key: Zenoh key below `rampart/` on which anything counts.
        notify: Datagrams `WATCHDOG=1` to `$NOTIFY_SOCKET`, as of sd_notify(3).
        topic: One of those that it publishes.
    """

    timeout_s: Positive
    key: str = ""
    notify: bool = False
    topic: str = ""


class ChildLimits(Table, frozen=True):
    """What a command may use at most, each of its processes for itself; see setrlimit(2).

    Attributes:
        memory_mb: Address space, in millions of bytes.
        processor_s: Processor time; what exceeds it is killed.
        open_files: Descriptors.
        file_mb: Size of a file that it writes, in millions of bytes.
    """

    memory_mb: Positive | None = None
    processor_s: Annotated[int, msgspec.Meta(ge=1)] | None = None
    open_files: Annotated[int, msgspec.Meta(ge=8, le=1_000_000)] | None = None
    file_mb: Positive | None = None


_KEY = re.compile(r"([^\s/*$?#]+(/[^\s/*$?#]+)*)?")

RESERVED_VARIABLES = ("RAMPART_", "NOTIFY_SOCKET", "WATCHDOG_")
"""Of the environment of a command; what begins so is set for it."""


class NodeSpec(Table, frozen=True):
    """A node: one actor, or one command.

    Attributes:
        name: Unique among nodes, detection and recovery modules.
        kind: What it is.
        actor: Its class, `module:Class`; "" of one that has a command.
        process: Name of the OS process it runs in; "" for one of its own name.
        host: Name of the machine on which it runs; "" for the first.
        respawn: Who brings it back: a recovery module, or "supervisor".
        spare: What its next process is made of. "pool": one that is connected to the bus and may
            become any node. "none": a new one. "" is "pool", but for the world. "warm", "own" and
            "hot" are of version 0.7, and mean "pool".
        parameters: For the actor, or for that which stands in for the command. A value of a key
            in `_s` may name a `[timing]` value.
        command: Executable and arguments, in place of an actor.
        env: What is added to the environment of the command.
        folder: In which it is run, relative to the file of the system.
        limits: What it may use at most.
        heartbeat: By what it shows that it turns; None for nothing but its existence.
        publishes: Keys of topics that it publishes by its socket.
        hears: Keys of topics that it hears there.
        stand_in: Class of the actor that plays it in virtual time.
    """

    name: Name
    kind: Annotated[Kind, msgspec.Meta(description=f"one of {', '.join(NODE_KINDS)}")]
    actor: OptionalClassPath = ""
    process: OptionalName = ""
    host: OptionalName = ""
    respawn: Name = "supervisor"
    spare: Literal["", "none", "pool", "warm", "own", "hot"] = ""
    parameters: dict[str, Any] = {}
    command: tuple[str, ...] = ()
    env: dict[str, str] = {}
    folder: str = ""
    limits: ChildLimits = ChildLimits()
    heartbeat: ChildHeartbeat | None = None
    publishes: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()
    stand_in: OptionalClassPath = ""

    @property
    def command_parameters(self) -> dict[str, Any]:
        """What the actor that runs its command is told."""
        return {field: getattr(self, field) for field in COMMAND_FIELDS if field != "stand_in"}

    def in_virtual_time(self) -> NodeSpec:
        """Return what plays the node where there are no processes, if anything does."""
        if not self.command or not self.stand_in:
            return self
        return msgspec.structs.replace(self, actor=self.stand_in, **dict(_NO_COMMAND))


COMMAND_FIELDS = ("command", "env", "folder", "limits", "heartbeat", "publishes", "hears",
                  "stand_in")
"""What can be said of a node that has a command only."""

_NO_COMMAND = {field: getattr(NodeSpec("none", Kind.WORLD), field) for field in COMMAND_FIELDS}


def find_wrong_commands(nodes: Iterable[NodeSpec]) -> Iterator[Finding]:
    """Find nodes that have neither or both of actor and command, and commands that make no sense.

    The finding's path names the node.
    """
    for node in nodes:
        found = chain(_wrong_command(node), _wrong_heartbeat(node), _wrong_keys(node)
                      ) if node.command else _wrong_actor(node)
        for field, problem, *value in found:
            yield Finding(f"{node.name}: {field}", problem, tuple(value))


def _wrong_actor(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    """Yield field, problem, and the value if one is to blame."""
    for field in COMMAND_FIELDS:
        if (value := getattr(node, field)) != _NO_COMMAND[field]:
            yield field, "of use with a command only, and the node has none", _plain(value)
    if not node.actor:
        yield "actor", "missing; say actor = 'module:Class' or command = ['./program', ...]"


def _wrong_command(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    command = list(node.command)
    if node.actor:
        yield "command", f"either actor or command is right; it has actor = {node.actor!r}", command
    if node.kind is Kind.MANAGER:
        yield "command", "the manager has to be an actor", command
    if not node.command[0]:
        yield "command", "the first is the program, and it has no name", command
    if any("\0" in text for text in (*command, *node.env, *node.env.values(), node.folder)):
        yield "command", "no text of it or its env or folder may have a character 0", command
    for name, value in node.env.items():
        if not name or "=" in name or name.startswith(RESERVED_VARIABLES):
            yield f"env.{name}", "no variable that can be set here; RAMPART_*, NOTIFY_SOCKET and " \
                "WATCHDOG_* are set for it", value
    if node.parameters and not node.stand_in:
        yield "parameters", "a command takes none; they are for the actor that stand_in names"


def _wrong_heartbeat(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    beat = node.heartbeat
    if beat is None:
        return
    if sum(map(bool, (beat.key, beat.notify, beat.topic))) != 1:
        yield ("heartbeat", "one of key = '...', notify = true, topic = '...' is right",
               _plain(beat))
    if beat.topic and beat.topic not in node.publishes:
        yield ("heartbeat.topic", "not one of the topics that it publishes; these are: "
               f"{', '.join(node.publishes) or 'none'}", beat.topic)
    if not _KEY.fullmatch(beat.key):
        yield "heartbeat.key", "expected a Zenoh key such as 'est/alive'", beat.key


def _wrong_keys(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    for field in ("publishes", "hears"):
        listed = getattr(node, field)
        for place, key in enumerate(listed):
            if "{" in key:
                yield field, "name one member of the family", key
            if key in listed[:place]:
                yield field, "listed twice", key


def _plain(value: object) -> object:
    return msgspec.to_builtins(value)
