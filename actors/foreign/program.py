"""Which program the command of a node is, where it runs, and where its output is kept."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from rampart.actors.runtime.run_plan import RunPlan
from rampart.manager.spec.nodes import NodeSpec
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import SpecificationError

LOGS = "logs"
"""Name of the folder with the output of commands, and of a link to it in the folder of the run."""


def check_programs(plan: RunPlan, spec: SystemSpec) -> None:
    """Make sure that the program of every command can be executed.

    Raises:
        SpecificationError: one cannot; the message names file, node and program.
    """
    for node in spec.nodes:
        if node.command and (flaw := _flaw(plan, node)):
            field, value, problem = flaw
            raise SpecificationError(plan.system_file, f"{node.name}: {field}", problem, value)


def folder_of(plan: RunPlan, folder: str) -> Path:
    """Return in which folder a command runs: one relative to that of the system's file."""
    return Path(plan.system_file).resolve().parent / folder


def find_program(name: str, folder: Path, path: str | None = None) -> str | None:
    """Return the path of a program, None if nothing that can be executed has its name.

    Args:
        name: With a slash in it relative to the folder, else one to be looked for in `PATH`.
        folder: In which it runs.
        path: Of its environment, if that says one.
    """
    if "/" in name:
        found = folder / name
        return str(found) if found.is_file() and os.access(found, os.X_OK) else None
    return shutil.which(name, path=path)


def log_folder(plan: RunPlan) -> Path:
    """Return where the output of commands is kept: beside the report, if there is one."""
    return (Path(plan.error_log).parent if plan.error_log else Path(plan.folder)) / LOGS


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
        return "command", command, f"{file} is not executable; chmod +x makes it so"
    return "command", command, f"no such file: {file}"
