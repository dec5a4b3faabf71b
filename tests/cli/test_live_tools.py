"""`rampart top`, `joystick`, `metrics`, `live` on one real run, real terminals and real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import math
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
import time
import urllib.request
from collections.abc import Callable

import pytest
import websockets
from prometheus_client import parser

from rampart.cli.main import main
from rampart.testing import RealRun
from tests import ROOT

_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class PseudoTerminal:
    """`rampart` with these arguments on a terminal of `columns` and `rows`."""

    def __init__(self, *arguments: str, columns: int = 80, rows: int = 24, **environment: str
                 ) -> None:
        self._master, self.slave = pty.openpty()
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.before = termios.tcgetattr(self.slave)
        self._arguments = [sys.executable, "-m", "rampart.cli.main", *arguments]
        self._environment = {
            **{k: v for k, v in os.environ.items()
               if k not in {"NO_COLOR", "COLUMNS", "LINES", "FORCE_COLOR"}},
            "TERM": "xterm-256color", **environment}
        self._output = bytearray()

    def __enter__(self) -> PseudoTerminal:
        def own_terminal() -> None:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            self._arguments, stdin=self.slave, stdout=self.slave, stderr=self.slave, cwd=ROOT,
            env=self._environment, start_new_session=True,
            preexec_fn=own_terminal)  # noqa: PLW1509 it is one system call
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.slave)
        self._reader.join(5)
        os.close(self._master)

    def _read(self) -> None:
        while True:
            try:
                self._output += os.read(self._master, 65536)
            except OSError:  # the last one who had the terminal open has ended
                return

    @property
    def raw(self) -> str:
        """Everything that was written, with all that moves the cursor."""
        return self._output.decode(errors="replace")

    @property
    def text(self) -> str:
        """Everything that was written, words only."""
        return _ESCAPE.sub("", self.raw)

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def wait_for(self, condition: str | Callable[[], bool], timeout_s: float = 30) -> None:
        """Wait for a text, or until something holds."""
        holds = condition if callable(condition) else (lambda: condition in self.text)
        deadline = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < deadline, f"{condition} did not come\n{self.text[-3000:]}"
            time.sleep(0.02)

    def end(self, timeout_s: float = 15) -> int:
        """Wait for the program's end and return its exit code."""
        return self.process.wait(timeout_s)

    @property
    def is_as_before(self) -> bool:
        """Whether the terminal's mode is what it was before the program was started."""
        return termios.tcgetattr(self.slave) == self.before


pytestmark = [pytest.mark.processes, pytest.mark.alone]

UP, LEFT = "\x1b[A", "\x1b[D"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    directory = tmp_path_factory.mktemp("run")
    with RealRun(directory, "paper") as it:
        it.wait_for("mission AB running", 60)
        yield it


@contextlib.contextmanager
def started(*arguments: str, stdout):
    """Run a verb until the end of the block."""
    process = subprocess.Popen([sys.executable, "-m", "rampart.cli.main", *arguments],
                               stdout=stdout, text=True, cwd=ROOT)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=15)


@contextlib.contextmanager
def serving(*arguments: str, ready: str):
    """Run a verb that serves; yields what it says after `ready`."""
    with started(*arguments, stdout=subprocess.PIPE) as process:
        line = process.stdout.readline()
        assert ready in line
        yield line.split(ready)[1].strip(), process


@contextlib.contextmanager
def echo(run: RealRun, topic: str):
    """Collect what is sent on a topic; yields a function that returns all of it so far."""
    out = run.directory / "echo"
    with out.open("w") as file, started(
            "topic", "echo", topic, "--json", "--port", str(run.port), stdout=file):
        yield lambda: [json.loads(line) for line in out.read_text().splitlines(keepends=True)
                       if line.endswith("\n")]


def twist(message: dict) -> tuple[float, float]:
    return message["message"]["linear_mps"], message["message"]["angular_radps"]


# -- top ----------------------------------------------------------------------------------------


def test_top_tells_a_script_everything_once(run, capsys):
    assert main(["top", "--json", "--port", str(run.port)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["mission"]["phase"] == "running"
    assert "safe so far" in data["safety"]
    processes = {row["name"]: row for row in data["processes"]}
    assert {"simulator", "safety_pilot", "supervisor", "launch.py"} <= processes.keys()
    assert processes["simulator"]["mb"] > 1
    assert processes["simulator"].keys() >= {"state", "incarnation", "restarts", "cpu", "age_s"}
    assert data["decisions"] == []
    assert processes["simulator"]["pid"] == run.pid("simulator")
    assert data["rates_hz"]["localization/pose"] > 5
    told = run.tool("top")  # into a pipe: one picture in plain text
    assert told.returncode == 0, told.stderr
    assert "osmosis_control" in told.stdout
    assert "\x1b" not in told.stdout


def test_top_shows_a_crash_and_the_new_life_and_leaves_the_terminal_as_it_was(run):
    with PseudoTerminal("top", "--port", str(run.port), columns=120, rows=50, NO_COLOR="1") as it:
        it.wait_for("teleoperation")
        life = run.pid("hmi")
        run.kill("hmi")
        it.wait_for(": RM4: FTM5, because")  # in the words of the decision
        run.wait_until(lambda: run.pid("hmi") not in {None, life}, 20, "hmi did not come back")
        it.wait_for(lambda: re.search(r"hmi +running +[2-9] +[1-9]", it.text) is not None)
        assert not it.is_as_before
        it.press("q")
        assert it.end() == 0
        assert it.is_as_before
        assert it.raw.count("\x1b[?1049h") == it.raw.count("\x1b[?1049l") == 1
        assert it.raw.rfind("\x1b[?25h") > it.raw.rfind("\x1b[?25l")
        colours = re.findall(r"\x1b\[([0-9;]*)m", it.raw)
        assert not [c for c in colours if re.search(r"(^|;)(3[0-8]|4[0-8]|9\d|10\d)(;|$)", c)]


# -- joystick -----------------------------------------------------------------------------------


def hold(it: PseudoTerminal, key: str, until, timeout_s: float = 40) -> None:
    """Press a key again and again, as a keyboard does."""
    deadline = time.monotonic() + timeout_s
    while not until():
        assert time.monotonic() < deadline, it.text
        it.press(key)
        time.sleep(0.04)


def test_a_held_key_drives_and_without_its_repetition_or_its_process_the_robot_stops(run):
    with echo(run, "teleoperation/command") as heard, \
            PseudoTerminal("joystick", "--port", str(run.port), "--speed", "0.2") as it:
        it.wait_for("hold a key")
        hold(it, LEFT, lambda: len(heard()) > 8)
        it.wait_for(lambda: twist(heard()[-1]) == (0.0, 0.0), 5)
        assert all(linear == 0.0 and turn >= 0.0 for linear, turn in map(twist, heard()))
        assert max(turn for _, turn in map(twist, heard())) > 0.0
        before = len(heard())
        hold(it, LEFT, lambda: len(heard()) > before + 5)
        it.process.kill()
        it.wait_for(lambda: twist(heard()[-1]) == (0.0, 0.0), 5)


def test_who_holds_first_drives_and_the_other_is_told_who_has_the_stick(run):
    with echo(run, "teleoperation/command") as heard, \
            PseudoTerminal("joystick", "--port", str(run.port)) as driver, \
            PseudoTerminal("joystick", "--port", str(run.port)) as it:
        for terminal in (driver, it):
            terminal.wait_for("hold a key")
        hold(driver, LEFT, lambda: len(heard()) > 5)

        def told() -> bool:
            driver.press(LEFT)
            return "has the stick" in it.text

        hold(it, UP, told)
        assert all(linear == 0.0 and turn >= 0.0 for linear, turn in map(twist, heard()))
        it.wait_for(lambda: twist(heard()[-1]) == (0.0, 0.0), 5)
        it.press("q")
        assert it.end() == 0
        assert it.is_as_before


def test_the_keyboard_needs_a_terminal(run, refused):
    assert "expected a terminal" in refused("joystick", "--port", run.port)


# -- metrics ------------------------------------------------------------------------------------


def scrape(url: str) -> dict[str, list]:
    with urllib.request.urlopen(url, timeout=10) as answer:
        assert answer.headers["content-type"].startswith("text/plain; version=")
        return {family.name: family.samples
                for family in parser.text_string_to_metric_families(answer.read().decode())}


def value(families: dict[str, list], family: str, name: str = "", **labels: str) -> float:
    found = [s.value for s in families[f"rampart_{family}"]
             if labels.items() <= s.labels.items() and s.name == f"rampart_{name or family}"]
    assert len(found) == 1, (family, labels, families[f"rampart_{family}"])
    return found[0]


def test_prometheus_is_given_the_figures_of_the_run(run):
    with serving("metrics", "--port", "0", "--run", str(run.port), ready="metrics at ") as (url, _):
        def complete() -> bool:
            found = scrape(url)
            return (found["rampart_up"][0].value == 1 and bool(found.get("rampart_node_up"))
                    and {"rampart_obstacle_clearance_meters",
                         "rampart_mission_phase"} <= found.keys()
                    and any(s.labels["process"] == "launch.py" for s in found.get(
                        "rampart_process_resident_memory_bytes", ())))  # a look of its own

        run.wait_until(complete, 20, "the figures did not come")
        found = scrape(url)
        assert value(found, "node_up", node="simulator") == 1
        assert value(found, "heartbeat_age_seconds", node="safety_pilot") < 60
        assert value(found, "mission_phase", rampart_mission_phase="running") == 1
        assert value(found, "messages", "messages_total", topic="localization/pose") > 0
        assert value(found, "process_resident_memory_bytes", process="launch.py") > 1e6
        with urllib.request.urlopen(urllib.request.Request(
                url, headers={"accept": "application/openmetrics-text"}), timeout=10) as answer:
            assert answer.read().endswith(b"# EOF\n")


# -- live ---------------------------------------------------------------------------------------


async def look(url: str, wanted: set[str]) -> tuple[dict[str, dict], dict[str, dict]]:
    """Return what is advertised, and the first message of each channel wanted."""
    async with asyncio.timeout(30), websockets.connect(
            url, subprotocols=["foxglove.sdk.v1"]) as connection:
        channels: dict[str, dict] = {}
        while not wanted <= channels.keys():
            message = await connection.recv()
            if isinstance(message, str) and (told := json.loads(message))["op"] == "advertise":
                channels |= {c["topic"]: c for c in told["channels"]}
        numbers = dict(enumerate(sorted(wanted)))
        await connection.send(json.dumps({"op": "subscribe", "subscriptions": [
            {"id": i, "channelId": channels[topic]["id"]} for i, topic in numbers.items()]}))
        found: dict[str, dict] = {}
        while wanted - found.keys():
            message = await connection.recv()
            if isinstance(message, bytes) and message[0] == 1:
                number, _time_ns = struct.unpack_from("<IQ", message, 1)
                found.setdefault(numbers[number], json.loads(message[13:]))
        return channels, found


def test_a_viewer_of_foxglove_sees_map_robot_laser_and_pose(run):
    wanted = {"/view/map", "/view/tf", "/view/pose", "/view/scan", "/view/lights", "/view/robot"}
    with serving("live", "foxglove", "--port", "0", "--run", str(run.port),
                 ready="Foxglove viewers: ") as (url, process):
        assert "showing" in process.stdout.readline()
        for _visitor in range(2):  # the second comes late, and sees the map all the same
            channels, found = asyncio.run(look(url, wanted))
            assert channels["/view/scan"]["schemaName"] == "foxglove.LaserScan"
            assert {c["encoding"] for c in channels.values()} == {"json"}
            assert {e["id"] for e in found["/view/map"]["entities"]} >= {"ground", "prohibited"}
            assert [(t["parent_frame_id"], t["child_frame_id"])
                    for t in found["/view/tf"]["transforms"]] == [
                        ("map", "odom"), ("odom", "base_link")]
            assert len(found["/view/scan"]["ranges"]) > 50
            pose = found["/view/pose"]["pose"]["position"]
            assert math.hypot(pose["x"], pose["y"]) < 100


# -- the end ------------------------------------------------------------------------------------


def test_when_the_run_ends_everybody_says_so(run):
    with PseudoTerminal("top", "--port", str(run.port)) as top, \
            serving("metrics", "--port", "0", "--run", str(run.port), ready="metrics at ") as (
                url, _):
        top.wait_for("simulator")
        run.wait_until(lambda: scrape(url)["rampart_up"][0].value == 1, 20, "no run is seen")
        run.process.terminate()
        run.process.wait(20)
        assert top.end() == 0
        assert "the run has ended" in top.text.rsplit("\n", 2)[-2]
        assert top.is_as_before
        run.wait_until(lambda: scrape(url)["rampart_up"][0].value == 0, 10, "the run is still seen")
