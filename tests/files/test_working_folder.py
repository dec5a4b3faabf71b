"""Modules are imported from the working folder only if no other user can write there."""

import os
import subprocess
import sys

import pytest

from rampart.files import working_folder
from tests import ROOT
from tests.documents.page import Page


@pytest.mark.parametrize(("mode", "why"), [
    (0o755, ""), (0o757, "others can write"), (0o1777, "others can write")])
def test_a_folder_that_others_can_write_is_not_searched(tmp_path, monkeypatch, mode, why):
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(mode)
    working_folder.admit()
    assert (sys.path[-1] == str(tmp_path)) is not bool(why)
    assert why in working_folder.why_not()


def test_a_folder_of_another_user_is_not_searched(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert working_folder.why_not() == ""
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert working_folder.why_not() == f"{tmp_path} belongs to another user"


def test_a_group_of_the_user_s_own_is_nobody_else(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o775)
    found = tmp_path.stat()
    monkeypatch.setattr(os, "getgid", lambda: found.st_uid)
    os.chown(tmp_path, -1, found.st_uid)
    assert working_folder.why_not() == ""
    monkeypatch.setattr(os, "getgid", lambda: found.st_uid + 1)
    assert "others can write" in working_folder.why_not()


def test_a_folder_that_is_gone_is_not_searched(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    before = list(sys.path)
    working_folder.admit()
    assert sys.path == before
    assert working_folder.why_not() == "the working folder is gone (No such file or directory)"


TANK = Page("how-to/ready-modules")


@pytest.mark.parametrize(("mode", "code"), [(0o755, 0), (0o757, 2)])
def test_modules_beside_a_specification_are_imported_if_only_the_user_can_write_there(
        tmp_path, mode, code):
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    (there / "tank.py").write_text(TANK.block("python"))
    (there / "tank.toml").write_text(TANK.block("toml", "name = "))
    there.chmod(mode)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "rampart.cli.main", "run", "--system", "../there/tank.toml",
         "--virtual", "--duration", "2"], cwd=here, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True)
    assert done.returncode == code, done.stderr
    assert code == 0 or done.stderr.endswith(
        "node pump: actor = 'tank:Pump': No module named 'tank'; nothing is imported from there: "
        "others can write ../there (mode 757)\n")
