"""What a robot's package draws of runs, for the report of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from markupsafe import Markup

from rampart.sim.runs.record import RunRecord


class Moment(NamedTuple):
    """Something that happened at `at_s`, simulated seconds; the kind chooses its symbol.

    Kinds: fault, detected, narrow (the smallest margin), unsafe, end; "" without a symbol.
    """

    at_s: float
    kind: str
    name: str


class RunPictures:
    """Draws nothing; a robot's trial names a class derived from it, see `Trial.pictures`.

    Args:
        records: of all runs that are to be drawn.
    """

    style = Markup("")
    """CSS that the pictures need."""

    words = ""
    """What a reader has to know to read them."""

    def __init__(self, records: Sequence[Any]) -> None:
        del records

    def definitions(self) -> Markup:
        """Return what several pictures refer to, such as a map, as HTML."""
        return Markup("")

    def picture(self, record: RunRecord, key: str, title: str, marks: Sequence[Moment]) -> Markup:
        """Return the picture of a run as HTML.

        Args:
            record: of the run.
            key: that makes ids in the page unique.
            title: of the run.
            marks: what is to be marked in it.
        """
        del record, key, title, marks
        return Markup("")
