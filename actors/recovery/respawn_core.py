"""Respawning nodes: what to ask of the supervisor, and when it has worked.

For each failed node the core asks the supervisor for a new life and waits for its proof, a
heartbeat. What makes this more than one message is that a request names the *failed incarnation*,
so that asking twice, or asking about a node that is back already, kills nobody who is well:

* A life whose token has vanished, or whose heartbeat is overdue, has failed: it is named.
* A life that was heard a moment ago is not accused. The request names its predecessor, and the
  supervisor, who holds the process's pidfd and knows better, respawns it or answers that it is
  there. This happens when this module was itself respawned and is commanded again, and when a
  stopped process was continued just in time.
* A node that is well by all signs of life may be wrong all the same: who has compared what it says
  names the life, `NAME#INCARNATION`, and that life is accused, a later one is not.
* A new life that dies, or is not heard within a while, has failed as well: the next request names
  it. The supervisor counts, and gives up when there are too many.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple


class Stage(Enum):
    """How far the respawn of one node is."""

    NONE = "not asked for"
    ASKED = "asked for"
    STARTED = "started"
    BACK = "back"
    FAILED = "failed"


class Ask(NamedTuple):
    """A request to the supervisor; repeated with the same number until it is answered."""

    request: int
    node: str
    failed_incarnation: int


_NOTHING_ASKED = Ask(0, "", 0)


@dataclass(slots=True)
class _Node:
    """What is known of one node. Times are simulated seconds."""

    heard_s: float
    incarnation: int = 0
    gone_s: float | None = None
    stage: Stage = Stage.NONE
    ask: Ask = _NOTHING_ASKED
    asked_s: float = 0.0
    started_s: float = 0.0
    problem: str = ""


class RespawnCore:
    """The respawns of one recovery module. Requests pile up until `take_requests`.

    Args:
        nodes: the nodes that it may respawn.
        first_request: number of the first request.
        start_s: now.
        overdue_s: age at which a heartbeat is overdue.
        start_timeout_s: how long a new life may take to be heard.
    """

    def __init__(self, nodes: Iterable[str], first_request: int, start_s: float,
                 overdue_s: float = 0.25, start_timeout_s: float = 1.0) -> None:
        self._nodes = {name: _Node(heard_s=start_s) for name in nodes}
        self._next_request = first_request
        self._overdue_s = overdue_s
        self._start_timeout_s = start_timeout_s
        self._strangers: tuple[str, ...] = ()
        self._requests: list[Ask] = []

    # -- orders ---------------------------------------------------------------------------------

    def order(self, nodes: Iterable[str], now_s: float, *, renewed: bool) -> bool:
        """Have nodes respawned: all that are named and not on their way already.

        Args:
            nodes: names, each perhaps with the incarnation that is wrong, `NAME#INCARNATION`.
            now_s: now.
            renewed: it is a new order, so that what was given up is to be tried again.

        Returns:
            Whether there was anything to ask for.
        """
        requests = len(self._requests)
        named = tuple(map(accused_life, nodes))
        self._strangers = tuple(name for name, _ in named if name not in self._nodes)
        for name, wrong in named:
            node = self._nodes.get(name)
            if node is None:
                continue
            if node.stage is Stage.NONE or (node.stage is Stage.FAILED and renewed) or (
                    node.stage is Stage.BACK
                    and (self._has_failed(node, now_s) or wrong >= node.incarnation > 0)):
                self._ask(name, node, now_s, wrong)
        return len(self._requests) > requests

    def release(self) -> None:
        """Forget all orders."""
        self._strangers = ()
        self._requests.clear()
        for node in self._nodes.values():
            node.stage = Stage.NONE

    def take_requests(self) -> list[Ask]:
        """Return the requests to send now, each once."""
        requests, self._requests = self._requests, []
        return requests

    # -- what is heard --------------------------------------------------------------------------

    def beat(self, name: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Take note of a heartbeat sent at `stamp_s`."""
        node = self._nodes.get(name)
        if node is None or incarnation < node.incarnation:
            return
        if incarnation == node.incarnation and node.gone_s is not None \
                and stamp_s <= node.gone_s:
            return  # sent before it died, and under way since
        node.incarnation = incarnation
        node.gone_s = None
        node.heard_s = now_s
        # A heartbeat that was under way when the order came proves nothing.
        if node.stage in (Stage.ASKED, Stage.STARTED, Stage.FAILED) \
                and incarnation > node.ask.failed_incarnation and stamp_s >= node.asked_s:
            node.stage = Stage.BACK

    def peer(self, name: str, incarnation: int, alive: bool, now_s: float) -> None:
        """Take note of a process that appears or is gone."""
        node = self._nodes.get(name)
        if node is None or incarnation < node.incarnation:
            return
        if incarnation > node.incarnation:
            node.incarnation = incarnation
            node.heard_s = now_s  # not heard yet, but not overdue either
        node.gone_s = None if alive else now_s
        if not alive and incarnation > node.ask.failed_incarnation \
                and node.stage in (Stage.ASKED, Stage.STARTED):
            self._ask(name, node, now_s)

    def event(self, name: str, event: str, incarnation: int, detail: str, now_s: float) -> None:
        """Take note of what the supervisor says of a process."""
        node = self._nodes.get(name)
        if node is None:
            return
        waiting = node.stage in (Stage.ASKED, Stage.STARTED)
        if event == "respawned":
            if node.stage is Stage.ASKED:
                node.stage = Stage.STARTED
                node.started_s = now_s
                node.ask = node.ask._replace(failed_incarnation=max(
                    node.ask.failed_incarnation, incarnation - 1))
        elif event == "crashed":
            self.peer(name, incarnation, False, now_s)
        elif event in ("refused", "given up") and waiting:
            node.stage = Stage.FAILED
            node.problem = f"{name}: {event}{f', {detail}' if detail else ''}"

    def retry(self, now_s: float) -> None:
        """Repeat requests that are unanswered; ask anew for a new life that is not heard."""
        for name, node in self._nodes.items():
            if node.stage is Stage.ASKED:
                self._requests.append(node.ask)
            elif node.stage is Stage.STARTED and now_s - node.started_s >= self._start_timeout_s:
                self._ask(name, node, now_s)

    # -- how it stands --------------------------------------------------------------------------

    @property
    def pending(self) -> tuple[str, ...]:
        """Nodes that are ordered and neither back nor given up."""
        return tuple(name for name, node in self._nodes.items()
                     if node.stage in (Stage.ASKED, Stage.STARTED))

    @property
    def back(self) -> tuple[str, ...]:
        """Nodes that are back."""
        return tuple(n for n, node in self._nodes.items() if node.stage is Stage.BACK)

    @property
    def problem(self) -> str:
        """Why it cannot succeed; "" if it still may."""
        problems = [n.problem for n in self._nodes.values() if n.stage is Stage.FAILED]
        problems += [f"{name}: not among the nodes that this module may respawn"
                     for name in self._strangers]
        return "; ".join(problems)

    def _has_failed(self, node: _Node, now_s: float) -> bool:
        return node.gone_s is not None or now_s - node.heard_s >= self._overdue_s

    def _ask(self, name: str, node: _Node, now_s: float, wrong: int = 0) -> None:
        failed = node.incarnation if self._has_failed(node, now_s) else node.incarnation - 1
        node.ask = Ask(self._next_request, name, max(0, failed, wrong))
        node.stage = Stage.ASKED
        node.asked_s = now_s
        self._next_request += 1
        self._requests.append(node.ask)


def accused_life(node: str) -> tuple[str, int]:
    """Return name and incarnation of `NAME#INCARNATION`; 0 if it names no life of the node."""
    name, _, life = node.partition("#")
    return name, int(life) if life.isdecimal() else 0
