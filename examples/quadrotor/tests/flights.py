"""Whole flights in virtual time: the system as it is run, with faults, and its judge's verdict."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from rampart.testing import virtual_run

SYSTEM = Path(__file__).parents[1] / "quadrotor.toml"


@cache
def fly(*faults: str, seconds: float | None = None, seed: int = 3, ftm: bool = True) -> Any:
    """Return what came of a flight; asked for again, the same one."""
    return virtual_run(SYSTEM, *faults, seconds=seconds, seed=seed, ftm=ftm)
