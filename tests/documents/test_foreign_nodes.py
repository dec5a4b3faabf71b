"""docs/how-to/any-language.md: its programs are nodes that work, its numbers are right."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys

import msgspec
import pytest

from rampart.testing import RealRun, VirtualSystem, run
from tests.actors.access.keyed import layout_of, make_keys
from tests.documents.page import Page
from tests.real_tools import printed

PAGE = Page("how-to/any-language")
TUG = PAGE.block("toml", 'name = "tug"')
COMPILERS = {"c++": ["g++", "-x", "c++", "-Wall", "-Wextra", "-Werror"],
             "rust": ["rustc", "-Dwarnings"]}


def write_tug(folder, language: str = "") -> None:
    """Write the system of the page into a folder, with the wheels in a language."""
    (folder / "tug.toml").write_text(TUG)
    (folder / "cart.py").write_text(PAGE.block("python", "from rampart"))
    if language == "bash":
        (folder / "wheels").write_text(PAGE.block("bash"))
        (folder / "wheels").chmod(0o755)
    elif language:
        source = "wheels.rs" if language == "rust" else "wheels.c"
        (folder / source).write_text(PAGE.block(language.removesuffix("++")))
        if language == "c++":  # the same file is C, too
            subprocess.run(["gcc", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", source],
                           cwd=folder, check=True)
        subprocess.run([*COMPILERS[language], "-o", "wheels", source], cwd=folder, check=True)


def test_the_stand_in_plays_the_command_in_virtual_time(tmp_path, monkeypatch):
    write_tug(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    async def scenario():
        async with VirtualSystem.load(tmp_path / "tug.toml") as system:
            driver = system.start_node("driver")
            system.start_node("wheels")
            await asyncio.sleep(1.0)
            return msgspec.structs.astuple(driver.seen)

    assert run(scenario) == (5.0, 5.0)


@pytest.mark.processes
@pytest.mark.parametrize("language", ["c++", "rust", "bash"])
def test_the_program_is_a_node_and_faults_can_be_put_into_its_messages(tmp_path, language):
    if language in COMPILERS and not shutil.which(COMPILERS[language][0]):
        pytest.skip(f"no {COMPILERS[language][0]}")
    write_tug(tmp_path, language)
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(1)
        assert heard(tug) == [5.0, 5.0]
        done = tug.tool("inject", "drop:tug/wheels", "--duration", "1", "--json")
        assert done.returncode == 0, done.stderr
        (disturbed,) = msgspec.json.decode(done.stdout)["injections"]
        assert disturbed["nodes"] == ["wheels"]
        assert disturbed["affected"] > 0


@pytest.mark.processes
@pytest.mark.parametrize("with_keys", [False, True])
def test_the_plain_zenoh_program_is_a_node(tmp_path, monkeypatch, with_keys):
    write_tug(tmp_path)
    (tmp_path / "wheels.py").write_text(PAGE.block("python", "import json"))
    (tmp_path / "tug.toml").write_text(TUG.replace(
        '["./wheels"]', f'[{json.dumps(sys.executable)}, "wheels.py"]').replace(
        'topic = "tug/wheels"', 'key = "wheels/alive"'))
    monkeypatch.syspath_prepend(tmp_path)  # for its driver, when keys are made for it
    more = ("--keys", str(make_keys(tmp_path / "keys", layout_of(str(tmp_path / "tug.toml"))))
            ) if with_keys else ()
    with RealRun(tmp_path, "tug.toml", *more) as tug:
        tug.sleep_until(3)
        assert heard(tug) == [5.0, 5.0]
        assert [n["state"] for n in nodes(tug) if n["name"] == "wheels"] == ["running"]


def heard(tug: RealRun) -> list[float]:
    """Return what a stranger hears of the wheels."""
    done = tug.tool("topic", "echo", "tug/wheels", "-n", "1", "--duration", "10", "--json")
    said = msgspec.json.decode(done.stdout.splitlines()[-1])
    return list(said["message"].values())


def nodes(tug: RealRun) -> list[dict]:
    return msgspec.json.decode(printed(tug, "node", "list", "--json"))
