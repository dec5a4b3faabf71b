"""The release command: what it changes, and what it refuses."""

import datetime
import runpy
import tomllib
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from rampart.cli.main import main
from tests import ROOT


@pytest.fixture
def edited(tmp_path, monkeypatch):
    """What the command changes in a folder with its files; something is to be released."""
    for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text(changelog.read_text().replace("## Unreleased\n", "## Unreleased\n\n- x\n"))
    monkeypatch.chdir(tmp_path)
    return runpy.run_path(str(ROOT / ".ci/release"))["edited"]


def test_every_file_with_the_version_is_changed(edited):
    texts = edited("99.0.1", datetime.date(2030, 1, 2))
    assert {file.name for file in texts} == {"pyproject.toml", "CHANGELOG.md", "CITATION.cff"}
    assert all(text.count("99.0.1") == 1 for text in texts.values())
    assert "\n## 99.0.1 (2030-01-02)\n" in texts[Path("CHANGELOG.md")]


@pytest.mark.parametrize(("version", "reason"), [
    ("1.0", "three numbers"), ("v9.9.9", "three numbers"), ("0.0.1", "more than the present")])
def test_a_version_that_makes_no_sense_is_refused(edited, version, reason):
    with pytest.raises(ValueError, match=reason):
        edited(version, datetime.date(2030, 1, 2))


def test_the_command_line_prints_the_version_of_the_project(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert capsys.readouterr().out == f"rampart {project['version']}\n"


def test_the_licences_of_all_pinned_packages_are_listed():
    """`make licences` was run after the last `make requirements`."""
    pins = (ROOT / "requirements.txt").read_text().split()
    rows = (ROOT / "docs/contributing/licences.md").read_text().splitlines()
    listed = {canonicalize_name(row.split("|")[1].strip()) + "==" + row.split("|")[2].strip()
              for row in rows if row.startswith("| ")}
    assert [pin for pin in pins if "==" in pin and pin not in listed] == []


def test_nothing_to_release_is_refused(edited):
    text = Path("CHANGELOG.md").read_text()
    head, _, rest = text.partition("## Unreleased\n")
    Path("CHANGELOG.md").write_text(f"{head}## Unreleased\n\n## {rest.partition('## ')[2]}")
    with pytest.raises(ValueError, match="at least one line"):
        edited("99.0.1", datetime.date(2030, 1, 2))
