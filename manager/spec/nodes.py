"""The table `[[node]]`: actors, and commands that run as nodes; and the checks of commands."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from enum import StrEnum
from itertools import chain
from typing import Annotated, Any, Literal

import msgspec

from rampart.manager.spec.tables import Finding, Name, OptionalName, Positive, Supervision, Table

_A_CLASS = "'module:Class', e.g. 'rampart.actors.operator.hmi:Hmi'"
ClassPath = Annotated[str, msgspec.Meta(
    pattern=r"^[a-z_]\w*(\.[a-z_]\w*)*:[A-Z]\w*\Z", description=_A_CLASS)]
OptionalClassPath = Annotated[str, msgspec.Meta(
    pattern=r"^([a-z_]\w*(\.[a-z_]\w*)*:[A-Z]\w*)?\Z", description=_A_CLASS)]


class Kind(StrEnum):
    """Kind of a node; it decides which checks apply and what may restart it."""

    CONTROL = "control"
    NON_CONTROL = "non-control"
    PILOT = "pilot"
    MANAGER = "manager"
    WORLD = "world"
    SUPERVISION = "supervision"
    DETECTION = "detection"
    RECOVERY = "recovery"


NODE_KINDS = (Kind.CONTROL, Kind.NON_CONTROL, Kind.PILOT, Kind.MANAGER, Kind.WORLD)
"""Kinds of a `[[node]]`; the others are the supervisor, and modules with their own tables."""


class ChildHeartbeat(Table, frozen=True):
    """How a command shows that it runs: by a key, by datagrams, or by a topic.

    Attributes:
        timeout_s: Longest silence, simulated seconds.
        key: Zenoh key below `rampart/`; any message on it counts.
        notify: Datagrams `WATCHDOG=1` to `$NOTIFY_SOCKET` count, see sd_notify(3).
        topic: A topic that the command publishes.
    """

    timeout_s: Positive
    key: str = ""
    notify: bool = False
    topic: str = ""


class ChildLimits(Table, frozen=True):
    """Limits of each process of a command; see setrlimit(2).

    Attributes:
        memory_mb: Address space, in millions of bytes.
        processor_s: Processor time, after which the process is killed.
        open_files: Descriptors.
        file_mb: Size of a file that it writes, in millions of bytes.
    """

    memory_mb: Positive | None = None
    processor_s: Annotated[int, msgspec.Meta(ge=1)] | None = None
    open_files: Annotated[int, msgspec.Meta(ge=8, le=1_000_000)] | None = None
    file_mb: Positive | None = None


class RestartLimits(Table, frozen=True):
    """Limits of the restarts of one node, in place of those in `[supervision]`; real seconds.

    Attributes:
        intensity: Restarts within `period_s`; at one more it is given up.
        period_s: The window in which restarts are counted.
        backoff_s: Wait before a restart once half of `intensity` is used up; doubles each time.
        at_most_s: Longest wait, also of single attempts after it was given up.
    """

    intensity: Annotated[int, msgspec.Meta(ge=1, le=10_000)] | None = None
    period_s: Positive | None = None
    backoff_s: Positive | None = None
    at_most_s: Positive | None = None

    def within(self, general: Supervision) -> Supervision:
        """Return the limits of `[supervision]` with these in their place."""
        given = {field: value for field in ("intensity", "period_s", "backoff_s")
                 if (value := getattr(self, field)) is not None}
        if (most_s := self.at_most_s) is not None:
            given |= {"backoff_max_s": most_s, "attempt_max_s": most_s,
                      "attempt_s": min(most_s, general.attempt_s)}
        return msgspec.structs.replace(general, **given)


_KEY = re.compile(r"([^\s/*$?#]+(/[^\s/*$?#]+)*)?")

RESERVED_VARIABLES = ("RAMPART_", "NOTIFY_SOCKET", "WATCHDOG_")
"""Beginnings of environment variables that Rampart sets for a command."""


class NodeSpec(Table, frozen=True):
    """A node: one actor, or one command.

    Attributes:
        name: Unique among nodes, detection and recovery modules.
        kind: Kind of the node.
        actor: Its class, `module:Class`; "" if the node has a command.
        process: Name of its OS process; "" for the name of the node.
        host: Name of the host on which it runs; "" for the first.
        respawn: What restarts it: a recovery module, or "supervisor".
        restart: Limits of its restarts; those of the first node of a process count for all.
        spare: Source of its next process. "pool": a process of the pool. "none": a new process.
            "" means "none" for the world, else "pool", as do "warm", "own" and "hot".
        parameters: Of the actor, or of the command's stand-in. If a key ends in `_s`, its value
            may name a `[timing]` value.
        command: Executable and arguments, in place of an actor.
        env: Variables to add to the environment of the command.
        folder: Working folder of the command, relative to the system's file.
        limits: Limits of the command.
        heartbeat: How the command shows that it runs; None if only its end counts.
        publishes: Keys of topics that it publishes on its socket.
        hears: Keys of topics that it receives there.
        may_end: Whether the command has done its work when it ends with 0, and stays ended.
        stand_in: Class of the actor that replaces it in virtual time.
    """

    name: Name
    kind: Annotated[Kind, msgspec.Meta(description=f"one of {', '.join(NODE_KINDS)}")]
    actor: OptionalClassPath = ""
    process: OptionalName = ""
    host: OptionalName = ""
    respawn: Name = "supervisor"
    restart: RestartLimits = RestartLimits()
    spare: Literal["", "none", "pool", "warm", "own", "hot"] = ""
    parameters: dict[str, Any] = {}
    command: tuple[str, ...] = ()
    env: dict[str, str] = {}
    folder: str = ""
    limits: ChildLimits = ChildLimits()
    heartbeat: ChildHeartbeat | None = None
    publishes: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()
    may_end: bool = False
    stand_in: OptionalClassPath = ""

    @property
    def command_parameters(self) -> dict[str, Any]:
        """Parameters of the actor that runs the command."""
        return {field: getattr(self, field) for field in COMMAND_FIELDS if field != "stand_in"}

    def in_virtual_time(self) -> NodeSpec:
        """Return the node with its stand-in as the actor, if it has one."""
        if not self.command or not self.stand_in:
            return self
        return msgspec.structs.replace(self, actor=self.stand_in, **dict(_NO_COMMAND))


COMMAND_FIELDS = ("command", "env", "folder", "limits", "heartbeat", "publishes", "hears",
                  "may_end", "stand_in")
"""Fields that only a node with a command may have."""

_NO_COMMAND = {field: getattr(NodeSpec("none", Kind.WORLD), field) for field in COMMAND_FIELDS}


def find_wrong_commands(nodes: Iterable[NodeSpec]) -> Iterator[Finding]:
    """Check that each node has either an actor or a command, and check the commands."""
    for node in nodes:
        found = chain(_wrong_command(node), _wrong_heartbeat(node), _wrong_keys(node)
                      ) if node.command else _wrong_actor(node)
        for field, problem, *value in found:
            yield Finding(f"{node.name}: {field}", problem, tuple(value))


def _wrong_actor(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    """Yield field, problem, and the value if one is to blame."""
    for field in COMMAND_FIELDS:
        if (value := getattr(node, field)) != _NO_COMMAND[field]:
            yield field, "expected only with a command; the node has none", _plain(value)
    if not node.actor:
        yield "actor", "missing; expected actor = 'module:Class' or command = ['./program', ...]"


def _wrong_command(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    command = list(node.command)
    if node.actor:
        yield "command", f"expected only one of actor and command; actor = {node.actor!r}", command
    if node.kind is Kind.MANAGER:
        yield "command", "expected an actor, as the node is the manager", command
    if not node.command[0]:
        yield "command", "expected the name of a program first", command
    if any("\0" in text for text in (*command, *node.env, *node.env.values(), node.folder)):
        yield "command", "a null character in command, env or folder", command
    for name, value in node.env.items():
        if not name or "=" in name or name.startswith(RESERVED_VARIABLES):
            yield f"env.{name}", "expected a name without '=' that does not begin with " \
                f"{', '.join(RESERVED_VARIABLES)}, which Rampart sets", value
    if node.parameters and not node.stand_in:
        yield "parameters", "expected only with stand_in: a command takes no parameters"


def _wrong_heartbeat(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    beat = node.heartbeat
    if beat is None:
        return
    if sum(map(bool, (beat.key, beat.notify, beat.topic))) != 1:
        yield ("heartbeat", "expected one of key = '...', notify = true, topic = '...'",
               _plain(beat))
    if beat.topic and beat.topic not in node.publishes:
        yield ("heartbeat.topic", "expected a topic that the node publishes: "
               f"{', '.join(node.publishes) or 'none'}", beat.topic)
    if not _KEY.fullmatch(beat.key):
        yield "heartbeat.key", "expected a Zenoh key such as 'est/alive'", beat.key


def _wrong_keys(node: NodeSpec) -> Iterator[tuple[Any, ...]]:
    for field in ("publishes", "hears"):
        listed = getattr(node, field)
        for place, key in enumerate(listed):
            if "{" in key:
                yield field, "expected a name in place of {name}", key
            if key in listed[:place]:
                yield field, "listed twice", key


def _plain(value: object) -> object:
    return msgspec.to_builtins(value)
