"""Optional libraries: what is not part of the base install is asked for by name when needed."""

from __future__ import annotations

import importlib
from types import ModuleType

from rampart.cli.output import UsageError


def extra(name: str, module: str) -> ModuleType:
    """Return a module of an extra.

    Raises:
        UsageError: the extra is not installed; the line says how to.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"this needs the extra {name!r}, which is not installed ({error}); "
                         f"install it with: pip install 'rampart[{name}]'") from None
