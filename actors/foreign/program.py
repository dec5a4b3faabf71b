"""The program of a command: its file, its folder, and the place of its output."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from rampart.actors.runtime.run_plan import RunPlan
from rampart.manager.spec.nodes import NodeSpec
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import SpecificationError

LOGS = "logs"
"""Name of the folder with the output of commands, and of the link to it in the run folder."""


def check_programs(plan: RunPlan, spec: SystemSpec) -> None:
    """Check that the program of every command is executable.

    Raises:
        SpecificationError: A program is not; the message names file, node and program.
    """
    for error in wrong_programs(plan, spec):
        raise error


def wrong_programs(plan: RunPlan, spec: SystemSpec) -> Iterator[SpecificationError]:
    """Yield an error for each command whose program is not executable on this machine."""
    for node in spec.nodes:
        if node.command and (flaw := _flaw(plan, node)):
            field, value, problem = flaw
            yield SpecificationError(plan.system_file, f"{node.name}: {field}", problem, value)


def folder_of(plan: RunPlan, folder: str) -> Path:
    """Return the working directory of a command; it is relative to the system's file."""
    return Path(plan.system_file).resolve().parent / folder


def find_program(name: str, folder: Path, path: str | None = None) -> str | None:
    """Return the path of a program, None if no executable file has the name.

    Args:
        name: Relative to the folder if it has a slash, else searched in `PATH`.
        folder: Working directory of the command.
        path: `PATH` of its environment, if that has one.
    """
    if "/" in name:
        found = folder / name
        return str(found) if found.is_file() and os.access(found, os.X_OK) else None
    return shutil.which(name, path=path)


def inherited_environment() -> dict[str, str]:
    """Return the variables of this process for a program.

    Entries of PYTHONPATH that lead to a Rampart are left out: the program may have another virtual
    environment. The others may be those of a ROS 2.
    """
    found = dict(os.environ)
    entries = [one for one in found.pop("PYTHONPATH", "").split(os.pathsep)
               if one and not Path(one, "rampart").is_dir()]
    return {**found, **({"PYTHONPATH": os.pathsep.join(entries)} if entries else {})}


def log_folder(plan: RunPlan) -> Path:
    """Return the folder for the output of commands: beside the report, if there is one."""
    return (Path(plan.error_log).parent if plan.error_log else Path(plan.folder)) / LOGS


def make_log_folder(plan: RunPlan) -> str:
    """Make the folder for output, and a link to it in the folder of the run, for tools.

    Returns:
        Why output is not stored; "" if it is.
    """
    folder, here = log_folder(plan), Path(plan.folder, LOGS)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"its output is not stored: {error}"
    if plan.folder and here != folder:
        with contextlib.suppress(FileExistsError):
            here.symlink_to(folder)
    return ""


def _flaw(plan: RunPlan, node: NodeSpec) -> tuple[str, object, str] | None:
    folder = folder_of(plan, node.folder)
    if not folder.is_dir():
        return "folder", node.folder, f"no such folder: {folder}"
    name = node.command[0]
    if find_program(name, folder, node.env.get("PATH")):
        return None
    command = list(node.command)
    if "/" not in name:
        return "command", command, f"no program {name!r} in PATH; one in the folder is './{name}'"
    file = folder / name
    if file.is_file():
        return "command", command, f"{file} is not executable; use chmod +x"
    return "command", command, f"no such file: {file}"
