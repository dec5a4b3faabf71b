"""Digest of the system's files and code, the content of a run besides its job.

A stored result is valid only for the same content. So the digest is part of the job, and of the key
of the result. It covers the specification, the application's files, files that specification and
options name, the packages of the system's own classes, and the engine. It also covers models
and data beside the specification. Other files there, such as logs and recordings, change during a
campaign and would prevent its continuation.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

import rampart
from rampart.actors.system.members import application_class, judge_class
from rampart.manager.spec.specification import check_document
from rampart.sim.campaign.job import Job, application_of_job, read_document_of
from rampart.sim.campaign.store import FILE_NAME
from rampart.sim.runs.trial import trial_class

_ENGINE_ROOMS = ("files", "manager", "actors", "sim")
_ENGINE_FILES = {".py", ".xml"}
_DATA_FILES = {".xml", ".mjcf", ".mjb", ".urdf", ".stl", ".obj", ".msh", ".skn", ".dae", ".png",
               ".bin", ".csv", ".npy", ".npz", ".yaml", ".yml"}
_FOREIGN_FOLDERS = {"reports", "__pycache__", "node_modules"}
_FOREIGN_MARKS = {"pyvenv.cfg", FILE_NAME}
"""A folder below the robot's that contains one of these is an environment or a campaign."""
_LEVELS = 3
_LONGEST_NAME = 400
_DIGITS = 16


def with_content(jobs: Iterable[Job]) -> list[Job]:
    """Return jobs with their present digest.

    Raises:
        ValueError: A system or its options are invalid, or a file cannot be read.
    """
    found: dict[bytes, str] = {}
    made = []
    for job in jobs:
        chosen = msgspec.json.encode((job.system, job.options), order="deterministic")
        if chosen not in found:
            found[chosen] = content_of(job)
        made.append(msgspec.structs.replace(job, content=found[chosen]))
    return made


def content_of(job: Job) -> str:
    """Return the digest for a job; raises as `with_content`."""
    file, document = read_document_of(job.system)
    spec = check_document(document, file)
    application = application_of_job(job)
    classes = [type(application), judge_class(spec), trial_class(spec)]
    names = {kind.__module__ for kind in classes if kind is not None}
    names |= {node.actor.partition(":")[0] for node in spec.actors()}
    kind = application_class(spec)
    names |= {path.partition(":")[0] for path in (kind.faults, kind.observer, kind.trial) if path}
    digest = hashlib.sha256(msgspec.json.encode(document, order="deterministic"))
    digest.update(_engine().encode())
    paths = [path for _, path in application.documents()]
    paths += _named((document, job.options), Path(file).parent)
    paths += [path for path in _files_below(Path(file).parent)
              if path.suffix.lower() in _DATA_FILES]
    for path in sorted({path.resolve() for path in paths} | set(_sources(names))):
        try:
            with path.open("rb") as opened:
                content = hashlib.file_digest(opened, "sha256").digest()
        except OSError as error:
            raise ValueError(f"{path}: {error.strerror}; it belongs to {file}") from None
        digest.update(f"{path.name}\n".encode() + content)
    return digest.hexdigest()[:_DIGITS]


@cache
def _engine() -> str:
    """Return a digest of the engine's version and code."""
    root = Path(rampart.__file__).parent
    digest = hashlib.sha256(version("rampart-robot").encode())
    for room in _ENGINE_ROOMS:
        folder = (root / room).resolve()
        for path in sorted(p for p in folder.rglob("*") if p.suffix in _ENGINE_FILES):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


def _named(value: Any, beside: Path) -> Iterator[Path]:
    """Yield files named by texts, in the working folder or beside the specification."""
    if isinstance(value, str) and 0 < len(value) <= _LONGEST_NAME and "\0" not in value:
        yield from (path for path in (Path(value), beside / value) if path.is_file())
    elif isinstance(value, dict):
        yield from (path for member in value.values() for path in _named(member, beside))
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        yield from (path for member in value for path in _named(member, beside))


def _files_below(folder: Path) -> Iterator[Path]:
    """Yield the robot's files in a folder and at most `_LEVELS` folders below it."""
    for name, folders, files in os.walk(folder):
        here = Path(name)
        if here != folder and not _FOREIGN_MARKS.isdisjoint(files):
            folders.clear()
            continue
        deep = len(here.relative_to(folder).parts) >= _LEVELS
        folders[:] = [] if deep else [below for below in folders if not below.startswith(".")
                                      and below not in _FOREIGN_FOLDERS]
        yield from (here / file for file in files
                    if not file.startswith(".") and (here / file).is_file())


def _sources(modules: Iterable[str]) -> set[Path]:
    """Return the files of the user's packages, or the code beside a module without a package."""
    found: set[Path] = set()
    for top in {name.partition(".")[0] for name in modules} - {"rampart"}:
        spec = importlib.util.find_spec(top)
        if spec is None:
            continue
        for folder in map(Path, spec.submodule_search_locations or ()):
            found |= {*folder.rglob("*.py"), *_files_below(folder)}
        if spec.origin and not spec.submodule_search_locations:
            found |= set(Path(spec.origin).parent.glob("*.py"))
    return {path.resolve() for path in found}
