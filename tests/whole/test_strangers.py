"""Another user of the machine: nothing in, nothing out, on every port and socket of a run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.actors.bus.run_folder import ROUTERS
from rampart.testing import RealRun
from tests.other_user import NOBODY, needs_root
from tests.real_tools import connections
from tests.whole.missions import write_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone, needs_root]

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
