"""A lifecycle node in rclpy, over DDS, is killed again and again, and is active again each time.

After 20 kills in a row the node would be unstable.
"""

import json
import os
import signal
import time

import pytest

from rampart.testing import RealRun
from tests.actors.ros2.test_against_ros import PYTHON
from tests.actors.ros2.test_relay import PEER, domain, system  # noqa: F401 fixtures

pytestmark = [pytest.mark.ros, pytest.mark.processes, pytest.mark.slow]

KILLS = 10
PAUSE_S = 1.0
CAMERA = """
[recovery.parameters]
lifecycle = ["camera"]
ask = ["camera/ask"]
state = ["camera/state:current_state.id"]
change = ["camera/change"]

[[node]]
name = "camera"
command = ["sh", "-c", "exec {python} {peer} camera >> {log}"]
kind = "non-control"
respawn = "R_RESTART"

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


def test_a_lifecycle_node_is_active_again_after_each_kill(tmp_path, system):  # noqa: F811
    log = tmp_path / "log"
    log.touch()

    def active(state="active"):
        told = map(json.loads, log.read_text().splitlines())
        return [one["pid"] for one in told if state in (one.get("state"), *one)]

    path = system()
    parameters, rest = CAMERA.format(python=PYTHON, peer=PEER, log=log).split("\n[[node]]", 1)
    respawn = 'actor = "rampart.actors.recovery.respawn:Respawn"\nkind = "masking"\n'
    path.write_text(path.read_text().replace(
        respawn, respawn.replace("recovery.respawn:Respawn",
                                 "ros2.respawn_lifecycle:RespawnLifecycle")
        + "deadline_s = 15.0\n" + parameters).replace(
            '"driver", "gateway"]', '"driver", "gateway", "camera"]') + f"\n[[node]]{rest}")
    with RealRun(tmp_path, path, "--rate", "1") as run:
        run.wait_until(lambda: active("up"), 30, "it does not run")
        (program,) = active("up")
        for kill in range(KILLS):
            os.kill(program, signal.SIGKILL)
            run.wait_until(lambda kill=kill: len(active()) > kill, 20,
                           f"kill {kill + 1}: it is not active")
            assert len(active()) == kill + 1
            program = active()[-1]
            time.sleep(PAUSE_S)
