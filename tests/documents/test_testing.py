"""docs/how-to/testing.md: its examples, on the tank of the specification's page, are run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rampart import testing
from tests import TANK
from tests.documents.page import Page, succeed

PAGE = Page("how-to/testing")
ACTORS = Page("reference/specification").of("python")[0]
EXAMPLES = dict(re.findall(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", PAGE.text,
                           re.DOTALL | re.MULTILINE))
GAUGE = '[[node]]\nname = "gauge"\nactor = "tank_actors:Gauge"\nkind = "non-control"\n\n'


def outcome(folder: Path, *sections: str) -> str:
    """Return what pytest says of the examples of some sections, in a folder with the tank."""
    (folder / "tank_actors.py").write_text(ACTORS)
    system = TANK.replace("rampart.actors.detection.stub:StubDetection",
                          "tank_actors:LevelTooHigh")
    (folder / "tank.toml").write_text(system.replace("[[node]]", GAUGE + "[[node]]", 1))
    (folder / "test_tank.py").write_text("\n\n".join(EXAMPLES[name] for name in sections))
    (folder / "pytest.ini").write_text("[pytest]\n")
    return succeed("python -m pytest -q -p no:cacheprovider", folder).splitlines()[-1]


def test_what_runs_in_virtual_time(tmp_path):
    assert outcome(tmp_path, "Actors in virtual time", "Faults", "Detection as a timeline"
                  ).startswith("8 passed")


@pytest.mark.processes
def test_what_runs_on_processes(tmp_path):
    assert outcome(tmp_path, "Real runs").startswith("1 passed")


def test_everything_there_is_has_its_place():
    assert [name for name in testing.__all__ if f"`{name}`" not in PAGE.text
            and name not in {"Heard", "HEEDS_SIGNALS", "turns"}] == []
