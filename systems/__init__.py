"""The shipped systems as data: one TOML file each, and their airports."""

from __future__ import annotations

import os.path
from pathlib import Path

if __name__ != "rampart.systems":
    raise ImportError("import it as rampart.systems: everything of Rampart has this one name")

SHIPPED = Path(__file__).resolve().parent
DEFAULT = SHIPPED / "osmosis.toml"


def names() -> str:
    """Return the names of the shipped systems, for a message."""
    return ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))


def find(text: str) -> Path:
    """Return the file for a path, or else for the name of a shipped system.

    The file may not exist.
    """
    shipped = SHIPPED / f"{text}.toml"
    exists = os.path.isfile(text)  # noqa: PTH113 also for text that cannot be a name of a file
    return shipped if not exists and os.path.isfile(shipped) else Path(text)  # noqa: PTH113
