"""The release command: what it changes, and what it refuses."""

import datetime
import sys
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader

import pytest
from packaging.utils import canonicalize_name

from rampart.cli.main import main
from tests import ROOT

COMMAND = ROOT / ".ci/release"


@pytest.fixture
def release(tmp_path, monkeypatch):
    """The command, in a folder with the files that it changes; something is to be released."""
    for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text(changelog.read_text().replace("## Unreleased\n", "## Unreleased\n\n- x\n"))
    monkeypatch.chdir(tmp_path)
    loader = SourceFileLoader("release", str(COMMAND))
    module = module_from_spec(spec_from_loader("release", loader))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader.exec_module(module)
    return module


def test_every_file_with_the_version_is_changed(release):
    texts = release.edited("99.0.1", datetime.date(2030, 1, 2))
    assert {file.name for file in texts} == {"pyproject.toml", "CHANGELOG.md", "CITATION.cff"}
    assert all(text.count("99.0.1") == 1 for text in texts.values())
    assert "\n## 99.0.1 (2030-01-02)\n" in texts[release.Path("CHANGELOG.md")]


@pytest.mark.parametrize(("version", "reason"), [
    ("1.0", "three numbers"), ("v9.9.9", "three numbers"), ("0.0.1", "more than the present")])
def test_a_version_that_makes_no_sense_is_refused(release, version, reason):
    with pytest.raises(ValueError, match=reason):
        release.edited(version, datetime.date(2030, 1, 2))


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


def test_nothing_to_release_is_refused(release):
    text = release.Path("CHANGELOG.md").read_text()
    head, _, rest = text.partition("## Unreleased\n")
    release.Path("CHANGELOG.md").write_text(f"{head}## Unreleased\n\n## {rest.partition('## ')[2]}")
    with pytest.raises(ValueError, match="at least one line"):
        release.edited("99.0.1", datetime.date(2030, 1, 2))
