"""The operator's page on a replay: it shows everything, and nothing can be asked of it."""

from __future__ import annotations

from typing import Any

from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.requests import RefusedError, Request

NAME = "replay_page"
"""Not that of the page of which there is a recording."""


class ReplayPage(Hmi):
    """A page in front of the past."""

    def _fulfil(self, request: Request, page: int) -> str | dict[str, Any]:  # noqa: ARG002
        raise RefusedError("this is a replay: there is no robot to obey")

    def _look(self) -> None:
        """Measure nothing: the recorded process numbers may be anybody's today."""


def replay_page(kind: type[Hmi]) -> type[Hmi]:
    """Return the class of page that shows what one of a robot would."""
    return ReplayPage if kind is Hmi else type("ReplayPage", (ReplayPage, kind), {})
