"""`RespawnLifecycle`: respawn nodes, and bring lifecycle nodes of ROS 2 back into their state.

A lifecycle node (package `lifecycle_msgs`) starts unconfigured. It works only after its transitions
*configure* and *activate*. The module asks each respawned node for its state and requests the next
transition, until the node is active. So a node that activates itself is accepted, and a request or
answer that is lost is repeated. So is a transition that the node refuses, until its time is over.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import msgspec

from rampart.actors.ftm.messages import RecoveryCommand
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import FieldNames, NodeNames, TopicsPublished
from rampart.manager.spec.tables import Positive

_CONFIGURE, _ACTIVATE = 1, 3
_UNCONFIGURED, _INACTIVE, _ACTIVE, _FINALIZED = 1, 2, 3, 4
"""Ids of lifecycle_msgs/msg/Transition and lifecycle_msgs/msg/State."""

_NEXT = {_UNCONFIGURED: _CONFIGURE, _INACTIVE: _ACTIVATE}
_APPEAR = "appear"
_STEPS = {_UNCONFIGURED: "configure", _INACTIVE: "activate"}


class RespawnLifecycle(Respawn):
    """Respawns nodes as `Respawn` does; it is done when those of `lifecycle` are active."""

    class Parameters(Respawn.Parameters, frozen=True, kw_only=True):
        """Lifecycle nodes, with the topics of their services, in the same order; and deadlines.

        Attributes:
            lifecycle: the lifecycle nodes among `nodes`; others are only respawned.
            ask: topics of calls of `lifecycle_msgs/srv/GetState`.
            state: fields with the answers, each as "topic:current_state.id".
            change: topics of calls of `lifecycle_msgs/srv/ChangeState`.
            appear_s: how long a new process may take until the node answers, s.
            configure_s: how long it may then take until it is configured, s.
            activate_s: how long it may then take until it is active, s.
        """

        lifecycle: NodeNames
        ask: TopicsPublished
        state: FieldNames
        change: TopicsPublished
        appear_s: Positive = 5.0
        configure_s: Positive = 5.0
        activate_s: Positive = 5.0

        def __post_init__(self) -> None:
            """Refuse a node that is not respawned here, or has no topic."""
            if strangers := set(self.lifecycle) - set(self.nodes):
                raise ValueError(f"lifecycle: {', '.join(sorted(strangers))}: not among nodes")
            for name in ("ask", "state", "change"):
                if len(getattr(self, name)) != len(self.lifecycle):
                    raise ValueError(f"{name}: expected {len(self.lifecycle)} entries, one for "
                                     "each node of lifecycle")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self._asked_s = 0.0
        self._steps: dict[str, tuple[str, float]] = {}
        """Present step of each node that is back, and its begin; "" for an active node."""
        for place, (node, field) in enumerate(zip(given.lifecycle, given.state, strict=True)):
            self.hear_field(field, partial(self._answered, node, given.change[place]))

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Request the nodes of the command; a new order looks at the states of all again."""
        if renewed:
            self._steps.clear()
            self.resume(command.reason)
        super().act(command, renewed=renewed)

    def let_go(self) -> None:
        """Forget the nodes."""
        self._steps.clear()
        super().let_go()

    def repeat(self) -> None:
        """Ask the nodes that are not active for their states."""
        super().repeat()
        given = self.parameters
        self._asked_s = self.clock.now()
        for node, ask in zip(given.lifecycle, given.ask, strict=True):
            if self._steps.get(node, ("", 0.0))[0]:
                self._call(ask, {})

    def unfinished(self) -> str:
        """Name the nodes that are not back, and the step of those that are not active."""
        steps = [f"{node}: {step}" for node, (step, _) in self._steps.items() if step]
        return ", ".join(filter(None, (super().unfinished(), *steps)))

    def _settle(self) -> None:
        given, now_s = self.parameters, self.clock.now()
        for node in self._core.pending:
            self._steps.pop(node, None)
        for node in self._core.back:
            if node in given.lifecycle:
                self._steps.setdefault(node, (_APPEAR, now_s))
        for node, (step, since_s) in self._steps.items():
            if step and now_s - since_s > getattr(given, f"{step}_s"):
                self.fail(f"{node}: no step {step} within {getattr(given, f'{step}_s'):g} s")
        if self._core.problem or not any(step for step, _ in self._steps.values()):
            super()._settle()
        else:
            self._send_requests()

    def _answered(self, node: str, change: str, state: Any, header: Header) -> None:
        """Request the next transition; an answer from before the last question may be outdated."""
        if state is None or not self._steps.get(node, ("", 0.0))[0] or (
                header.stamp < self._asked_s):
            return
        if state == _FINALIZED:
            self.fail(f"{node}: finalized")
        step = "" if state == _ACTIVE else _STEPS.get(state, self._steps[node][0])
        if step != self._steps[node][0]:
            self._steps[node] = step, self.clock.now()
        if state in _NEXT:
            self._call(change, {"transition": {"id": _NEXT[state], "label": ""}})
        self._settle()

    def _call(self, key: str, fields: dict[str, Any]) -> None:
        topic = self.chosen_topic(key)
        self.publish(topic, msgspec.convert(fields, topic.type))
