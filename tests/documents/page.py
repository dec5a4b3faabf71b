"""Pages of `docs`: their blocks of code, and the execution of their commands."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from tests import ROOT


class Page:
    """A page below `docs`, by its name without ending."""

    def __init__(self, name: str) -> None:
        self.text = (ROOT / f"docs/{name}.md").read_text(encoding="utf-8")
        self.blocks: list[tuple[str, str]] = re.findall(
            r"^```([\w+]+)\n(.*?)^```", self.text, re.DOTALL | re.MULTILINE)
        self.commands = [line.partition("  #")[0].strip() for block in self.of("sh")
                         for line in block.splitlines()]

    def of(self, language: str) -> list[str]:
        """Return the blocks in a language."""
        return [block for found, block in self.blocks if found == language]

    def block(self, language: str, begins: str = "") -> str:
        """Return the first block in a language that begins with these words."""
        return next(block for block in self.of(language) if block.startswith(begins))

    def section(self, heading: str) -> str:
        """Return the text below a heading with its `#`s, up to the next one of its level."""
        level = heading.partition(" ")[0]
        return self.text.partition(f"\n{heading}\n")[2].partition(f"\n{level} ")[0]


def execute(line: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command of a page in a folder."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    words = [str(ROOT / word) if word == "launch.py" else word for word in shlex.split(line)]
    return subprocess.run(
        words, cwd=folder, text=True, capture_output=True, check=False, timeout=600,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore", "PATH": path,
             **variables})


def succeed(line: str, folder: Path, **variables: str) -> str:
    """Run a command of a page that has to succeed, and return what it prints."""
    done = execute(line, folder, **variables)
    assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    return done.stdout + done.stderr
