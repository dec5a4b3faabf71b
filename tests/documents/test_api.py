"""docs/api.md: what it lists is there, and its example of a test is one."""

from __future__ import annotations

import importlib
import re
import sys

import pytest

from rampart.actors.layout.wiring import load_class
from tests import ROOT

DOCUMENT = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
NAMES = re.findall(r"^\| `(\w+)` \| `(rampart\.[\w.]+)` \|", DOCUMENT, re.MULTILINE)
CLASSES = re.findall(r"^\| `(rampart\.[\w.]+:\w+)` \|", DOCUMENT, re.MULTILINE)
EXAMPLE = re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)[-1]
MODULES = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "specification.md").read_text(
    encoding="utf-8"), re.DOTALL)[0]


@pytest.mark.parametrize(("name", "module"), NAMES)
def test_a_name_is_where_the_page_says(name, module):
    assert hasattr(importlib.import_module(module), name)


def test_the_names_are_few_and_no_name_is_listed_twice():
    names = [name for name, _ in NAMES]
    assert len(names) == len(set(names))
    assert 25 <= len(names) <= 40


@pytest.mark.parametrize("path", CLASSES)
def test_a_class_for_specifications_can_be_loaded(path):
    assert load_class(path).__name__ == path.partition(":")[2]


def test_the_test_that_it_shows_passes(tmp_path, monkeypatch):
    (tmp_path / "tank_actors.py").write_text(MODULES, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "tank_actors", raising=False)
    shown: dict[str, object] = {}
    exec(compile(EXAMPLE, "api.md", "exec"), shown)
    shown["test_a_high_level_is_detected_while_it_lasts"]()
