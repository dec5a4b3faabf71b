"""Arguments of every actor: name, clock, bus, parameters, store of its states."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rampart.actors.bus.bus import Bus
from rampart.actors.bus.run_folder import Register
from rampart.actors.bus.topic import Topic
from rampart.actors.machine.patience import Usage
from rampart.actors.machine.patience import usage as read_usage
from rampart.actors.machine.process_usage import ProcessCount, read_count
from rampart.actors.runtime.checkpoint import CheckpointStore
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext


@dataclass(frozen=True, slots=True)
class Context:
    """Arguments of an actor.

    Attributes:
        name: the node's name, unique in the system.
        incarnation: number of this process of the node, from 1.
        clock: simulated time.
        bus: this actor's access to the bus, not yet open.
        parameters: the node's parameters, as in the specification or already converted.
        run: data that all actors of the run share, loaded once.
        pid: id of the actor's process.
        checkpoints: store of this node's states; None keeps nothing.
        heartbeat_period_s: simulated seconds between two heartbeats.
        renewed: called when this process becomes another incarnation of the node.
        failed: called with the error that ends the actor, before its session closes.
        register: returns a node's newest issued incarnation, None if it is not known.
        members: names of all nodes of the system. The memory for other sources is bounded.
        command_age_s: older commands are refused, simulated s.
        topics: topics that parameters of the system's nodes name, by key.
        publishers: returns the names of the nodes that publish on a key below `rampart/`.
        usage: returns how much processor time and memory a process has used.
        scheduled: returns how long a main thread has run and waited for a processor.
        is_here: whether the process of a node is on this machine.
    """

    name: str
    incarnation: int
    clock: Clock
    bus: Bus
    parameters: Mapping[str, Any] | msgspec.Struct = field(default_factory=dict)
    run: RunContext = field(default_factory=RunContext)
    pid: int = field(default_factory=os.getpid)
    checkpoints: CheckpointStore | None = None
    heartbeat_period_s: float = 0.1
    renewed: Callable[[int], None] = lambda _incarnation: None
    failed: Callable[[Exception], None] = lambda _error: None
    register: Register = lambda _node: None
    members: frozenset[str] = frozenset()
    command_age_s: float = math.inf
    topics: Mapping[str, Topic[Any]] = field(default_factory=dict)
    publishers: Callable[[str], Iterable[str]] = lambda _key: ()
    usage: Callable[[int], ProcessCount | None] = read_count
    scheduled: Callable[[int], Usage] = read_usage
    is_here: Callable[[str], bool] = lambda _node: True

    def local_pid(self, node: str, pid: int) -> int:
        """Return the pid that a node has reported, -1 if it is on another machine."""
        return pid if self.is_here(node) else -1
