"""The system of a verb: a file, that of the run, or a shipped one."""

from __future__ import annotations

import argparse
import contextlib

from rampart import systems
from rampart.actors.bus.run_info import NoRunError, find_run
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import (
    REPORTS_ON,
    application_class,
    import_class,
    load_application,
    load_member,
)
from rampart.actors.system.topics import system_topics
from rampart.cli.output import UsageError
from rampart.cli.robot_lines import RobotLines
from rampart.cli.verbs import Option, either, option, port_of_environment
from rampart.files import toml, working_folder
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.specification import SystemSpec, parse_specification
from rampart.sim.faults.faults import faults_of
from rampart.sim.runs.trial import trial_class

DEFAULT = systems.DEFAULT


def choice(dest: str = "system", what: str = "", default: str = DEFAULT.stem) -> Option:
    """Return an argument for a system, which may stand with or without `--system`.

    Args:
        dest: attribute of the options, None without a choice.
        what: other values that the verb accepts.
        default: the default in words.
    """
    return either(
        option(dest, nargs="?", metavar="SPEC", default=argparse.SUPPRESS,
               help=f"system file, or name of a shipped system{what} (default: {default})"),
        option("--system", dest=dest, metavar="SPEC", help="same as SPEC"))


def load(file: str | None) -> SystemSpec:
    """Read a specification.

    This checks the parameters of shipped detection and recovery modules. It does not import other
    classes, because the file may be from a stranger.

    Args:
        file: path, or name of a shipped system; None for the shipped default.

    Raises:
        ValueError: the file cannot be read, or is not sound.
    """
    path = DEFAULT if file is None else systems.find(file)
    working_folder.admit(path.parent)
    try:
        spec = parse_specification(read_text(path, toml.MAX_SIZE), str(path))
        for node in spec.actors():
            if node.kind in REPORTS_ON and node.actor.startswith("rampart."):
                load_member(node, spec, str(path))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; expected a system file, or the name of a "
                         f"shipped system: {systems.names()}") from None
    except FileError as error:
        raise UsageError(f"{path}: {error}") from None
    return spec


def at_hand(file: str | None, port: int | None = None) -> SystemSpec:
    """Read a named system, else that of the run, else the shipped default.

    Args:
        file: as in `load`.
        port: base port of the run, if there are several.

    Raises:
        ValueError: as of `load`.
    """
    if file is None:
        with contextlib.suppress(NoRunError, ValueError):
            return load(find_run(port or port_of_environment()).system_file)
    return load(file)


def check(file: str | None) -> Layout:
    """Check a system as a start does, with all classes imported, and return its layout.

    Args:
        file: as in `load`.

    Raises:
        ValueError: the system is not sound; one line.
    """
    spec = load(file)
    plan = RunPlan(system_file=str(DEFAULT if file is None else systems.find(file)))
    layout = Layout(plan, spec)
    load_application(plan, spec)
    try:
        system_topics(spec)
        trial_class(spec)
        faults_of(spec)
        lines_of(spec)
    except ValueError as error:
        raise UsageError(f"{plan.system_file}: {error}") from None
    return layout


def lines_of(spec: SystemSpec) -> RobotLines:
    """Return the lines of a system's robot."""
    return import_class(application_class(spec).lines, RobotLines, "lines")()
