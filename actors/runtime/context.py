"""What an actor is given when it is made: name, clock, bus, parameters, where its state is kept."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
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
    """What an actor is given when it is made.

    Attributes:
        name: the node's name, unique in the system.
        incarnation: which process of the node this is, counted from 1.
        clock: simulated time.
        bus: this actor's access to the bus, not yet open.
        parameters: the node's parameters, as the system spec gives them or read already.
        run: what all actors of the run have in common, loaded once.
        pid: number of the process that it runs in.
        checkpoints: where this node's state is kept.
        heartbeat_period_s: simulated seconds between two heartbeats.
        renewed: called when this process becomes another incarnation of the node.
        failed: told of the error that ends the actor, while its peers still see it alive.
        register: returns the incarnation of a node that was issued last, None if it is not known.
        members: names of all nodes of the system; what others make it remember is bounded.
        command_age_s: commands that are older are not obeyed.
        topics: those that parameters of the system's nodes name, by key.
        usage: returns what a process has used of the machine.
        scheduled: returns what the main thread of a process has run, and waited for a processor.
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
    usage: Callable[[int], ProcessCount | None] = read_count
    scheduled: Callable[[int], Usage] = read_usage
    is_here: Callable[[str], bool] = lambda _node: True

    def local_pid(self, node: str, pid: int) -> int:
        """Return the pid that a node has reported, -1 if it is a number of another machine."""
        return pid if self.is_here(node) else -1
