"""Who of the watched nodes is dead, stopped or wedged.

Three failures, two signs. A process that dies takes its liveliness token with it: seen at once.
A process that is stopped, or whose loop hangs, keeps the token: only its heartbeat is missing.

Lives are told apart by their incarnation. The death notice of an old life may arrive when the
next one is already at work, and a heartbeat of the old one may arrive after its death notice;
neither may be believed of the new life. Being back is proved by a heartbeat, not by a token: a
process that exists does not work yet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from operator import attrgetter

from rampart.actors.bus.plausible import is_possible


@dataclass(slots=True)
class _Life:
    """What is known of a watched node: its newest incarnation and how that one is."""

    due_s: float
    incarnation: int = 0
    heard: bool = False
    gone_s: float | None = None
    failure: str = ""


_failure = attrgetter("failure")


class WatchdogCore:
    """Active while one of the nodes has failed; `nodes` names those.

    Args:
        nodes: the watched nodes.
        timeout_s: a node without a heartbeat for so long has failed, s.
        start_s: now.
        grace_s: how long the first heartbeat of a node may take, s.
        known: whether idle may be claimed before all nodes were heard.
    """

    def __init__(self, nodes: Iterable[str], timeout_s: float, start_s: float, grace_s: float,
                 *, known: bool = True) -> None:
        self.timeout_s = timeout_s
        self._known = known
        self._lives = {node: _Life(due_s=start_s + grace_s) for node in nodes}

    @property
    def active(self) -> bool:
        """Whether a node has failed."""
        return any(map(_failure, self._lives.values()))  # asked with every heartbeat

    @property
    def nodes(self) -> tuple[str, ...]:
        """The failed nodes."""
        return tuple(node for node, life in self._lives.items() if life.failure)

    @property
    def reason(self) -> str:
        """What happened to each failed node."""
        return "; ".join(
            f"{node}: {life.failure}" for node, life in self._lives.items() if life.failure)

    @property
    def known(self) -> bool:
        """Whether each node was heard, or missed."""
        return self._known or all(life.heard or life.failure for life in self._lives.values())

    @property
    def due_s(self) -> float:
        """When the next heartbeat is overdue."""
        due_s = math.inf
        for life in self._lives.values():
            if life.due_s < due_s and not life.failure:
                due_s = life.due_s
        return due_s

    def beat(self, node: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Take note of a heartbeat that was sent at `stamp_s`."""
        life = self._lives.get(node)
        if life is None or incarnation < life.incarnation:
            return
        if incarnation > life.incarnation:
            self._succeed(life, incarnation)
        elif life.gone_s is not None and (
                stamp_s <= life.gone_s or not is_possible(stamp_s, now_s)):
            return  # sent before it died, and under way since; or nobody knows when
        life.gone_s = None
        life.heard = True
        life.failure = ""
        life.due_s = now_s + self.timeout_s

    def peer(self, node: str, incarnation: int, alive: bool, now_s: float) -> None:
        """Take note of a liveliness token that appears or vanishes."""
        life = self._lives.get(node)
        if life is None or incarnation < life.incarnation:
            return
        if alive:
            if incarnation > life.incarnation:
                first = life.incarnation == 0
                self._succeed(life, incarnation)
                if not first:  # at the very start the grace is longer, and still runs
                    life.due_s = now_s + self.timeout_s
            else:
                life.gone_s = None
            return
        life.incarnation = incarnation
        life.gone_s = now_s
        life.failure = f"process of incarnation {incarnation} is gone"

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed without a heartbeat."""
        for life in self._lives.values():
            if not life.failure and now_s >= life.due_s:
                life.failure = f"no heartbeat for {self.timeout_s:g} s" if life.heard \
                    else "never heard"

    @staticmethod
    def _succeed(life: _Life, incarnation: int) -> None:
        """A new life begins. A failure stays until its first heartbeat."""
        life.incarnation = incarnation
        life.gone_s = None
        life.heard = False
