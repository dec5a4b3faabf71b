"""Whole runs: what keys permit, and that another user of the machine neither hears nor is heard."""

import json
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from rampart.actors.access import key_folder
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests.actors.access.keyed import layout_of, make_keys
from tests.other_user import NOBODY, needs_root
from tests.real_tools import connections
from tests.whole.missions import write_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone]

@pytest.fixture
def keys(tmp_path):
    return make_keys(tmp_path / "keys", layout_of("paper"))


def kill(run, name):
    """Kill a node and wait for its second process; what is told of it may be lost with a router."""
    run.kill(name)
    run.wait_until(lambda: any(name in process.names and process.incarnation == 2
                               for process in find_processes(run.port)), 30, f"{name} is not back")


def rampart(run, *words, key=None):
    environment = {**os.environ, **({"RAMPART_KEY": str(key)} if key else {})}
    return subprocess.run([sys.executable, "-P", "-m", "rampart.cli.main", *words,
                           "--port", str(run.port)], capture_output=True, text=True, timeout=60,
                          env=environment, check=False)


def test_tools_may_what_their_certificate_says_and_a_module_whose_own_expires_stops_the_robot(
        tmp_path, keys):
    """The module is deaf from then on, and must not look as if it had detected nothing."""
    key_folder.issue(keys, ("DM3",), "node", days=15 / 86_400)
    inject = ("inject", "drop:localization/pose", "--duration", "0.1")
    with RealRun(tmp_path, "paper", "--mission", "A", "--keys", str(keys)) as run:
        run.wait_for("goal 1/3", 60)
        assert {one.laddr for one in connections(run) if one.status == psutil.CONN_LISTEN} == {
            ("127.0.0.1", port) for port in run.info.ports}
        for words, shown, code, why in (
                (inject, None, 0, ""), (("status",), "bob", 0, ""),
                (inject, "bob", 2, "a viewer's certificate cannot change a run"),
                (inject, "DM4", 1, ""),  # the router lets nothing through
                (("status",), "none", 2, "RAMPART_KEY=")):
            done = rampart(run, *words, key=keys / f"{shown}.pem" if shown else None)
            assert done.returncode == code, done.stderr
            assert why in done.stderr
        run.wait_for(f"{keys / 'DM3.pem'}: the certificate of DM3 expired at", 60)
        assert "`rampart keys rotate DM3` renews it" in run.story
        run.wait_for("(DM3) silent: it counts as active", 20)
        assert "Controlled stop (RM2)" in run.story


def test_rotation_and_revocation_while_it_runs(tmp_path, keys):
    with RealRun(tmp_path, "paper", "--mission", "A", "--keys", str(keys)) as run:
        run.wait_for("goal 1/3", 60)
        stolen = tmp_path / "ada.pem"
        stolen.write_bytes((keys / "ada.pem").read_bytes())
        stolen.chmod(0o600)
        key_folder.rotate(keys, [])
        kill(run, "osmosis_control")
        key_folder.revoke(keys, ["ada"])
        for router in ("router_a", "router_b"):
            kill(run, router)
        assert rampart(run, "inject", "drop:localization/pose", key=stolen).returncode != 0
        refused = rampart(run, "status", key=stolen)
        assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (1, "", 1)
        assert "send ada no messages: its certificate is revoked" in refused.stderr
        looking = json.loads(rampart(run, "status", "--json", key=keys / "bob.pem").stdout)
        assert looking["keys"]["days_left"] == pytest.approx(30, abs=0.1)
        key_folder.issue(keys, ("eve",), "viewer")  # the routers do not know her yet
        early = rampart(run, "status", key=keys / "eve.pem")
        assert early.returncode == 1
        assert "send eve no messages: it was issued after the routers started" in early.stderr
        assert run.process.poll() is None


@pytest.mark.parametrize(("spoil", "words"), [
    (lambda keys: key_folder.revoke(keys, ["supervisor"]), "supervisor is revoked"),
    (lambda keys: (keys / "register.json").write_text("[]"), "register.json: "),
])
def test_a_run_is_not_started_with_keys_that_are_no_good_nor_in_virtual_time(keys, refused, spoil,
                                                                             words):
    assert "which has no links" in refused("run", "--virtual", "--keys", keys)
    spoil(keys)
    assert words in refused("run", "--system", "paper", "--keys", keys, "--no-hmi")


STRANGER = """
import json, os, socket, sys
nobody, folder, *addresses = sys.argv[1:]
os.setgroups([]), os.setgid(int(nobody)), os.setuid(int(nobody))

def knock(address):
    for kind in (socket.SOCK_STREAM, socket.SOCK_SEQPACKET, socket.SOCK_DGRAM):
        with socket.socket(socket.AF_UNIX, kind) as probe:
            probe.settimeout(1)
            try:
                probe.connect(address.replace("@", "\\0", 1) if address[0] == "@" else address)
                probe.send(b'{"type": "ping"}')
                yield "answered" if probe.recv(100_000) else "closed"
            except OSError as error:
                yield type(error).__name__

try:
    socket.socket(socket.AF_UNIX).bind(f"{folder}/router_a~")
    squatted = "bound"
except OSError as error:
    squatted = type(error).__name__
print(json.dumps({"knocked": {one: list(knock(one)) for one in addresses}, "squatted": squatted,
                  "listing": os.access(folder, os.R_OK | os.X_OK)}))
"""
"""Knocks at sockets in each way there is, and tries to put one of its own among them."""


@needs_root
def test_a_stranger_hears_nothing_and_is_not_heard(tmp_path):
    """There is no port to join the bus at, and every socket is out of reach or does not answer."""
    with RealRun(tmp_path, "paper", "--mission", str(write_mission(tmp_path, "NEAR"))) as run:
        run.wait_for("goal 1/3")
        info = run.info
        lines = Path("/proc/net/unix").read_text(errors="replace").splitlines()[1:]
        known = {fields[7] for line in lines if len(fields := line.split(maxsplit=7)) > 7}
        own = {address for address in known if str(run.port) in address}
        named = {f"{info.folder}/{name}" for name in (*info.nodes, *ROUTERS)}
        assert own
        done = subprocess.run(
            [sys.executable, "-c", STRANGER, str(NOBODY), info.folder, *(own | named)],
            capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert (found["squatted"], found["listing"]) == ("PermissionError", False)
        for address, outcomes in found["knocked"].items():
            assert "answered" not in outcomes, address
            assert address not in named or set(outcomes) == {"PermissionError"}, address
        assert connections(run) == []
        assert run.process.poll() is None
        assert "payload rejected" not in run.story
        assert "crashed" not in run.story
