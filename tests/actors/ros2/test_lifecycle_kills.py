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

import pytest

from rampart.testing import RealRun
from tests.actors.ros2.test_against_ros import PYTHON
from tests.actors.ros2.test_relay import PEER, domain, system  # noqa: F401 fixtures

pytestmark = [pytest.mark.ros, pytest.mark.processes, pytest.mark.slow]

KILLS = 10
PAUSE_S = 1.0
CAMERA = """
[[node]]
name = "camera"
command = ["sh", "-c", "exec {python} {peer} camera >> {log}"]
kind = "non-control"
respawn = "R_CAMERA"

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

[[detection]]
name = "D_CAMERA"
title = "The camera has crashed"
actor = "rampart.actors.detection.watchdog:Watchdog"
parameters = {{ watch = ["camera"], timeout_s = "heartbeat_timeout_s" }}

[[recovery]]
name = "R_CAMERA"
title = "Restart and activate it"
actor = "rampart.actors.ros2.respawn_lifecycle:RespawnLifecycle"
kind = "masking"
deadline_s = 15.0

[recovery.parameters]
lifecycle = ["camera"]
ask = ["camera/ask"]
state = ["camera/state:current_state.id"]
change = ["camera/change"]

[[mechanism]]
name = "M_CAMERA"
detect = "D_CAMERA"
recover = "R_CAMERA"
event = "missing"
against = {{ within_s = 60.0, hazard = "it sees nothing" }}
"""


def test_a_lifecycle_node_is_active_again_after_each_kill(tmp_path, system):  # noqa: F811
    log, times_s = tmp_path / "log", []
    log.touch()

    def active(state="active"):
        told = map(json.loads, log.read_text().splitlines())
        return [(one["pid"], one["at_s"]) for one in told if state in (one.get("state"), *one)]

    path = system(CAMERA.format(python=PYTHON, peer=PEER, log=log))
    with RealRun(tmp_path, path, "--rate", "1") as run:
        run.wait_until(lambda: active("up"), 30, "it does not run")
        (program, _), = active("up")
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
