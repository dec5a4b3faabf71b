"""What a system adds to the engine: its topics, and what its actors know of place and task.

The table `[application]` of a system names a class derived from `Application` as `class`; the other
keys there, and what the command line says, are its options:

    [application]
    class = "rampart.actors.osmosis.application:Osmosis"
    airport = "vallombre"

It is loaded once for a run, before its processes are forked, and read-only afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import msgspec

from rampart.actors import ROLES
from rampart.actors.bus.topic import Topic
from rampart.manager.spec.schema import SystemSpec


class Application:
    """The application of a system that names none: no topics, no options, nothing to know.

    Class attributes:
        topics: what its actors publish and hear besides the engine's topics.
        views: class that translates them for viewers, as `module:Class`, derived from this one.
        lines: class that tells of them in `rampart status`, `top` and `metrics`, likewise.
        model: class path of its `RobotModel`, which replays show; "" if it has none in MuJoCo.
        faults: class path of its `Faults`; "" if it has none of its own.
        observer: class path of who hears a run for judge and report.
        examples: of the command line, for its help: options, and what they do.
        trial: class path of the `Trial` that its runs are; "" if they have no verdict.

    Attributes:
        options: what was chosen for this run.

    Raises:
        ValueError: what the options name does not exist or is unsound; file, field and value.
    """

    class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
        """What a run can be told; fields are options of the command line, with their help.

        The `extra` of a field's `msgspec.Meta` may say: `metavar`; `file`, that a value may be a
        path; `alone`, the value of an option that is given without one; `campaign`, what a campaign
        takes for it when the user says nothing, values separated by commas; `real`, that it is of
        no use in virtual time.
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
        """Return what the node that simulates the world has to know of the options."""
        return {}

    def documents(self) -> list[tuple[str, Path]]:
        """Return the files that belong to a recording: `FOLDER/NAME` there, and where they are."""
        return []

    @classmethod
    def restored(cls, directory: Path) -> Application:
        """Return what a replay's page is to know, from the documents of a recording.

        Args:
            directory: where the files are, by their name in the recording.

        Raises:
            OSError, ValueError: one of them cannot be read or is unsound.
        """
        del directory
        return Application()

    def check(self, spec: SystemSpec, *, virtual: bool) -> str:
        """Return what the user has to be told before the run starts, "" for nothing.

        Args:
            spec: the system.
            virtual: whether it is run in virtual time.

        Raises:
            ValueError: the options do not fit the system or the kind of run.
        """
        del spec, virtual
        return ""

    @classmethod
    def said(cls, name: str, value: Any) -> str:
        """Return an option's value in words, as the report of a campaign names its conditions."""
        return f"{name} {value}"

    @classmethod
    def simpler(cls, options: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return simpler options than these: what a search tries to find a smaller counterexample.

        Args:
            options: of an unsafe run.
        """
        del options
        return []

    @classmethod
    def of(cls, context: Any) -> Self:
        """Return the application of the run in which an actor is started, by its `Context`.

        Raises:
            ValueError: it is another one.
        """
        return cls.of_run(context.run)

    @classmethod
    def of_run(cls, run: Any) -> Self:
        """Return the application of a run, by its `RunContext`; errors as of `of`."""
        found = run.application
        if not isinstance(found, cls):
            raise ValueError(f"needs an [application] of class {cls.__module__}:{cls.__name__}; "
                             f"this system has {type(found).__name__}")
        return found
