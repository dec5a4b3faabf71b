"""docs/reference/api.md: what it lists is there."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys

import pytest

import rampart
import rampart.testing
from rampart.actors.system.members import load_class
from tests import ROOT

DOCUMENT = (ROOT / "docs/reference/api.md").read_text(encoding="utf-8")
NAMES = re.findall(r"^\| `(\w+)` \| `(rampart\.[\w.]+)` \|", DOCUMENT, re.MULTILINE)
CLASSES = re.findall(r"^\| `(rampart\.[\w.]+:\w+)` \|", DOCUMENT, re.MULTILINE)


@pytest.mark.parametrize(("name", "module"), NAMES)
def test_a_name_is_where_the_page_says(name, module):
    assert hasattr(importlib.import_module(module), name)


@pytest.mark.parametrize(("name", "module"), NAMES)
def test_a_name_is_imported_from_rampart_itself(name, module):
    assert getattr(rampart, name) is getattr(importlib.import_module(module), name)


def test_the_page_lists_what_rampart_exports():
    assert {name for name, _ in NAMES} == set(rampart.__all__) == set(dir(rampart))
    with pytest.raises(AttributeError, match="module 'rampart' has no attribute 'nonsense'"):
        _ = rampart.nonsense


def test_to_import_rampart_costs_nothing():
    done = subprocess.run(
        [sys.executable, "-c", "import rampart, sys; print(*sys.modules)"], cwd=ROOT, check=True,
        capture_output=True, text=True)
    assert not {"numpy", "zenoh", "msgspec", "asyncio"} & set(done.stdout.split())


def test_the_names_are_few_and_no_name_is_listed_twice():
    names = [name for name, _ in NAMES]
    assert len(names) == len(set(names))
    assert 25 <= len(names) <= 52


@pytest.mark.parametrize("path", CLASSES)
def test_a_class_for_specifications_can_be_loaded(path):
    assert load_class(path).__name__ == path.partition(":")[2]


def test_every_name_for_tests_is_listed():
    rows = DOCUMENT.partition("## Tests\n")[2].partition("\n## ")[0]
    listed = re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", rows, re.MULTILINE)))
    assert set(listed) == set(rampart.testing.__all__)
