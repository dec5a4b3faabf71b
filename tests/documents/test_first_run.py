"""docs/tutorials/first-run.md: its commands do what the page shows.

Not run: `make setup`, which needs a package index, and `python launch.py` to its end, which takes
three minutes; the commands of the second terminal are run beside a run of the same system.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.testing import RealRun
from tests import ROOT

TEXT = (ROOT / "docs/tutorials/first-run.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)
COMMANDS = [line for language, block in BLOCKS if language == "sh" for line in block.splitlines()]
VIRTUAL = [line for line in COMMANDS if "--virtual" in line]
SECOND_TERMINAL = next(block for language, block in BLOCKS
                       if language == "sh" and "kill-node" in block).splitlines()[1:]
EXPORT = 'export PATH="$PWD/.venv/bin:$PATH"'
NOT_RUN = {"make setup", "python launch.py", EXPORT}


def execute(line: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a command of the page in a folder of its own."""
    words = [str(ROOT / word) if word == "launch.py" else word for word in shlex.split(line)]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(words, cwd=folder, env={**os.environ, "PATH": path, **more}, check=False,
                          text=True, capture_output=True, timeout=600)


def shown_after(line: str) -> str:
    """Return the output that the page shows of a command."""
    at = next(i for i, (_, block) in enumerate(BLOCKS) if line in block.splitlines())
    texts = []
    for language, block in BLOCKS[at + 1:]:
        if language == "sh":
            break
        texts.append(block)
    return "".join(texts)


def without_numbers(text: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "N", re.sub(r"\[ *", "[", text))


def test_each_command_is_run_or_exempt():
    assert set(COMMANDS) - NOT_RUN - set(VIRTUAL) - set(SECOND_TERMINAL) == {"rampart doctor"}


def test_doctor_finds_what_a_run_needs(tmp_path):
    assert execute("rampart doctor", tmp_path).returncode == 0


@pytest.mark.virtual
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("line", "code"), list(zip(VIRTUAL, (0, 1), strict=True)))
def test_a_run_in_virtual_time_prints_what_the_page_shows(tmp_path, line, code):
    done = execute(line, tmp_path)
    assert done.returncode == code, done.stderr
    printed = without_numbers(done.stderr + done.stdout).splitlines()
    lost = [text for text in without_numbers(shown_after(line)).splitlines()
            if text not in printed]
    assert lost == []


@pytest.mark.processes
@pytest.mark.alone
def test_nodes_that_are_killed_from_the_second_terminal_are_back(tmp_path):
    with RealRun(tmp_path, "osmosis") as real:
        real.sleep_until(5)
        *kills, status = SECOND_TERMINAL
        for line in kills:
            assert execute(line, tmp_path, RAMPART_PORT=str(real.port)).returncode == 0
        real.wait_until(lambda: "35 of 35 running, 2 restarts" in execute(
            status, tmp_path, RAMPART_PORT=str(real.port)).stdout, 20, "they are not back")
