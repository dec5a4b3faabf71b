"""A system whose wheels are a program in C that beats by sd_notify, and its stand-in in Python."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

_FOLDER = Path(__file__).parent
TUG = (_FOLDER / "tug.toml").read_text(encoding="utf-8")


def write_tug(folder: Path, *, compiled: bool = True) -> None:
    """Write the system into a folder."""
    (folder / "tug.toml").write_text(TUG)
    shutil.copy(_FOLDER / "cart.py", folder)
    if compiled:
        subprocess.run(["gcc", "-Wall", "-Wextra", "-Werror", "-o", folder / "wheels",
                        _FOLDER / "wheels.c"], check=True)
