"""What the shell offers: verbs, and nodes, topics and faults of the system at hand."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from rampart.cli import completion
from rampart.testing.ports import free_base_port


def offered(line: str, told: Path) -> set[str]:
    """Return what is offered at the end of a line, as argcomplete's shell function asks for it."""
    subprocess.run([sys.executable, "-m", "rampart.cli.main"], check=True, timeout=30, env={
        **os.environ, "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9",
        "_ARGCOMPLETE": "1", "IFS": "\013", "_ARGCOMPLETE_STDOUT_FILENAME": str(told),
        "RAMPART_PORT": str(free_base_port())})  # no run is there, whatever else runs
    return {word.strip() for word in told.read_text().split("\013")} - {""}


@pytest.mark.parametrize(("line", "some"), [
    ("rampart topic e", {"echo"}), ("rampart topic echo localization/p", {"localization/pose"}),
    ("rampart inject gps-b", {"gps-bias"})])
def test_verbs_topics_and_faults_are_offered(tmp_path, line, some):
    assert some <= offered(line, tmp_path / "told")


def test_nodes_are_those_of_all_runs(monkeypatch):
    monkeypatch.setattr(completion, "find_runs", lambda: [
        SimpleNamespace(nodes=("pump", "valve")), SimpleNamespace(nodes=("pump",))])
    assert completion.nodes() == ["pump", "valve"]
