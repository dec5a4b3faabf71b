"""`RespawnGroup`: respawn a node and its dependents in order.

These are the supervision strategies "rest for one" and "one for all" of Erlang/OTP. If a node was
wrong, the states that others derived from its messages are not trusted.
"""

from __future__ import annotations

from typing import Literal

from rampart.actors.ftm.messages import RecoveryCommand
from rampart.actors.recovery.respawn import Respawn, accused
from rampart.actors.runtime.actor import Context


class RespawnGroup(Respawn):
    """Has nodes respawned in the order of its list, each when the one before is back.

    It is acting until the last node is back. If a node does not come back, it fails, and leaves the
    later nodes alone.
    """

    class Parameters(Respawn.Parameters, frozen=True):
        """Nodes, and which others to respawn with one of them.

        Attributes:
            others: "later": those after it in `nodes`; "all": all of them.
        """

        others: Literal["later", "all"] = "later"

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._waiting: list[str] = []
        self._first = len(self.parameters.nodes)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Begin with the first node of the command."""
        nodes = self.parameters.nodes
        named = dict(map(accused, command.nodes))
        known = [i for i, name in enumerate(nodes) if name in named]
        if not known or named.keys() - set(nodes):
            super().act(command, renewed=renewed)
            return
        first = 0 if self.parameters.others == "all" else known[0]
        if renewed or first < self._first:
            self._first, self._waiting = first, list(nodes[first:])
            self._core.release()
            self.resume(command.reason)
            if nodes[first] in named:
                self._order(next(n for n in command.nodes if accused(n)[0] == nodes[first]))
        self._settle()

    def let_go(self) -> None:
        """Leave the remaining nodes alone."""
        self._first, self._waiting = len(self.parameters.nodes), []
        super().let_go()

    def unfinished(self) -> str:
        """Name the nodes that are not back."""
        return ", ".join((*self._core.pending, *self._waiting))

    def _order(self, node: str) -> None:
        self._waiting.remove(accused(node)[0])
        self._core.order([node], self.clock.now(), renewed=True)

    def _settle(self) -> None:
        if self.activated and self._waiting and not (self._core.pending or self._core.problem):
            self._order(self._core.accuse(self._waiting[0]))
        super()._settle()
