"""The operator's choice of a strategy. Pure.

The FTM Manager checks the changed system like a new one, and answers at once, with the reason of a
refusal. Requests can be repeated: the second one changes nothing.
"""

from __future__ import annotations

import msgspec

from rampart.actors.ftm import messages as m
from rampart.actors.operator.requests import Pending, RefusedError

GIVE_UP_S = 5.0
"""Simulated seconds without an answer after which a request is withdrawn."""


class StrategyChoice(Pending[m.AdaptationRequest]):
    """The choice that waits for its answer.

    Args:
        prefix: of the requests' ids, unique to each incarnation of the node.
        by: name of the operator.
        strategies: names of all strategies.
        overhead_s: added for delays in real time, in simulated seconds.
    """

    def __init__(self, prefix: str, by: str, strategies: tuple[str, ...],
                 overhead_s: float = 0.0) -> None:
        super().__init__(prefix, "not set: no answer from the FTM Manager",
                         GIVE_UP_S + overhead_s)
        self._by = by
        self.strategies = strategies

    def ask(self, name: str, current: str, now_s: float) -> m.AdaptationRequest:
        """Return the request for a choice, which then waits for its answer.

        Args:
            name: the strategy.
            current: the strategy in force, "" if unknown.
            now_s: simulated seconds.

        Raises:
            RefusedError: it does not exist, it is in force, or another choice waits.
        """
        if name not in self.strategies:
            raise RefusedError(f"no strategy {name[:40]!r}; known: {', '.join(self.strategies)}")
        request = self.new_id()
        if name == current:
            raise RefusedError(f"strategy {name} is in force already")
        value = msgspec.json.encode({"value": name}).decode()
        return self.put(f"strategy {name}", m.AdaptationRequest(
            request, "set", "strategy", value, self._by), now_s)

    def answer(self, answer: m.AdaptationAnswer) -> str:
        """Return a line about the answer to the pending request, "" for other answers."""
        if self.pending is None or answer.request != self.pending.request:
            return ""
        return (f"{self.settle()} is in force, change {answer.version} of the run"
                if answer.accepted else f"{self.settle()} refused: {answer.reason}")
