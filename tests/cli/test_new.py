"""`rampart new`: what it makes works at once, and it changes nothing that is there."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from rampart.cli import new
from rampart.cli.main import main
from rampart.testing import RealRun, virtual_run
from tests import ROOT


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes()
            for file in sorted(folder.rglob("*")) if file.is_file()}


def made(folder: Path, monkeypatch, name: str = "courier") -> Path:
    monkeypatch.chdir(folder)
    assert main(["new", name]) == 0
    return folder / name


@pytest.mark.slow
def test_what_it_makes_is_typed_and_clean(tmp_path, monkeypatch, capsys):
    robot = made(tmp_path, monkeypatch)
    assert capsys.readouterr().out.startswith("courier/ contains a robot that runs: cd courier")
    assert {Path(name).name for name in contents(robot)} == {
        "courier.toml", "topics.py", "nodes.py", "world.py", "judge.py", "__init__.py",
        "test_courier.py", "Makefile", "README.md", "pyproject.toml", ".gitignore"}
    assert not [name for name, text in contents(robot).items() if b"@NAME@" in text]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file", str(ROOT / "pyproject.toml"),
         "-p", "courier", "--cache-dir", str(tmp_path / "cache")], cwd=robot, text=True,
        env={**environment, "MYPYPATH": str(robot)}, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"),
         "--no-cache", "courier"], cwd=robot, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.processes
def test_what_it_makes_runs_on_processes(tmp_path, monkeypatch):
    robot = made(tmp_path, monkeypatch)
    command = f"{Path(sys.executable).with_name('rampart')} run --json --duration 4"
    rule = (robot / "Makefile").read_text().replace("$(RAMPART) run", command)
    (robot / "Makefile").write_text(rule)
    done = subprocess.run(["make", "--no-print-directory", "run"], cwd=robot, text=True,
                          capture_output=True, check=False,
                          env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert json.loads(done.stdout.splitlines()[-1])["safety"] == "safe", done.stderr


@pytest.mark.parametrize(("name", "code", "by_s"), [
    ("mortal", ("    def step(self) -> None:\n",
                "        if self.clock.now() > 5:\n            raise RuntimeError('died')\n"), 6.5),
    ("stillborn", ("    parameters: Parameters\n",
                   "    def __init__(self, context):\n        raise ValueError('broken')\n"), 1.5)])
def test_a_world_that_dies_ends_its_run_and_safety_is_not_known(
        tmp_path, monkeypatch, name, code, by_s):
    before, more = code
    robot = made(tmp_path, monkeypatch, name)
    world = robot / name / "world.py"
    world.write_text(world.read_text().replace(before, before + more))
    done = virtual_run(robot / f"{name}.toml")
    assert (done.record.mission, done.record.safety) == ("fail", "not known")
    assert (done.judgement.success, done.judgement.safe) == (False, None)
    assert done.record.duration_s < by_s
    assert "the world has died" in done.record.reasons[0]


@pytest.mark.processes
def test_a_world_that_is_killed_ends_its_run_with_exit_code_4(tmp_path, monkeypatch):
    robot = made(tmp_path, monkeypatch)
    with RealRun(tmp_path, robot / "courier.toml", "--duration", "40") as real:
        real.sleep_until(3)
        real.kill("world")
        code, result = real.result()
    assert (code, result["mission"], result["safety"]) == (4, "fail", "not known")
    assert result["duration_s"] < 20


def test_a_name_that_no_package_can_have_or_that_is_taken_is_refused(
        tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    for name in ("Courier", "9lives", "a-b", "", "../x", "/tmp/x", "class", "x" * 32, "naïve"):
        assert refused("new", name).startswith(
            f"rampart: NAME {name!r}: expected at most 31 small letters, digits and _")
    for name in ("json", "numpy", "controller"):
        assert "another module or node has this name already" in refused("new", name)
    assert contents(tmp_path) == {}


def test_what_is_there_is_never_overwritten(tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "nodes.py").write_text("mine")
    for name in ("link", "folder"):
        assert refused("new", name) == f"rampart: {name}: exists already; nothing was changed\n"
    assert contents(tmp_path) == {"folder/nodes.py": b"mine"}
    assert not (tmp_path / "gone").exists()


def test_a_disk_that_fills_up_leaves_nothing_behind(tmp_path, monkeypatch, refused):
    def full(folder, _name):
        (folder / "courier.toml").write_text("half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(new, "fill", full)
    monkeypatch.chdir(tmp_path)
    assert refused("new", "courier") == "rampart: courier: No space left on device\n"
    assert not (tmp_path / "courier").exists()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_from_a_wheel_in_an_empty_environment_outside_of_the_checkout(tmp_path):
    """Rampart itself comes from the wheel; what it depends on, from the environment of this test.

    That one's folder of packages is on the path by a .pth file, in which no other .pth counts: so
    the checkout, which is installed there as such, is not.
    """
    source = tmp_path / "source"
    shutil.copytree(ROOT, source, symlinks=True, ignore=shutil.ignore_patterns(
        ".venv", ".git", "*.egg-info", "reports", "__pycache__", ".*_cache"))
    subprocess.run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir",
                    str(tmp_path), str(source)], check=True)
    shutil.rmtree(source)
    (wheel,) = tmp_path.glob("rampart_robot-*.whl")
    home = tmp_path / "empty"
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet",
                    "--no-deps", "--no-index", str(wheel)], check=True)
    (packages,) = home.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(("PYTHON", "PYTEST", "VIRTUAL_ENV"))}
    environment["PATH"] = f"{home / 'bin'}{os.pathsep}{environment['PATH']}"

    def call(*command: str, where: Path = tmp_path) -> str:
        done = subprocess.run(command, cwd=where, env=environment, text=True, capture_output=True,
                              check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert call(str(python), "-c", "import rampart; print(rampart.__file__)").startswith(
        str(packages))
    call("rampart", "new", "courier")
    robot = tmp_path / "courier"
    assert "14 passed" in call("make", "test", "PYTHON=python -W ignore", where=robot) \
        or "15 passed" in call("make", "test", where=robot)
    assert "success" in call("rampart", "run", "--system", "courier.toml", "--virtual", "--json",
                             where=robot)
