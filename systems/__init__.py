"""The systems that ship with Rampart, as data: one TOML file each, and their airports.

`manager.specification` reads them.
"""

from __future__ import annotations

from pathlib import Path

SHIPPED = Path(__file__).resolve().parent
DEFAULT = SHIPPED / "osmosis.toml"


def names() -> str:
    """Return the names of the systems that ship, as words for a message."""
    return ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))


def find(text: str) -> Path:
    """Return the file that is meant by a path or by the name of a system that ships.

    A file that is there comes first; nobody has looked whether what is returned is one.
    """
    path, shipped = Path(text), SHIPPED / f"{text}.toml"
    return shipped if not path.is_file() and shipped.is_file() else path
