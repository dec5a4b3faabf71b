"""Minimal cut sets beside SCRAM, an independent program: its own inputs, random trees, exports.

Needs Debian's package `scram` (GPL-3, neither linked nor shipped): `make test-nightly` asks for it.
"""

import re
import subprocess
from pathlib import Path

import pytest

from rampart.manager.analysis.cut_sets import CutSets
from rampart.manager.analysis.open_psa import read_open_psa, write_open_psa
from rampart.manager.spec.specification import parse_specification
from tests import system_file

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1800)]

INPUTS = Path("/usr/share/scram/input")
ALL = 1000
"""Sets of at most so many events; SCRAM's own default leaves out those of more than 20."""

ORDERS = {"CEA9601": 4}
"""Of inputs of which SCRAM does not count all sets within a minute."""

WITHOUT_COUNT = {
    "high-prob", "mcs_prob", "mixed_mcs_prob",  # probabilities only
    "attack", "bcd", "mef_example", "event_tree", "gas_leak",  # event trees
    "common_cause", "substitutions", "nondeclarative_substitutions",  # refused: other sets
    "attack_alignment", "two_train_alignment",  # phases of a mission, each with counts of its own
    "config"}


def count(folder: Path, *files: Path, order: int = ALL) -> dict[str, int]:
    """Return SCRAM's number of minimal cut sets of each top."""
    output = folder / "scram.xml"
    done = subprocess.run(
        ["scram", *map(str, files), "--limit-order", str(order), "-o", str(output)],
        check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return {top: int(products) for top, products in re.findall(
        r'<sum-of-products name="([^"]*)"[^>]* products="(\d+)"', output.read_text())}


def inputs() -> list[Path]:
    """Return the fault trees among SCRAM's inputs."""
    return sorted(path for path in INPUTS.rglob("*.xml") if path.stem not in WITHOUT_COUNT
                  and not path.stem.endswith("-basic-events"))


def test_the_inputs_of_scram_have_as_many_cut_sets_as_scram_finds(tmp_path):
    compared = 0
    for path in inputs():
        order = ORDERS.get(path.stem, ALL)
        events = path.with_name(f"{path.stem}-basic-events.xml")
        found = count(tmp_path, path, *([events] if events.exists() else []), order=order)
        for top, expected in found.items():
            tree = read_open_psa(path.read_text(encoding="utf-8"), path.name, top)
            assert CutSets(tree, max_order=order).count == expected, (path, top)
            compared += 1
    assert compared >= 13


@pytest.mark.parametrize("system", ["paper", "osmosis", "cell"])
def test_an_exported_system_has_as_many_cut_sets_in_scram(tmp_path, system):
    file = system_file(system)
    spec = parse_specification(file.read_text(encoding="utf-8"), file.name)
    path = tmp_path / "export.xml"
    path.write_text(write_open_psa(spec), encoding="utf-8")
    ours = CutSets(read_open_psa(path.read_text(encoding="utf-8"), path.name))
    assert list(count(tmp_path, path).values()) == [ours.count]
