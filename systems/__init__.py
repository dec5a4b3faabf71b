"""The systems that ship with Rampart, as data: one TOML file each, and their airports.

`rampart.manager.spec.specification` reads them.
"""

from __future__ import annotations

import os.path
from pathlib import Path

if __name__ != "rampart.systems":
    raise ImportError("import it as rampart.systems: everything of Rampart has this one name")

SHIPPED = Path(__file__).resolve().parent
DEFAULT = SHIPPED / "osmosis.toml"


def names() -> str:
    """Return the names of the systems that ship, as words for a message."""
    return ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))


def find(text: str) -> Path:
    """Return the file that is meant by a path or by the name of a system that ships.

    A file that is there comes first; nobody has looked whether what is returned is one.
    """
    shipped = SHIPPED / f"{text}.toml"
    there = os.path.isfile(text)  # noqa: PTH113 a name that no file can have is no error here
    return shipped if not there and os.path.isfile(shipped) else Path(text)  # noqa: PTH113
