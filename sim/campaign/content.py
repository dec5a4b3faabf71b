"""Digest of the system's files and code, the content of a run besides its job.

A stored result is valid only for the same content. So the digest is part of the job, and of the key
of the result. It covers the specification, the application's files, files that specification and
options name, the code of the packages of the system's own classes, and the engine.
"""

from __future__ import annotations

import hashlib
import importlib.util
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
from rampart.sim.runs.trial import trial_class

_ENGINE_ROOMS = ("files", "manager", "actors", "sim")
_ENGINE_FILES = {".py", ".xml"}
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
    for path in sorted({path.resolve() for path in paths} | set(_sources(names))):
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ValueError(f"{path}: {error.strerror}; it belongs to {file}") from None
        digest.update(f"{path.name} {len(data)}\n".encode() + data)
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


def _sources(modules: Iterable[str]) -> set[Path]:
    """Return the code of the user's modules: their packages, or the files beside them."""
    found: set[Path] = set()
    for top in {name.partition(".")[0] for name in modules} - {"rampart"}:
        spec = importlib.util.find_spec(top)
        if spec is not None and spec.origin:
            file = Path(spec.origin)
            found |= set(file.parent.rglob("*.py") if spec.submodule_search_locations else
                         file.parent.glob("*.py"))
        elif spec is not None:
            found |= {path for folder in spec.submodule_search_locations or ()
                      for path in Path(folder).rglob("*.py")}
    return {path.resolve() for path in found}
