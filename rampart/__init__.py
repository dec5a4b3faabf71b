"""Rampart: a fault-tolerant robot controller you can kill, node by node, while it works.

`__init__.pyi` lists the public names, and `docs/reference/api.md` describes each. A name is
imported when it is first used, so that a process that needs little starts soon.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

_homes: dict[str, str] = {}
"""The module of each public name, once one was asked for."""


def _find_homes() -> dict[str, str]:
    """Return `_homes`, from the stub that type checkers read."""
    if not _homes:
        import ast  # noqa: PLC0415 a process that is interrupted while it starts is not there yet

        stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
        _homes.update((alias.name, line.module) for line in stub.body
                      if isinstance(line, ast.ImportFrom) and line.module for alias in line.names)
    return _homes


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name == "__all__":
        return list(_find_homes())
    if name not in _find_homes():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_homes[name]), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return list(_find_homes())
