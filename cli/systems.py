"""The system a tool talks about: a spec file, the one of the run, or the shipped one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, TypeVar

from rampart import systems
from rampart.actors.bus.topic import Topic
from rampart.actors.layout.layout import application_class
from rampart.actors.layout.system_topics import declared_topics, own_topics, system_topics
from rampart.actors.layout.wiring import import_class
from rampart.cli.output import UsageError
from rampart.cli.robot_lines import RobotLines
from rampart.files import toml
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.specification import SpecificationError, SystemSpec, parse_specification

T = TypeVar("T")

DEFAULT = systems.DEFAULT


def add_arguments(parser: argparse.ArgumentParser, *, what: str = "", dest: str = "system") -> None:
    """Let a verb be told its system with or without `--system`.

    Args:
        parser: Of the verb; it takes nothing else without an option.
        what: It takes besides a system.
        dest: Where the choice is found in the options; None if there is none.
    """
    how = parser.add_mutually_exclusive_group()
    how.add_argument(dest, nargs="?", metavar="SPEC", default=argparse.SUPPRESS,
                     help=f"file, or name of a shipped system{what}; default the shipped one")
    how.add_argument("--system", dest=dest, metavar="SPEC", help="the same")


def load(file: str | None) -> SystemSpec:
    """Read a system spec.

    Args:
        file: path, or name of a shipped system; None for the shipped default.

    Raises:
        UsageError: it cannot be read, or makes no sense.
    """
    path = DEFAULT if file is None else systems.find(file)
    try:
        return parse_specification(read_text(path, toml.MAX_SIZE), str(path))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; a spec is right, or the name of a shipped "
                         f"one: {systems.names()}") from None
    except FileError as error:
        raise UsageError(f"{path}: {error}") from None
    except SpecificationError as error:
        raise UsageError(str(error)) from None


def declared(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return the topics of the engine and of a system's application.

    Raises:
        UsageError: the application's class cannot be had.
    """
    return _usable(declared_topics, spec)


def lines_of(spec: SystemSpec) -> RobotLines:
    """Return what is told of a system's robot.

    Raises:
        UsageError: the application's class cannot be had, or what it names for this.
    """
    return _usable(lambda of: import_class(
        application_class(of).lines, RobotLines, "lines")(), spec)


def topics_of(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return all topics of a system.

    Raises:
        UsageError: an actor class that the spec names cannot be had, or declares what is no topic.
    """
    return _usable(system_topics, spec)


def own_topics_of(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return the topics that a system has beyond the common ones.

    Raises:
        UsageError: as `topics_of`.
    """
    return _usable(own_topics, spec)


def _usable(of: Callable[[SystemSpec], T], spec: SystemSpec) -> T:
    try:
        return of(spec)
    except ValueError as error:
        raise UsageError(str(error)) from None
