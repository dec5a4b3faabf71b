"""The system a tool talks about: a spec file, the one of the run, or the shipped one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TypeVar

from rampart import systems
from rampart.actors.layout.layout import application_class
from rampart.actors.layout.system_topics import declared_topics, own_topics, system_topics
from rampart.actors.layout.wiring import REPORTS_ON, import_class, load_member
from rampart.cli.output import UsageError
from rampart.cli.robot_lines import RobotLines
from rampart.files import toml
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.specification import SystemSpec, parse_specification

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

    Parameters are checked of the detection and recovery modules that ship. Others are imported when
    they are started, and for no look at a file that somebody else may have written.

    Args:
        file: path, or name of a shipped system; None for the shipped default.

    Raises:
        UsageError: it cannot be read, or makes no sense.
    """
    path = DEFAULT if file is None else systems.find(file)
    try:
        spec = parse_specification(read_text(path, toml.MAX_SIZE), str(path))
        for node in spec.actors():
            if node.kind in REPORTS_ON and node.actor.startswith("rampart."):
                load_member(node, spec, str(path))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; a spec is right, or the name of a shipped "
                         f"one: {systems.names()}") from None
    except FileError as error:
        raise UsageError(f"{path}: {error}") from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    return spec


def _usable(of: Callable[[SystemSpec], T]) -> Callable[[SystemSpec], T]:
    """Return a function of a system that has users told what its actors or application lack."""
    def told(spec: SystemSpec) -> T:
        try:
            return of(spec)
        except ValueError as error:
            raise UsageError(str(error)) from None
    return told


def _lines_of(spec: SystemSpec) -> RobotLines:
    return import_class(application_class(spec).lines, RobotLines, "lines")()


declared = _usable(declared_topics)
"""Returns the topics of the engine and of a system's application."""

topics_of = _usable(system_topics)
"""Returns all topics of a system."""

own_topics_of = _usable(own_topics)
"""Returns the topics that a system has beyond the declared ones."""

lines_of = _usable(_lines_of)
"""Returns what is told of a system's robot."""
