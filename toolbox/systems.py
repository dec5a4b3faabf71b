"""The system a tool talks about: a spec file, the one of the run, or the shipped one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import systems
from actors.runtime.topic import Topic
from actors.supervision.system_topics import system_topics
from manager.specification import SpecificationError, SystemSpec, parse_specification
from toolbox.output import UsageError

SHIPPED = Path(systems.__file__).parent
DEFAULT = SHIPPED / "osmosis.toml"


def load(file: str | None) -> SystemSpec:
    """Read a system spec.

    Args:
        file: path, or name of a shipped system; None for the shipped default.

    Raises:
        UsageError: it cannot be read, or makes no sense.
    """
    path = DEFAULT if file is None else Path(file)
    if file is not None and not path.exists() and (SHIPPED / f"{file}.toml").exists():
        path = SHIPPED / f"{file}.toml"
    try:
        return parse_specification(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise UsageError(f"--system {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"--system {path}: not UTF-8 text") from None
    except SpecificationError as error:
        raise UsageError(str(error)) from None


def topics_of(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return all topics of a system.

    Raises:
        UsageError: an actor class that the spec names cannot be had, or declares what is no topic.
    """
    try:
        return system_topics(spec)
    except ValueError as error:
        raise UsageError(str(error)) from None
