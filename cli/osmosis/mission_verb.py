"""`rampart mission`: the operator's orders to the mission under way."""

from __future__ import annotations

import argparse
import asyncio
import uuid
from typing import Any

from rampart.actors.bus.envelope import Header
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.cli.osmosis.lines import mission_in_words
from rampart.cli.output import NoEffectError, UsageError, print_json, say
from rampart.cli.session import Session, connect, pause
from rampart.cli.verbs import JSON, PORT, add_verb, option, word

OPERATOR = "operator"
"""Author of the order, in the mission's state."""

MAX_REASON = 200
"""Characters of a reason, which every status of the mission repeats."""

_ANSWER_S = 5.0
"""Simulated seconds for the answer of the Mission Manager, also after a restart."""

_STATUS_S = 1.0
"""Simulated seconds within which it repeats its status (nominally each half second)."""


def add(verbs: Any, _formatter: Any, _common: Any) -> None:
    """Add the verb to the parser."""
    orders = [action.value for action in m.MissionAction]
    add_verb(verbs, "mission", "pause, resume or change the mission", mission, PORT,
             option("action", metavar="ORDER", choices=orders, help="one of the orders below"),
             word("--reason", "TEXT", "reason, kept and shown with the mission",
                  "no reason given"), JSON)


async def mission(options: argparse.Namespace) -> int:
    """Give an order, and print the result.

    Send an order to the Mission Manager, wait for its answer, and print the state
    of the mission.

    orders:
      pause   stop, and keep the goal
      resume  continue with the goal
      replan  continue on a newly planned route
      skip    leave out the present goal; the mission can no longer succeed
      cancel  end the mission where the robot is
      home    end the mission and drive to its start

    Examples:
      rampart mission pause --reason "runway in use"
      rampart mission resume
      rampart mission skip --reason "goal 2 is closed"
      rampart mission home --json
      rampart status                # show the state of the mission

    An order that does not fit the state of the mission is refused with the reason.
    `resume` does not release a robot that a recovery stops; see `rampart reset`.

    exit code: 0 obeyed, 1 refused or no answer, 2 bad usage or no run
    """
    order = m.MissionOrder(f"rampart-{uuid.uuid4().hex[:10]}", m.MissionAction(options.action),
                         checked_reason(options.reason), OPERATOR)
    async with connect(options.port) as session:
        asked = _Asked(session, order)
        if await session.command(topics.MISSION_ORDER, order, lambda: asked.answer is not None,
                                 session.real_s(_ANSWER_S)):
            await pause(asked.shown, session.real_s(_STATUS_S))
    answer, status = asked.answer, asked.status
    if answer is None:
        raise NoEffectError(f"no effect: the Mission Manager did not answer within {_ANSWER_S:g} s")
    if options.json:
        print_json({
            "order": order.order, "action": order.action, "accepted": answer.accepted,
            "reason": answer.reason, "plan": answer.plan,
            "mission": None if status is None else {
                "mission_id": status.mission_id, "name": status.name, "phase": status.phase,
                "step": status.step, "goals": len(status.goals), "reason": status.reason}})
    if not answer.accepted:
        raise NoEffectError(f"{order.action.value} refused: {answer.reason}")
    if not options.json:
        say(f"{order.action.value} obeyed; mission {mission_in_words(status)}")
    return 0


def checked_reason(text: str, option: str = "--reason") -> str:
    """Return a valid reason.

    Raises:
        UsageError: it is not one line of 1 to `MAX_REASON` printable characters.
    """
    reason = text.strip()
    if not reason or len(reason) > MAX_REASON or not reason.isprintable():
        raise UsageError(f"{option} {text[:40]!r}: must be one line of 1 to {MAX_REASON} printable "
                         "characters")
    return reason


class _Asked:
    """The Mission Manager's answer to an order, and its next status."""

    def __init__(self, session: Session, order: m.MissionOrder) -> None:
        self._order = order
        self._answered_s = 0.0
        self.answer: m.MissionOrderAnswer | None = None
        self.status: m.MissionStatus | None = None
        self.shown = asyncio.Event()
        session.listen(topics.MISSION_ORDER_ANSWER, self._reply)
        session.listen(topics.MISSION_STATUS, self._see)

    def _reply(self, _key: str, header: Header, answer: m.MissionOrderAnswer) -> None:
        if answer.order == self._order.order and self.answer is None:
            self.answer, self._answered_s = answer, header.stamp

    def _see(self, _key: str, header: Header, status: m.MissionStatus) -> None:
        # Only a status after the answer shows the effect of the order.
        if self.answer is not None and header.stamp >= self._answered_s:
            self.status = status
            self.shown.set()
