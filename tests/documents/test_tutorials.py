"""Pages of docs/tutorials: followed to the letter, their commands do what the pages show.

Not run: `make setup`, which needs a package index; `python launch.py` to its end, which takes three
minutes (the commands of the second terminal are run beside a run of the same system); the last step
with a guarded robot, which needs one with ROS 2. On processes the router of ROS 2 has a port of its
own, where the page has the usual one.
"""

from __future__ import annotations

import asyncio
import re
from itertools import takewhile
from pathlib import Path

import pytest

from rampart.actors.bus.topics import DIAGNOSTIC
from rampart.testing import RealRun, VirtualSystem, free_port, run
from tests.documents.page import Page, execute, succeed

BLOCKS = Page("tutorials/your-own-robot").blocks


def follow(robot: Path, first: str, rest: str) -> None:
    """Do with a block of code what its first line says."""
    name, _, what = first.removeprefix("# ").partition(", ")
    file = robot.parent / robot.name / name
    if what == "as it was made":
        assert rest in file.read_text(encoding="utf-8"), name
    elif what == "added":
        file.write_text(file.read_text(encoding="utf-8") + "\n" + rest, encoding="utf-8")
    elif what:
        before, table, _ = file.read_text(encoding="utf-8").partition(
            what.removeprefix("in place of "))
        after = re.sub(r"\A.*?(?=^\[\[|\Z)", "", _, flags=re.DOTALL | re.MULTILINE)
        assert table, what
        file.write_text(before + rest + "\n" + after, encoding="utf-8")
    else:
        assert not file.exists(), name
        file.write_text(rest, encoding="utf-8")


def test_the_guide_leads_where_it_says(tmp_path):
    where, said = tmp_path, []
    for language, block in BLOCKS:
        if language != "sh":
            first, _, rest = block.partition("\n")
            follow(tmp_path / "courier", first, rest)
            continue
        for line in block.splitlines():
            if line.startswith("cd "):
                where = where / line.removeprefix("cd ")
            else:
                said.append(succeed(line, where))
    assert len(BLOCKS) > 10
    assert "18 passed, 1 deselected" in said[2]
    assert '"mission": "success"' in said[1]
    assert '"mission": "success"' in said[-2]
    assert "10 of them made now" in said[-1]


FIRST_RUN = Page("tutorials/first-run")
VIRTUAL = [line for line in FIRST_RUN.commands if "--virtual" in line]
SECOND_TERMINAL = next(
    block for block in FIRST_RUN.of("sh") if "kill-node" in block).splitlines()[1:]
EXPORT = 'export PATH="$PWD/.venv/bin:$PATH"'
NOT_RUN = {"make setup", "python launch.py", EXPORT}


def shown_after(line: str) -> str:
    """Return the output that the page shows of a command."""
    at = next(i for i, (_, block) in enumerate(FIRST_RUN.blocks) if line in block.splitlines())
    return "".join(block for _, block in takewhile(
        lambda block: block[0] != "sh", FIRST_RUN.blocks[at + 1:]))


def without_numbers(text: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "N", re.sub(r"\[ *", "[", text))


def test_each_command_is_run_or_exempt():
    run = {*NOT_RUN, *VIRTUAL, *SECOND_TERMINAL}
    assert set(FIRST_RUN.commands) - run == {"rampart doctor"}


@pytest.mark.virtual
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("line", "code"), list(zip(VIRTUAL, (0, 1), strict=True)))
def test_a_run_in_virtual_time_prints_what_the_page_shows(tmp_path, line, code):
    done = execute(line, tmp_path)
    assert done.returncode == code, done.stderr
    printed = without_numbers(done.stderr + done.stdout).splitlines()
    lost = [text for text in without_numbers(shown_after(line)).splitlines()
            if text not in printed]
    assert lost == []


@pytest.mark.processes
@pytest.mark.alone
def test_nodes_that_are_killed_from_the_second_terminal_are_back(tmp_path):
    with RealRun(tmp_path, "osmosis") as real:
        real.sleep_until(5)
        *kills, status = SECOND_TERMINAL
        for line in kills:
            succeed(line, tmp_path, RAMPART_PORT=str(real.port))
        real.wait_until(lambda: "35 of 35 running, 2 restarts" in succeed(
            status, tmp_path, RAMPART_PORT=str(real.port)), 20, "they are not back")


GUARD = Page("tutorials/guard-a-ros2-robot")
GUARDED_RUN = GUARD.commands.index("rampart run --system guarded.toml")


def write_guard(folder: Path) -> None:
    """Write the files of the page into a new folder."""
    folder.mkdir()
    for language, block in GUARD.blocks:
        if language != "sh":
            first, _, rest = block.partition("\n")
            follow(folder, first, rest)


def test_the_guarded_robot_is_sound_and_its_navigation_restarted_in_virtual_time(tmp_path):
    write_guard(tmp_path / "guarded")
    make, enter, check, begin = GUARD.commands[:GUARDED_RUN]
    assert (make, enter) == ("mkdir guarded", "cd guarded")
    assert "sound" in succeed(check, tmp_path / "guarded")
    assert "navigation respawned by R_RESTART" in succeed(begin, tmp_path / "guarded")


@pytest.mark.parametrize("field", ["linear_mps", "angular_radps"])
def test_a_velocity_beyond_the_limits_is_refused_between_guard_and_gateway(
        tmp_path, monkeypatch, field):
    write_guard(tmp_path / "guarded")
    monkeypatch.syspath_prepend(tmp_path / "guarded")

    async def scenario() -> None:
        async with VirtualSystem.load(tmp_path / "guarded/guarded.toml") as system:
            for name in ("gateway", "guard", "navigation", "base"):
                system.start_node(name)
            reports = system.hear(DIAGNOSTIC, "gateway")
            await asyncio.sleep(1.0)
            assert not reports
            checked = system.layout.topics["guard/velocity"]
            system.say(checked, checked.type(**{
                "linear_mps": 0.0, "angular_radps": 0.0, field: 1e6}), "guard", incarnation=2)
            await asyncio.sleep(0.5)
            assert {report.message.context for report in reports} == {"payload rejected"}

    run(scenario)


@pytest.mark.processes
def test_on_processes_the_base_gets_the_guarded_command(tmp_path):
    folder, port = tmp_path / "guarded", free_port()
    write_guard(folder)
    file = folder / "guarded.toml"
    text = file.read_text().replace("7447", str(port))
    for row, parameter in (("robot:Navigation", f'connect = ["tcp/localhost:{port}"]'),
                           ("robot:Base", f'connect = ["tcp/localhost:{port}"]'),
                           ("rampart.actors.ros2.router:RosRouter",
                            f'listen = "tcp/127.0.0.1:{port}"')):
        assert f'"{row}"' in text
        text = text.replace(f'"{row}"', f'"{row}"\nparameters = {{ {parameter} }}')
    file.write_text(text)
    check, echo, kill, status = GUARD.commands[GUARDED_RUN + 1:]
    with RealRun(folder, "guarded.toml") as real:
        real.sleep_until(3)
        here = {"RAMPART_PORT": str(real.port)}
        assert "/base, geometry_msgs/msg/Twist" in succeed(check, folder, **here)
        assert "0.8" in succeed(echo, folder, **here)
        succeed(kill, folder, **here)
        real.wait_until(lambda: "1 restarts" in succeed(status, folder, **here), 20,
                        "the navigation is not back")
