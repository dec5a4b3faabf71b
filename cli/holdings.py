"""Who makes the robot stand and is no recovery module of its system, as a tool hears it."""

from __future__ import annotations

import asyncio

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.cli.session import Session

HEARD_S = 0.3
"""Simulated seconds within which it is repeated (nominally each 0.2 s)."""

_NODES = 16
"""Which can be made to stand: more than there are."""


class Holdings:
    """What is held by strangers, by the node that obeys them; listens from the start.

    Args:
        session: the connection to the run.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._heard: Remembered[str, m.Holds] = Remembered(_NODES)
        session.listen(topics.HOLDS, topics.HOLDS.pattern, self._keep)

    def _keep(self, _key: str, header: Header, body: m.Holds) -> None:
        self._heard[header.source] = body

    async def settle(self) -> None:
        """Wait until all that is held has been heard."""
        await asyncio.sleep(self._session.real_s(HEARD_S))

    def by(self, name: str) -> tuple[str, ...]:
        """Return what somebody holds."""
        return tuple(holds.what for holds in self._heard.values() if name in holds.holders)

    @property
    def holders(self) -> dict[str, tuple[str, ...]]:
        """Everybody who holds something, with what it is."""
        names = dict.fromkeys(name for holds in self._heard.values() for name in holds.holders)
        return {name: self.by(name) for name in names}
