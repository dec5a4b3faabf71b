"""All targets. A module that registers more of them is imported here."""

from __future__ import annotations

import os
from importlib import import_module

from tests.fuzz import file_targets, ros_targets, wire_targets
from tests.fuzz.target import ALL

MORE = "FUZZ_MODULES"
"""Environment variable with the modules that `--module` names, for workers."""

for module in filter(None, os.environ.get(MORE, "").split(",")):
    import_module(module)

__all__ = ["ALL", "MORE", "file_targets", "ros_targets", "wire_targets"]
