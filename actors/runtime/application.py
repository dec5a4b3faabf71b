"""The part of a system that is not the engine's: its topics, its place, its task.

The table `[application]` of a system names as `class` a class derived from `Application`. The other
keys there, and the command line, are its options:

    [application]
    class = "rampart.actors.osmosis.application:Osmosis"
    airport = "vallombre"

It is loaded once for a run, before the processes are forked, and read-only afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import msgspec

from rampart.actors import ROLES
from rampart.actors.bus.topic import Topic


class Application:
    """Base of all applications, and the one of a system that names none.

    Class paths below have the form `module:Class`; "" stands for none.

    Class attributes:
        topics: topics of its actors besides the engine's.
        views: path of the class that translates its topics for viewers.
        lines: path of the class that shows its topics in `rampart status`, `top` and `metrics`.
        model: path of its `RobotModel` in MuJoCo, which replays show.
        faults: path of its `Faults`.
        observer: path of the class that records a run for judge and report.
        examples: examples for the help of the command line: options, and their effect.
        trial: path of its `Trial`; without one its runs have no verdict.

    Attributes:
        options: the options of this run.

    Raises:
        ValueError: a file that an option names does not exist or is wrong; file, field and value.
    """

    class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
        """Options of a run; each field is an option of the command line, with its help.

        Keys in the `extra` of a field's `msgspec.Meta`: `metavar`; `file`: the value may be a path;
        `campaign`: default in a campaign, values separated by commas.
        """

    topics: ClassVar[tuple[Topic[Any], ...]] = ()
    views: ClassVar[str] = ROLES["views"]
    lines: ClassVar[str] = ROLES["lines"]
    model: ClassVar[str] = ""
    faults: ClassVar[str] = ""
    observer: ClassVar[str] = ROLES["observer"]
    trial: ClassVar[str] = ""
    examples: ClassVar[tuple[tuple[str, str], ...]] = ()

    def __init__(self, options: Any = None) -> None:
        self.options = options or self.Options()

    def world_parameters(self) -> Mapping[str, Any]:
        """Return parameters for the node that simulates the world."""
        return {}

    def documents(self) -> list[tuple[str, Path]]:
        """Return the files that a recording includes: `FOLDER/NAME` there, and path here."""
        return []

    @classmethod
    def restored(cls, directory: Path) -> Application:
        """Return the application for a replay's page, from the documents of a recording.

        Args:
            directory: contains the files, with their names in the recording.

        Raises:
            OSError, ValueError: a file cannot be read or is wrong.
        """
        del directory
        return Application()

    @classmethod
    def said(cls, name: str, value: Any) -> str:
        """Return an option's value in words, as a condition in the report of a campaign."""
        return f"{name} {value}"

    @classmethod
    def of(cls, context: Any) -> Self:
        """Return the application of the run of an actor, by its `Context`.

        Raises:
            ValueError: the run's application is of another class.
        """
        return cls.of_run(context.run)

    @classmethod
    def of_run(cls, run: Any) -> Self:
        """Return the application of a run, by its `RunContext`; raises as `of`."""
        found = run.application
        if not isinstance(found, cls):
            raise ValueError(f"[application] of class {type(found).__name__}, expected "
                             f"{cls.__module__}:{cls.__name__}")
        return found
