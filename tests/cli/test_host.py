"""`--host`: what is refused, in one line each, before anything is started."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests import ROOT
from tests.two_hosts import two_hosts


@pytest.mark.parametrize(("arguments", "message"), [
    (["--host", "moon", "--no-keys"], "--host moon: unknown; known: robot, ground"),
    (["--host", "ground"], "osmosis runs on 2 hosts: say --keys DIR (`rampart keys init` makes "
     "one), or --no-keys if whoever is on their network may do everything"),
    ([], "osmosis runs on 2 hosts: say --keys DIR"),
    (["--no-keys", "--keys", "keys"], "--no-keys: either that or --keys"),
    (["--host", "ground", "--virtual"], "--host ground: virtual time is on one machine"),
    (["--host", "ground", "--no-keys", "--seed", "7"],
     "--seed 7: on host ground the first host's command line decides that"),
    (["--host", "ground", "--no-keys", "--mission", "A"],
     "--mission A: on host ground the first host's command line decides that"),
    (["--host", "ground", "--no-keys", "--record", "x.mcap"],
     "--record x.mcap: on host ground the first host's command line decides that"),
    (["--no-keys", "--hmi-port", "9000"],
     "--hmi-port 9000: no node of osmosis on host the first serves an operator's page"),
    (["--no-keys"], "cannot listen at 192.0.2.1 port 7462 for the other hosts"),
])
def test_refused(arguments, message, tmp_path):
    spec = tmp_path / "two.toml"
    spec.write_text(two_hosts({"robot": "192.0.2.1", "ground": "192.0.2.2"}), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "rampart.cli.run", "--system", str(spec), *arguments],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(("arguments", "message"), [
    (["--host", "ground"], "--host ground: osmosis has no [[host]]; it runs on one machine"),
    (["--no-keys"], "--no-keys: osmosis runs on one machine, and opens no port"),
])
def test_a_system_of_one_machine_has_no_hosts(arguments, message):
    done = subprocess.run([sys.executable, str(ROOT / "launch.py"), *arguments], cwd=ROOT,
                          capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, len(done.stderr.strip().splitlines())) == (2, 1)
    assert message in done.stderr


@pytest.mark.slow
def test_in_virtual_time_a_system_of_two_hosts_runs_on_one(tmp_path):
    spec = tmp_path / "two.toml"
    spec.write_text(two_hosts({"robot": "192.0.2.1", "ground": "192.0.2.2"}), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "rampart.cli.run", "--system", str(spec), "--virtual",
         "--mission", "A", "--json", "--report", str(tmp_path / "report")],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert '"mission": "success"' in done.stdout
