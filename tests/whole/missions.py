"""Missions that are short enough for a test, on the shipped airport; and a disk that is full."""

from __future__ import annotations

import resource
from collections.abc import Callable
from pathlib import Path

SHORT_LIGHTS = {"A01": "ok", "A02": "ok", "A03": "out"}
"""What the short mission passes, with the true verdicts."""


def write_taxi_mission(directory: Path) -> Path:
    """Write the first goal of mission A as a mission; half a minute."""
    file = directory / "TAXI.miss"
    file.write_text("x=-22,y=-18.5,taxi=1\n")
    return file


def write_near_mission(directory: Path) -> Path:
    """Write a mission of half a minute: three goals near the start, no lights."""
    file = directory / "NEAR.miss"
    file.write_text("x=-28.5,y=4,taxi=1\nx=-29.5,y=-3,taxi=1\nx=-28.8,y=-11.5,taxi=1\n")
    return file


def write_short_mission(directory: Path) -> Path:
    """Write a mission of a minute: to the row, over three lights, and on."""
    file = directory / "SHORT.miss"
    file.write_text("x=-22,y=-18.5,taxi=1\nx=-8.5,y=-18.5,taxi=0\nx=-4,y=-18.5,taxi=1\n")
    return file


def write_row_mission(directory: Path) -> Path:
    """Write mission A without its way home."""
    file = directory / "ROW.miss"
    file.write_text("x=-22,y=-18.5,taxi=1\nx=23.5,y=-18.5,taxi=0\n")
    return file


def small_files(size: int) -> Callable[[], None]:
    """Have no file of a process be larger: as on a full disk, writing fails."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
