"""Missions that are short enough for a test, on the shipped airport; and a disk that is full."""

import resource
from collections.abc import Callable
from pathlib import Path

MISSIONS = {
    "TAXI": "x=-22,y=-18.5,taxi=1\n",
    "NEAR": "x=-28.5,y=4,taxi=1\nx=-29.5,y=-3,taxi=1\nx=-28.8,y=-11.5,taxi=1\n",
    "SHORT": "x=-22,y=-18.5,taxi=1\nx=-8.5,y=-18.5,taxi=0\nx=-4,y=-18.5,taxi=1\n",
    "ROW": "x=-22,y=-18.5,taxi=1\nx=23.5,y=-18.5,taxi=0\n"}
"""By name: the first goal of mission A, half a minute; three goals near the start, without lights,
half a minute; to the row, over three lights, and on, a minute; mission A without its way home."""

SHORT_LIGHTS = {"A01": "ok", "A02": "ok", "A03": "out"}
"""What the short mission passes, with the true verdicts."""


def write_mission(directory: Path, name: str) -> Path:
    """Write one of these missions."""
    file = directory / f"{name}.miss"
    file.write_text(MISSIONS[name])
    return file


def small_files(size: int) -> Callable[[], None]:
    """Have no file of a process be larger: as on a full disk, writing fails."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
