"""The operator's choice of a strategy: one request at a time, repeated until answered. Pure.

The FTM Manager checks the changed system like a fresh one and answers at once, with the reason if
it refuses. The same request twice is the same change twice, which changes nothing more.
"""

from __future__ import annotations

import msgspec

from rampart.actors.ftm import messages as m

GIVE_UP_S = 5.0
"""Simulated seconds after which a request that nobody answers is withdrawn."""


class ChoiceError(ValueError):
    """A strategy cannot be chosen now; the text says why."""


class StrategyChoice:
    """The one choice that waits for its answer.

    Args:
        prefix: of the requests' ids; another one for each life of the HMI.
        by: who asks.
        strategies: names of those that there are.
        overhead_s: granted for what takes real time, in simulated seconds.
    """

    def __init__(self, prefix: str, by: str, strategies: tuple[str, ...],
                 overhead_s: float = 0.0) -> None:
        self._give_up_after_s = GIVE_UP_S + overhead_s
        self._prefix = prefix
        self._by = by
        self.strategies = strategies
        self._asked = 0
        self._name = ""
        self._pending: m.AdaptationRequest | None = None
        self._give_up_s = 0.0

    @property
    def pending(self) -> m.AdaptationRequest | None:
        """The request to be sent now and again until it is answered, or None."""
        return self._pending

    def ask(self, name: str, current: str, now_s: float) -> m.AdaptationRequest:
        """Make a choice of the operator pending.

        Args:
            name: the strategy.
            current: the one in force, "" if unknown.
            now_s: now, simulated seconds.

        Raises:
            ChoiceError: there is none of this name, it is in force, or another choice waits.
        """
        if name not in self.strategies:
            raise ChoiceError(f"no strategy {name[:40]!r}; there are: {', '.join(self.strategies)}")
        if self._pending is not None:
            raise ChoiceError(f"strategy {self._name} waits for its answer")
        if name == current:
            raise ChoiceError(f"strategy {name} is in force already")
        self._asked += 1
        self._name = name
        self._pending = m.AdaptationRequest(
            f"{self._prefix}.{self._asked}", "set", "strategy",
            msgspec.json.encode({"value": name}).decode(), self._by)
        self._give_up_s = now_s + self._give_up_after_s
        return self._pending

    def answer(self, answer: m.AdaptationAnswer) -> str:
        """Return what the answer to the pending request means, "" if it is another's."""
        if self._pending is None or answer.request != self._pending.request:
            return ""
        self._pending = None
        return (f"strategy {self._name} is in force, change {answer.version} of the run"
                if answer.accepted else f"strategy {self._name} refused: {answer.reason}")

    def expire(self, now_s: float) -> str:
        """Withdraw a request that nobody answers, and return what to tell; "" if none."""
        if self._pending is None or now_s < self._give_up_s:
            return ""
        self._pending = None
        return f"strategy {self._name} was not set: the FTM Manager does not answer"
