"""A gateway on another machine than ROS 2, in a network namespace each."""

import json
import subprocess
import sys
import time

import pytest

from benchmarks.ros2_lost_machine import Reader, start
from rampart.testing import free_port, wait_until
from tests import ROOT
from tests.actors.ros2.test_gateway import configured
from tests.whole.network import network, why_not

pytestmark = [pytest.mark.processes, pytest.mark.skipif(bool(why_not()), reason=why_not())]



def on_ground(network, *words):
    return subprocess.run(network.command("ground", sys.executable, *words), check=False,
                          capture_output=True, text=True, timeout=60, cwd=ROOT)


def test_a_client_exchanges_messages_and_the_check_knows_that_a_peer_does_not(tmp_path):
    port, output = free_port(), tmp_path / "robot.txt"
    path = tmp_path / "guarded.toml"
    with network(["robot", "ground"]) as net, output.open("w") as out:
        robot = net.addresses["robot"]
        process = subprocess.Popen(net.command(
            "robot", sys.executable, "-m", "tests.actors.ros2.far_robot", robot, str(port)),
            stdout=out, cwd=ROOT)
        try:
            wait_until(lambda: "up" in output.read_text(), 20)
            for mode, passes in (("client", True), ("peer", False)):
                path.write_text(configured(connect=[f"tcp/{robot}:{port}"], mode=mode))
                before = output.read_text().count("0.25")
                done = on_ground(net, "-m", "tests.actors.ros2.far_robot", robot, str(port), mode)
                assert (int(done.stdout) > 20) is passes, done.stderr
                assert (output.read_text().count("0.25") > before + 20) is passes
                done = on_ground(net, "-m", "rampart.cli.main", "ros2", "check", "--system",
                                 str(path), "--json")
                found = {one["what"]: one for one in json.loads(done.stdout)["findings"]}
                assert done.returncode == int(not passes)
                for what in ("subscribe /odom", "publish /cmd_vel"):
                    assert found[what]["well"] is passes
                    assert passes or 'mode = "client"' in found[what]["why"]
        finally:
            with process:
                process.kill()


@pytest.mark.alone
def test_a_lost_machine_does_not_stop_the_messages_to_the_others():
    with network(["robot", "ground", "far"]) as net:
        port = free_port()
        near, far = f"tcp/127.0.0.1:{port}", f"tcp/{net.addresses['robot']}:{port}"
        parts = [start(net, "robot", "router", f"tcp/0.0.0.0:{port}", "rampart")]
        try:
            readers = {host: Reader(net, host, where, 10.0, "client") for host, where in (
                ("robot", near), ("ground", far), ("far", far))}
            parts += [one.process for one in readers.values()]
            parts += [start(net, "robot", part, near) for part in ("base", "journal", "log")]
            for one in readers.values():
                wait_until(lambda one=one: len(one.lines) > 200, 30)
            net.part(("robot", "far"), ("ground", "far"))  # 10 s before the router gives it up
            counts = {host: len(one.lines) for host, one in readers.items()}
            time.sleep(4.0)
            came = {host: len(one.lines) - counts[host] for host, one in readers.items()}
        finally:
            for part in parts:
                with part:
                    part.kill()
    assert came["far"] < 50
    for host in ("robot", "ground"):
        assert came[host] > 200, came  # of 400; with the settings of `rmw_zenohd` none
