"""Campaigns that a robot's package brings: chosen runs, and what is expected of them.

Entry points of the group `rampart.campaigns` name classes derived from `NamedCampaign`; each adds
options of its own to `rampart campaign`.
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
    """What the report of a campaign says beyond what it says of any.

    Args:
        sentence: of the headline.
        html: makes the section, given the keys of the runs that the page shows one by one, and a
            function from a run's key to the command that repeats it.
    """

    sentence: str
    html: Callable[[set[str], Callable[[str], str]], Markup]


class NamedCampaign(ABC):
    """A campaign with an expectation of each of its runs.

    Attributes:
        flag: option that asks for it.
        name: of the folder of its results.
        title: of its report.
        system: that it is for unless `--system` names another.
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
        """Return the campaign that the options ask for; None for another one.

        Raises:
            ValueError: they make no sense.
        """

    @abstractmethod
    def jobs(self, base: Job) -> list[Job]:
        """Return its runs; `base` has system, options and seed as they were asked for."""

    @abstractmethod
    def section(self, spec: SystemSpec, runs: Sequence[Run]) -> Section:
        """Return what its report says."""

    @abstractmethod
    def show(self, spec: SystemSpec, runs: Sequence[Run]) -> None:
        """Print what came of it."""

    def expected(self, runs: Sequence[Run], row: Row) -> dict[str, Any]:
        """Return what `--json` adds to a row."""
        del runs, row
        return {}

    def failed(self, runs: Sequence[Run]) -> bool:
        """Tell whether the outcome is such that the exit code has to be 1."""
        del runs
        return False
