"""docs/tutorials/first-run.md: its commands do what the page shows.

Not run: `make setup`, which needs a package index, and `python launch.py` to its end, which takes
three minutes; the commands of the second terminal are run beside a run of the same system.
"""

from __future__ import annotations

import re
from itertools import takewhile

import pytest

from rampart.testing import RealRun
from tests.documents.page import Page, execute, succeed

PAGE = Page("tutorials/first-run")
VIRTUAL = [line for line in PAGE.commands if "--virtual" in line]
SECOND_TERMINAL = next(block for block in PAGE.of("sh") if "kill-node" in block).splitlines()[1:]
EXPORT = 'export PATH="$PWD/.venv/bin:$PATH"'
NOT_RUN = {"make setup", "python launch.py", EXPORT}


def shown_after(line: str) -> str:
    """Return the output that the page shows of a command."""
    at = next(i for i, (_, block) in enumerate(PAGE.blocks) if line in block.splitlines())
    return "".join(block for _, block in takewhile(
        lambda block: block[0] != "sh", PAGE.blocks[at + 1:]))


def without_numbers(text: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "N", re.sub(r"\[ *", "[", text))


def test_each_command_is_run_or_exempt():
    assert set(PAGE.commands) - NOT_RUN - set(VIRTUAL) - set(SECOND_TERMINAL) == {"rampart doctor"}


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
            succeed(line, tmp_path, RAMPART_PORT=str(real.port))
        real.wait_until(lambda: "35 of 35 running, 2 restarts" in succeed(
            status, tmp_path, RAMPART_PORT=str(real.port)), 20, "they are not back")
