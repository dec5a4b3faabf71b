"""Rampart: a fault-tolerant robot controller you can kill, node by node, while it works.

`__init__.pyi` lists the public names, and `docs/reference/api.md` describes each. A name is
imported when it is first used, so that a process that needs little starts soon.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

_HOME_OF = {
    alias.name: line.module
    for line in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(line, ast.ImportFrom) and line.module for alias in line.names}
"""The module of each public name, from the stub that type checkers read."""

__all__ = list(_HOME_OF)


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` from its module."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
