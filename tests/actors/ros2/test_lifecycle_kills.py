"""A lifecycle node in rclpy, over DDS, is killed again and again, and is active again each time.

With `pytest -s` it prints the times from the SIGKILL to `on_activate` of the new process. After 20
kills in a row the node would be unstable.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import time

import psutil
import pytest

from rampart.testing import RealRun
from tests import ROOT
from tests.actors.ros2.test_against_ros import ROS
from tests.actors.ros2.test_gateway import SYSTEM
from tests.actors.ros2.test_relay import PEER

pytestmark = [pytest.mark.ros, pytest.mark.processes, pytest.mark.slow]

KILLS = 10
PAUSE_S = 1.0
LINKS = """
[[ros2]]
call = "/camera/get_state"
type = "lifecycle_msgs/srv/GetState"
from = "camera/ask"
to = "camera/state"

[[ros2]]
call = "/camera/change_state"
type = "lifecycle_msgs/srv/ChangeState"
from = "camera/change"
to = "camera/changed"
"""


def filmed(log, domain):
    """Return the system of a camera with a life cycle in place of driver and base."""
    text = SYSTEM[:SYSTEM.index("[[ros2]]")] + LINKS
    for old, new in {
            'name = "driver"\nactor = "tests.actors.ros2.robot:Driver"':
                'name = "camera"\ncommand = ["sh", "-c", '
                f'"exec {ROS / "bin/python"} {PEER} camera >> {log}"]',
            '[[node]]\nname = "base"\nactor = "tests.actors.ros2.robot:Base"\nkind = "world"\n': "",
            'actor = "rampart.actors.ros2.gateway:Gateway"\n':
                'actor = "rampart.actors.ros2.gateway:Gateway"\n'
                f'parameters = {{ middleware = "rclpy", domain = {domain}, '
                f'setup = "{ROS.resolve() / "bin/activate"}", '
                'distribution = "kilted" }\n',
            '"driver", "gateway"': '"camera", "gateway"',
            'actor = "rampart.actors.recovery.respawn:Respawn"\n':
                'actor = "rampart.actors.ros2.respawn_lifecycle:RespawnLifecycle"\n'
                'deadline_s = 15.0\nparameters = { lifecycle = ["camera"], ask = ["camera/ask"], '
                'state = ["camera/state:current_state.id"], change = ["camera/change"] }\n',
            "within_s = 5.0": "within_s = 60.0"}.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def test_a_lifecycle_node_is_active_again_after_each_kill(tmp_path, monkeypatch):
    domain = os.getpid() % 100 + 1  # killed nodes stay in a graph for 20 s
    for name, value in {"ROS_DOMAIN_ID": str(domain), "PYTHONPATH": str(ROOT),
                        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}.items():
        monkeypatch.setenv(name, value)
    log = tmp_path / "transitions"
    log.touch()
    path = tmp_path / "filmed.toml"
    path.write_text(filmed(log, domain))

    def active():
        told = map(json.loads, log.read_text().splitlines())
        return [(one["pid"], one["at_s"]) for one in told if one.get("state") == "active"]

    with RealRun(tmp_path, path, "--rate", "1") as run:
        run.wait_until(lambda: run.pid("camera"), 20, "it does not run")
        program = first_program(run)
        times_s = []
        for kill in range(KILLS):
            killed_s = time.time()
            os.kill(program, signal.SIGKILL)
            run.wait_until(lambda kill=kill: len(active()) > kill, 20,
                           f"kill {kill + 1}: it is not active")
            assert len(active()) == kill + 1
            program, at_s = active()[-1]
            times_s.append(at_s - killed_s)
            time.sleep(PAUSE_S)
    times_s.sort()
    print(f"{len(times_s)} kills: median {statistics.median(times_s):.2f} s, "
          f"most {times_s[-1]:.2f} s; all: {' '.join(f'{each:.2f}' for each in times_s)}")


def first_program(run):
    def programs():
        return [p.pid for p in psutil.Process(run.pid("camera")).children(recursive=True)
                if any("rclpy_peer" in word for word in p.cmdline())]

    run.wait_until(programs, 20, "the program does not run")
    return programs()[-1]
