"""docs/tutorials/guard-a-ros2-robot.md: followed to the letter, up to the robot itself.

Not run: the last step, which needs a robot with ROS 2. On processes the router of ROS 2 has a port
of its own, where the page has the usual one.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest

from rampart.actors.bus.topics import DIAGNOSTIC
from rampart.testing import RealRun, VirtualSystem, free_port, run
from tests.documents.page import Page, succeed
from tests.documents.test_authors import follow

PAGE = Page("tutorials/guard-a-ros2-robot")
RUN = PAGE.commands.index("rampart run --system guarded.toml")


def write(folder: Path) -> None:
    """Write the files of the page into a new folder."""
    folder.mkdir()
    for language, block in PAGE.blocks:
        if language != "sh":
            first, _, rest = block.partition("\n")
            follow(folder, first, rest)


def test_the_guarded_robot_is_sound_and_its_navigation_restarted_in_virtual_time(tmp_path):
    write(tmp_path / "guarded")
    make, enter, check, begin = PAGE.commands[:RUN]
    assert (make, enter) == ("mkdir guarded", "cd guarded")
    assert "sound" in succeed(check, tmp_path / "guarded")
    assert "navigation respawned by R_RESTART" in succeed(begin, tmp_path / "guarded")


@pytest.mark.parametrize("field", ["linear_mps", "angular_radps"])
def test_a_velocity_beyond_the_limits_is_refused_between_guard_and_gateway(
        tmp_path, monkeypatch, field):
    write(tmp_path / "guarded")
    monkeypatch.syspath_prepend(tmp_path / "guarded")
    for module in ("guard", "robot"):
        monkeypatch.delitem(sys.modules, module, raising=False)

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
    write(folder)
    file = folder / "guarded.toml"
    text = file.read_text().replace("7447", str(port))
    for row, parameter in (("robot:Navigation", f'connect = ["tcp/localhost:{port}"]'),
                           ("robot:Base", f'connect = ["tcp/localhost:{port}"]'),
                           ("rampart.actors.ros2.router:RosRouter",
                            f'listen = "tcp/127.0.0.1:{port}"')):
        assert f'"{row}"' in text
        text = text.replace(f'"{row}"', f'"{row}"\nparameters = {{ {parameter} }}')
    file.write_text(text)
    check, echo, kill, status = PAGE.commands[RUN + 1:]
    with RealRun(folder, "guarded.toml") as real:
        real.sleep_until(3)
        here = {"RAMPART_PORT": str(real.port)}
        assert "/base, geometry_msgs/msg/Twist" in succeed(check, folder, **here)
        assert "0.8" in succeed(echo, folder, **here)
        succeed(kill, folder, **here)
        real.wait_until(lambda: "1 restarts" in succeed(status, folder, **here), 20,
                        "the navigation is not back")
