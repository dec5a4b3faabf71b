"""The root feeds device and systemd while supervisor and manager work, and not otherwise."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rampart.cli.main import main
from rampart.testing import RealRun, wait_until

STARVED_S = 2.0


class Device:
    """A pipe in the place of a watchdog device."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.path = path
        self.fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.fed = b""

    def read(self) -> bytes:
        """Return what was written since the last call."""
        new = b""
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self.fd, 4096):
                new += data
        self.fed += new
        return new

    def starves(self, within_s: float) -> bool:
        """Whether nothing is written for STARVED_S, soon."""
        until_s = time.monotonic() + within_s
        last_s = time.monotonic()
        while time.monotonic() < until_s:
            now_s = time.monotonic()
            last_s = now_s if self.read() else last_s
            if now_s - last_s > STARVED_S:
                return True
            time.sleep(0.05)
        return False

    def is_fed(self) -> None:
        """Wait until it is fed five times more."""
        count = len(self.fed) + 5
        wait_until(lambda: self.read() is not None and len(self.fed) >= count, 30,
                   lambda: "the device is not fed")


@pytest.fixture
def device(tmp_path):
    made = Device(tmp_path / "watchdog")
    yield made
    os.close(made.fd)


@pytest.fixture
def notified(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(30)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield systemd


def waiting(notified: socket.socket) -> list[bytes]:
    """Return the messages that wait in the queue."""
    texts = []
    notified.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            texts.append(notified.recv(100))
    return texts


def test_a_run_feeds_both_unless_root_and_supervisor_stand_and_disarms_the_device_at_its_end(
        tmp_path, device, notified):
    with RealRun(tmp_path, "paper", "--watchdog", str(device.path)) as run:
        assert notified.recv(100) == b"READY=1\nWATCHDOG=1"
        run.wait_for("running")
        device.is_fed()
        assert notified.recv(100) == b"WATCHDOG=1"
        run.kill("ftm_manager")
        device.is_fed()
        run.kill("supervisor", signal.SIGSTOP)
        run.process.send_signal(signal.SIGSTOP)
        assert device.starves(20)
        run.process.send_signal(signal.SIGCONT)
        device.is_fed()
        waiting(notified)  # a full queue takes no more, and this test reads it only now
        run.process.send_signal(signal.SIGTERM)
        run.process.wait(20)
    device.read()
    assert device.fed.strip(b".") == b"V"
    texts = waiting(notified)
    assert texts[-1] == b"STOPPING=1"
    assert texts.count(b"STOPPING=1") == 1


def test_a_manager_that_hangs_at_each_start_starves_them_and_a_killed_root_leaves_it_armed(
        tmp_path, device):
    with RealRun(tmp_path, "paper", "--watchdog", str(device.path), "--fault",
                 "hang:ftm_manager@2") as run:
        run.wait_for("running")
        device.is_fed()
        assert device.starves(30)
        assert run.process.poll() is None
        run.process.kill()
        run.process.wait()
        wait_until(lambda: os.read(device.fd, 4096) == b"", 10, lambda: "the device is still open")
        assert b"V" not in device.fed


def test_a_device_that_cannot_be_opened_and_one_in_virtual_time_are_one_line(tmp_path, refused):
    assert "not with --virtual" in refused("run", "--virtual", "--watchdog", "/dev/null")
    done = subprocess.run(
        [sys.executable, "-m", "rampart.cli.run", "--no-hmi", "--watchdog", "/dev/nothing",
         "--report", str(tmp_path)], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr == "launch.py: --watchdog /dev/nothing: No such file or directory\n"


def test_the_unit_of_a_system_names_its_options(capsys):
    assert main(["service", "paper", "--user", "anna", "--watchdog-s", "5",
                 "--options=--no-hmi --mission 'A b%$'"]) == 0
    unit = capsys.readouterr().out
    assert "\nType=notify\nUser=anna\n" in unit
    assert "\nWatchdogSec=5\n" in unit
    command = next(line for line in unit.splitlines() if line.startswith("ExecStart="))
    assert command.endswith('/paper.toml --no-hmi --mission "A b%%$$"')


@pytest.mark.parametrize(("arguments", "words"), [
    (["nothing.toml"], "nothing.toml: no such file"),
    (["paper", "--watchdog-s", "0.5"], "--watchdog-s 0.5: expected 1 to 3600"),
    (["paper", "--options='"], "No closing quotation"),
    (["paper", "--options=--nonsense"], "--nonsense: not an option")])
def test_a_unit_that_could_not_start_is_refused(refused, arguments, words):
    assert words in refused("service", *arguments)
