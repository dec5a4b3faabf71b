"""What a page of Osmosis may ask for besides what every page may. Pure."""

from __future__ import annotations

from rampart.actors.operator.requests import REQUESTS, Name, Request
from rampart.actors.osmosis.messages import MissionAction
from rampart.actors.web.visitors import Role


class StartRequest(Request, frozen=True, tag="mission"):
    """A mission of the airport is to be started."""

    role = Role.DRIVE
    name: Name


class OrderRequest(Request, frozen=True, tag="order"):
    """Something is to be done with the mission under way."""

    role = Role.DRIVE
    action: MissionAction
    reason: Name = ""


OSMOSIS_REQUESTS: tuple[type[Request], ...] = (*REQUESTS, StartRequest, OrderRequest)
