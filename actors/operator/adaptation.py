"""The operator's choice of a strategy. Pure.

The FTM Manager checks the changed system like a fresh one and answers at once, with the reason if
it refuses. The same request twice is the same change twice, which changes nothing more.
"""

from __future__ import annotations

import msgspec

from rampart.actors.ftm import messages as m
from rampart.actors.operator.requests import Pending, RefusedError

GIVE_UP_S = 5.0
"""Simulated seconds after which a request without an answer is withdrawn."""


class StrategyChoice(Pending[m.AdaptationRequest]):
    """The one choice that waits for its answer.

    Args:
        prefix: of the requests' ids; another one for each incarnation of the node.
        by: who asks.
        strategies: names of those that there are.
        overhead_s: granted for what takes real time, in simulated seconds.
    """

    def __init__(self, prefix: str, by: str, strategies: tuple[str, ...],
                 overhead_s: float = 0.0) -> None:
        super().__init__(prefix, "was not set: the FTM Manager does not answer",
                         GIVE_UP_S + overhead_s)
        self._by = by
        self.strategies = strategies

    def ask(self, name: str, current: str, now_s: float) -> m.AdaptationRequest:
        """Make a choice of the operator pending.

        Args:
            name: the strategy.
            current: the one in force, "" if unknown.
            now_s: now, simulated seconds.

        Raises:
            RefusedError: there is none of this name, it is in force, or another choice waits.
        """
        if name not in self.strategies:
            raise RefusedError(
                f"no strategy {name[:40]!r}; there are: {', '.join(self.strategies)}")
        request = self.new_id()
        if name == current:
            raise RefusedError(f"strategy {name} is in force already")
        value = msgspec.json.encode({"value": name}).decode()
        return self.put(f"strategy {name}", m.AdaptationRequest(
            request, "set", "strategy", value, self._by), now_s)

    def answer(self, answer: m.AdaptationAnswer) -> str:
        """Return what the answer to the pending request means, "" if it is another's."""
        if self.pending is None or answer.request != self.pending.request:
            return ""
        return (f"{self.settle()} is in force, change {answer.version} of the run"
                if answer.accepted else f"{self.settle()} refused: {answer.reason}")
