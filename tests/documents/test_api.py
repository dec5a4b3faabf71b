"""docs/reference/api.md: what it lists is there."""

import importlib
import re
import subprocess
import sys

import pytest

import rampart
import rampart.testing
from rampart.actors.system.members import load_class
from tests import ROOT
from tests.documents.page import Page

PAGE = Page("reference/api")
NAMES = re.findall(r"^\| `(\w+)` \| `(rampart\.[\w.]+)` \|", PAGE.text, re.MULTILINE)
CLASSES = re.findall(r"^\| `(rampart\.[\w.]+:\w+)` \|", PAGE.text, re.MULTILINE)


@pytest.mark.parametrize(("name", "module"), NAMES)
def test_a_name_is_imported_from_rampart_itself(name, module):
    assert getattr(rampart, name) is getattr(importlib.import_module(module), name)


def test_the_page_lists_what_rampart_exports():
    assert sorted(name for name, _ in NAMES) == sorted(rampart.__all__) == dir(rampart)
    with pytest.raises(AttributeError, match="module 'rampart' has no attribute 'nonsense'"):
        _ = rampart.nonsense


def test_to_import_rampart_costs_nothing():
    done = subprocess.run(
        [sys.executable, "-c", "import rampart, sys; print(*sys.modules)"], cwd=ROOT, check=True,
        capture_output=True, text=True)
    assert not {"numpy", "zenoh", "msgspec", "asyncio"} & set(done.stdout.split())


@pytest.mark.parametrize("path", CLASSES)
def test_a_class_for_specifications_can_be_loaded(path):
    assert load_class(path).__name__ == path.partition(":")[2]


def test_every_name_for_tests_is_listed():
    rows = re.findall(r"^\| (`.*?) \|", PAGE.section("## Tests"), re.MULTILINE)
    listed = re.findall(r"`(\w+)`", "".join(rows))
    assert set(listed) == set(rampart.testing.__all__)
