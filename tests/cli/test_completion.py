"""What the shell offers: verbs, and nodes, topics and faults of the system at hand."""

import os
import subprocess
import sys
from types import SimpleNamespace

from rampart.cli import completion
from rampart.testing.ports import free_base_port


def test_verbs_topics_and_faults_are_offered(tmp_path):
    """As argcomplete's shell function asks for what may stand at the end of a line."""
    for line, some in (("rampart topic echo localization/p", "localization/pose"),
                       ("rampart inject gps-b", "gps-bias")):
        subprocess.run([sys.executable, "-m", "rampart.cli.main"], check=True, timeout=30, env={
            **os.environ, "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9",
            "_ARGCOMPLETE": "1", "IFS": "\013",
            "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "told"),
            "RAMPART_PORT": str(free_base_port())})  # no run is there, whatever else runs
        offered = (tmp_path / "told").read_text().split("\013")
        assert some in {word.strip() for word in offered}


def test_nodes_are_those_of_all_runs(monkeypatch):
    monkeypatch.setattr(completion, "find_runs", lambda: [
        SimpleNamespace(nodes=("pump", "valve")), SimpleNamespace(nodes=("pump",))])
    assert completion.nodes() == ["pump", "valve"]
