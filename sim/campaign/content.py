"""What goes into a run besides its job: the system's files and code, as one digest.

A stored result stands for a run only as long as all of it is the same. So the digest is part of
the job, and with it of the key under which the result is found again. It covers the specification
as it was read, the application's files, files that specification and options name, the code of the
system's own modules with what they import of their own, and the engine.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sysconfig
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
    """Return jobs with the digest of what goes into them today.

    Raises:
        ValueError: a system or its options make no sense, or a file cannot be read.
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
    """Return the digest of what goes into a job's run; raises as `with_content`."""
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
    """Return the version of the engine, and a digest of its code."""
    root = Path(rampart.__file__).parent
    digest = hashlib.sha256(version("rampart").encode())
    for room in _ENGINE_ROOMS:
        folder = (root / room).resolve()
        for path in sorted(p for p in folder.rglob("*") if p.suffix in _ENGINE_FILES):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


def _named(value: Any, beside: Path) -> Iterator[Path]:
    """Yield the files that texts name, from the working folder or beside the specification."""
    if isinstance(value, str) and 0 < len(value) <= _LONGEST_NAME and "\0" not in value:
        yield from (path for path in (Path(value), beside / value) if path.is_file())
    elif isinstance(value, dict):
        yield from (path for member in value.values() for path in _named(member, beside))
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        yield from (path for member in value for path in _named(member, beside))


def _sources(modules: Iterable[str]) -> set[Path]:
    """Return the files of modules of the user's own, and of those that they import likewise."""
    left = sorted(modules)
    own = {name.partition(".")[0] for name in left}
    seen: set[str] = set()
    found: set[Path] = set()
    while left:
        name = left.pop()
        if name in seen or name.partition(".")[0] == "rampart":
            continue
        seen.add(name)
        file = _file_of(name)
        if file is None or (name.partition(".")[0] not in own and _is_installed(file)):
            continue
        found.add(file)
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        left += [*_imports(file, package), *([name.rpartition(".")[0]] if "." in name else [])]
    return found


def _file_of(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError, AttributeError):
        return None  # `from package import name`, where the name is no module
    file = Path(spec.origin) if spec is not None and spec.origin else None
    return file.resolve() if file is not None and file.suffix == ".py" else None


def _is_installed(file: Path) -> bool:
    """Tell whether a file is of the standard library or another package."""
    return any(file.is_relative_to(Path(path).resolve())
               for name, path in sysconfig.get_paths().items() if name in {
                   "stdlib", "platstdlib", "purelib", "platlib"})


def _imports(file: Path, package: str) -> Iterator[str]:
    """Yield the names of what a module imports, those that are none included."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
