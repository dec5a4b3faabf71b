"""Campaigns of a robot's package: chosen runs with expected results.

Entry points of the group `rampart.campaigns` name classes derived from `NamedCampaign`. Each adds
its options to `rampart campaign`.
"""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

from markupsafe import Markup

from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.job import Job
from rampart.sim.campaign.statistics import Row
from rampart.sim.campaign.store import Run


@dataclass(frozen=True)
class Section:
    """Additional section of a campaign's report.

    Args:
        sentence: For the headline.
        html: Makes the section from the keys of the runs shown one by one, and a function from a
            run's key to the command that repeats it.
    """

    sentence: str
    html: Callable[[set[str], Callable[[str], str]], Markup]


class NamedCampaign(ABC):
    """A campaign with expected results.

    Attributes:
        flag: Its option.
        name: Name of the folder of its results.
        title: Title of its report.
        system: Its system, unless `--system` names another.
    """

    flag: str
    name: str
    title: str
    system: str

    @classmethod
    @abstractmethod
    def add(cls, group: Any) -> None:
        """Add its options to an argument group."""

    @classmethod
    @abstractmethod
    def chosen(cls, options: argparse.Namespace) -> Self | None:
        """Return the campaign if the options select it, else None.

        Raises:
            ValueError: The options are invalid.
        """

    @abstractmethod
    def jobs(self, base: Job) -> list[Job]:
        """Return its runs; `base` has the chosen system, options and seed."""

    @abstractmethod
    def section(self, spec: SystemSpec, runs: Sequence[Run]) -> Section:
        """Return its section of the report."""

    @abstractmethod
    def show(self, spec: SystemSpec, runs: Sequence[Run]) -> None:
        """Print its results."""

    def expected(self, runs: Sequence[Run], row: Row) -> dict[str, Any]:
        """Return what `--json` adds to a row."""
        del runs, row
        return {}

    def failed(self, runs: Sequence[Run]) -> bool:
        """Return whether the exit code has to be 1."""
        del runs
        return False
