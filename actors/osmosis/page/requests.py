"""What a page of Osmosis may ask for besides what every page may. Pure."""

from __future__ import annotations

from rampart.actors.operator.requests import REQUESTS, Name, Request
from rampart.actors.osmosis.messages import MissionAction


class StartRequest(Request, frozen=True, tag="mission"):
    """A mission of the airport is to be started."""

    name: Name


class OrderRequest(Request, frozen=True, tag="order"):
    """Something is to be done with the mission under way."""

    action: MissionAction
    reason: Name = ""


class StickRequest(Request, frozen=True, tag="stick"):
    """Where the operator's stick is, and whether the dead man is held.

    `ticket` is the newest that the page was given (`stick`). Forward and left are in [-1, 1].
    """

    held: bool
    ticket: int = 0
    forward: float = 0.0
    left: float = 0.0


OSMOSIS_REQUESTS: tuple[type[Request], ...] = (*REQUESTS, StartRequest, OrderRequest, StickRequest)
