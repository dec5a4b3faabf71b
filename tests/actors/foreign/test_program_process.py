"""A program as its node's process holds it: started, heard, ended, its forks and its socket."""

import asyncio
import functools
import os
import resource
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.foreign import channel as channel_module
from rampart.actors.foreign import output_log
from rampart.actors.foreign.channel import MAX_PACKET, Channel
from rampart.actors.foreign.descendants import descendants
from rampart.actors.foreign.output_log import BURST_BYTES, OutputLog
from rampart.actors.foreign.program import inherited_environment
from rampart.actors.foreign.program_process import ProgramProcess
from rampart.actors.foreign.pulse import NotifySocket, Pulse, extension_s
from rampart.actors.machine.unix_peer import process_state
from rampart.manager.spec.nodes import ChildLimits
from rampart.testing import eventually
from tests import ROOT

FORKS = """
setsid sh -c 'trap "" TERM; while :; do sleep 600; done' &
env -i /usr/bin/setsid /bin/sleep 601 &
(sleep 602 & )
"""


class Started:
    """A program of `sh`, and how it has ended."""

    def __init__(self, folder: Path, script: str, program: str = "/bin/sh",
                 **limits: float) -> None:
        self.log = folder / "it.log"
        self.ends: list[str] = []
        self.process = ProgramProcess(
            program, ["-c", script], folder=folder, environment=dict(os.environ),
            limits=ChildLimits(**limits), log=OutputLog(self.log), inherited=[],
            ended=self.ends.append)

    async def end(self) -> str:
        """Wait for its end and return it."""
        await eventually(lambda: self.ends)
        (end,) = self.ends
        return end


def isolated(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test in a process of its own: all that is below it is killed."""

    @functools.wraps(test)
    def fork(*given: object, **named: object) -> None:
        told, tell = os.pipe()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                asyncio.run(test(*given, **named))
                code = 0
            except BaseException:
                os.write(tell, traceback.format_exc().encode())
            finally:
                os._exit(code)
        os.close(tell)
        with os.fdopen(told) as text:
            assert os.waitpid(pid, 0)[1] == 0, text.read()

    return fork


def are_gone(pids) -> bool:
    return all(process_state(pid) in "XZ" for pid in pids)


@pytest.mark.parametrize("how", ["ends", "is killed", "is asked to end"])
@isolated
async def test_all_that_it_has_forked_ends_with_it(tmp_path, how):
    rest = "read _ < go" if how == "ends" else "trap '' TERM; while :; do sleep 603; done"
    os.mkfifo(tmp_path / "go")
    started = Started(tmp_path, FORKS + rest)
    await eventually(lambda: len(descendants(os.getpid())) >= 5)
    pids = descendants(os.getpid())
    if how == "ends":
        (tmp_path / "go").write_text("\n")
        assert await started.end() == "ended: exit code 0"
    elif how == "is killed":
        os.kill(started.process.pid, signal.SIGKILL)
        assert await started.end() == "ended: signal SIGKILL"
    else:
        started.process.end()
        assert started.ends == []
    assert are_gone(pids)
    assert descendants(os.getpid()) == set()


@isolated
async def test_it_may_end_in_order_when_it_is_asked_to_also_if_it_is_stopped(tmp_path):
    started = Started(tmp_path, "trap 'head -c 300000 /dev/zero; echo bye; exit' TERM; echo up; "
                                "while :; do sleep 0.01; done")
    await eventually(lambda: started.log.exists() and "up" in started.log.read_text())
    os.kill(started.process.pid, signal.SIGSTOP)
    await eventually(lambda: started.process.is_stopped)
    started.process.end()
    assert started.log.read_bytes().endswith(b"bye\n")


@isolated
async def test_daemons_that_end_before_it_leave_no_zombies_and_its_own_end_is_told_once(tmp_path):
    os.mkfifo(tmp_path / "go")
    started = Started(tmp_path, "for i in 1 2 3; do (setsid sh -c 'echo >> ends' & ); done; "
                                "echo first; read _ < go; echo last >&2; exit 4")
    ends = tmp_path / "ends"
    await eventually(lambda: ends.exists() and len(ends.read_text()) == 3)
    await eventually(lambda: not any(
        one.status() == psutil.STATUS_ZOMBIE for one in psutil.Process().children()))
    (tmp_path / "go").write_text("\n")
    assert await started.end() == "ended: exit code 4"
    assert started.log.read_text() == "first\nlast\n"
    started.process.kill()  # harmless
    started.process.end()
    assert started.ends == ["ended: exit code 4"]


@pytest.mark.parametrize(("content", "mode", "end", "reason"), [
    (None, 0o755, "ended: exit code 127", "No such file"),
    (b"#!/nowhere/sh\n", 0o755, "ended: exit code 127", "No such file"),
    (b"\x7fNONSENSE", 0o755, "ended: exit code 127", "not found"),  # setpriv has a shell run it
    (b"#!/bin/sh\n", 0o644, "ended: exit code 126", "Permission denied")])
@isolated
async def test_a_file_that_is_not_a_program_ends_at_once_and_says_why(
        tmp_path, content, mode, end, reason):
    program = tmp_path / "program"
    if content is not None:
        program.write_bytes(content)
        program.chmod(mode)
    started = Started(tmp_path, "", program=str(program))
    assert await started.end() == end
    assert reason in started.log.read_text()


@isolated
async def test_without_setpriv_or_a_folder_nothing_starts_or_is_left(tmp_path, monkeypatch):
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(FileNotFoundError):
        Started(tmp_path / "none", "")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="setpriv"):
        Started(tmp_path, "")
    assert len(list(Path("/proc/self/fd").iterdir())) <= before + 3  # of the loop's signals, once
    assert descendants(os.getpid()) == set()


@isolated
async def test_limits_and_signals_are_those_of_the_program_and_not_of_this_process(tmp_path):
    mine = resource.getrlimit(resource.RLIMIT_NOFILE)
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    started = Started(tmp_path, "ulimit -n; ulimit -v; ulimit -t; grep SigIgn /proc/$$/status",
                      memory_mb=512, processor_s=7, open_files=32, file_mb=1)
    await started.end()
    *limits, _, ignored = started.log.read_text().split()
    assert limits == ["32", "500000", "7"]
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == mine
    # signal(7): 32 and 33 are the C library's own, and cannot be reset through it
    assert not [one for one in signal.valid_signals() if int(ignored, 16) >> (one - 1) & 1]
    with pytest.raises(ValueError, match=r"limits\.open_files = .* is above the hard limit"):
        Started(tmp_path, "", open_files=mine[1] + 1)


SEND = """
import os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
    notify.sendto(sys.argv[1].encode(), "\\0" + os.environ["NOTIFY_SOCKET"][1:])
print("sent", flush=True)
sys.stdin.read()
"""
SEND_BELOW = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {SEND!r}, 'below'])"


def test_a_datagram_of_a_living_descendant_counts_and_no_other():
    refused: list[tuple[str, str]] = []
    notify = NotifySocket("wheels", lambda *why: refused.append(why))
    started = functools.partial(
        subprocess.Popen, env={**os.environ, "NOTIFY_SOCKET": notify.name},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with started([sys.executable, "-c", SEND_BELOW]) as below:
        assert below.stdout.readline() == b"sent\n"
        assert notify.take() == ["below"]
        below.stdin.close()
    assert refused == []
    started([sys.executable, "-c", SEND, "ended"]).communicate()
    with started(["sh", "-c", '"$@" <&0 &', "sh", sys.executable, "-c", SEND, "orphan"]) as gone:
        gone.wait()
        assert gone.stdout.readline() == b"sent\n"  # by a process that lives, and not below
        assert notify.take() == []
        gone.stdin.close()
    assert len(refused) == 2
    notify.close()


def test_a_path_of_python_is_inherited_unless_it_leads_to_this_rampart(monkeypatch):
    ros = "/opt/ros/jazzy/lib/python3.12/site-packages"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), ros]))
    assert inherited_environment()["PYTHONPATH"] == ros
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert "PYTHONPATH" not in inherited_environment()
    monkeypatch.delenv("PYTHONPATH")
    assert inherited_environment() == dict(os.environ)


def wells(pulse: Pulse, *tenths: int) -> list[bool]:
    return [pulse.is_well(n / 10) for n in tenths]


def test_silence_counts_from_the_last_beat_unless_its_own_word_or_node_says_otherwise():
    pulse = Pulse(timeout_s=0.5, first_s=5.0, look_s=0.2)
    assert wells(pulse, 0, 10, 20) == [True] * 3  # the first beat may come later
    assert wells(pulse, *range(20, 80))[::40] == [True, True]
    assert not pulse.is_well(8.0)
    pulse.beat()
    assert wells(pulse, *range(80, 88)) == [True] * 6 + [False] * 2
    pulse.beat()
    assert pulse.is_well(8.8)
    assert wells(pulse, 680, 681) == [True] * 2  # the node itself stood still
    assert not any(wells(pulse, *range(685, 690)))
    pulse.beat()
    assert pulse.is_well(69.0)
    pulse.trigger()
    assert not pulse.is_well(69.0)


@pytest.mark.parametrize("started", [False, True])
def test_it_may_ask_for_more_time_until_its_next_beat(started):
    pulse = Pulse(timeout_s=0.5, first_s=1.0, look_s=0.2)
    if started:
        pulse.beat()
    pulse.extend(3.0)
    assert wells(pulse, *range(40)) == [True] * 31 + [False] * 9
    pulse.beat()
    assert wells(pulse, *range(40, 48))[-1] is False, "the usual time again"


def test_silence_does_not_count_while_a_carrier_is_down_and_starts_again_after_its_restart():
    pulse = Pulse(timeout_s=0.5, first_s=1.0, look_s=0.2, carriers=("gateway",))
    pulse.beat()
    pulse.note_process("gateway", "crashed")
    pulse.beat()  # which shows that it works, though its event was lost
    pulse.note_process("other", "crashed")
    assert wells(pulse, *range(8)) == [True] * 6 + [False] * 2
    pulse.beat()
    for failure in ("wedged", "crashed", "given up"):
        pulse.note_process("gateway", failure)
    assert all(wells(pulse, *range(10, 60)))
    pulse.restart()  # of the program
    assert all(wells(pulse, *range(60, 110)))
    pulse.note_process("gateway", "respawned")
    after = wells(pulse, *range(110, 123))
    assert after[:10] + after[-2:] == [True] * 10 + [False] * 2


def test_one_that_says_that_it_ends_has_to_end():
    pulse = Pulse(timeout_s=0.5, first_s=5.0, look_s=0.2)
    pulse.stopping()
    after = []
    for n in range(10):
        pulse.beat()
        after += wells(pulse, n)
    assert after[:5] + after[-1:] == [True] * 5 + [False]
    pulse.restart()
    pulse.beat()
    assert all(wells(pulse, *range(10, 15))), "the next one has not said so"
    pulse.beat()
    assert all(wells(pulse, *range(15, 20)))


@pytest.mark.parametrize(("text", "seconds"), [
    ("5000000", 5.0), ("0", 0.0), ("3600000001", 3600.0), ("9" * 6000, 3600.0),
    ("0" * 7000 + "1000000", 1.0), ("", None), ("-1", None), (" 1", None), ("1e6", None),
    ("1_000", None), ("nan", None), ("\u0663", None)])
def test_how_much_time_it_asks_for(text, seconds):
    assert extension_s(text) == seconds


def test_assignments_come_in_order_several_in_a_datagram_and_a_flood_in_parts():
    notify = NotifySocket("wheels", lambda *_: None)
    assert notify.name.startswith("@")
    assert notify.take() == []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as command:
        for said in (b"READY=1\nSTATUS=up", b"\xff", b"", b"WATCHDOG=1"):
            command.sendto(said, f"\0{notify.name[1:]}")
        assert notify.take() == ["READY=1", "STATUS=up", "\ufffd", "WATCHDOG=1"]
        for _ in range(8):
            command.sendto(b"WATCHDOG=1", f"\0{notify.name[1:]}")
    assert [len(notify.take(most=5)) for _ in range(2)] == [5, 3]
    notify.close()


@pytest.fixture
def clock(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(output_log.time, "monotonic", lambda: now_s[0])
    return now_s


def test_output_goes_on_in_a_second_file_and_never_beyond_and_one_of_its_name_is_always_there(
        tmp_path, clock, monkeypatch):
    file, before = tmp_path / "a.log", tmp_path / "a.log.1"
    file.write_bytes(b"x" * 950)
    log, is_there = OutputLog(file, most=1000), []
    log.write(b"new\n" * 20)
    assert before.read_bytes() == b"x" * 950, "of the incarnation before"

    def watched(real, *given):
        is_there.append(file.exists())
        done = real(*given)
        is_there.append(file.exists())
        return done

    for name in ("unlink", "link", "replace", "open"):
        monkeypatch.setattr(output_log.os, name, partial(watched, getattr(os, name)))
    for number in range(100):
        clock[0] += 1.0
        log.write(b"%09d\n" % number * 10)
        assert file.stat().st_size <= 1000
    assert is_there
    assert all(is_there)
    assert before.stat().st_size <= 1000
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.log", "a.log.1"}
    kept = before.read_bytes() + file.read_bytes()
    assert kept.endswith(b"000000099\n")
    assert b"000000090\n" in kept


def test_a_flood_is_counted_where_it_is_too_much_and_the_count_is_told(tmp_path, clock):
    file = tmp_path / "a.log"
    log = OutputLog(file)
    for _ in range(100):
        log.write(b"x" * 65_536)
    kept = file.stat().st_size
    assert kept <= BURST_BYTES
    clock[0] += 1.0
    log.write(b"y\n")
    left_out = 100 * 65_536 - kept
    assert file.read_bytes()[kept:] == f"\n--- {left_out} bytes are left out\ny\n".encode()


def test_no_folder_and_a_link_in_the_place_of_the_log_end_nothing(tmp_path):
    OutputLog(tmp_path / "none" / "a.log").write(b"lost\n")
    target = tmp_path / "precious"
    target.write_text("mine")
    (tmp_path / "a.log").symlink_to(target)
    OutputLog(tmp_path / "a.log").write(b"lost\n")
    assert target.read_text() == "mine"


class Wheels(Message, frozen=True):
    """For tests."""

    left_radps: float


class Text(Message, frozen=True):
    """For tests."""

    text: str


WHEELS = Topic("tug/wheels", Wheels, Qos.SENSOR, 10.0, "", "For tests.")
ORDER = Topic("tug/order", Text, Qos.COMMAND, 0.0, "", "For tests.")
HEADER = Header("driver", 2, 7, 1.5)


class End:
    """A channel, and what became of what was sent to it."""

    def __init__(self) -> None:
        self.taken = []
        self.refused = []
        self.channel = Channel(
            {"tug/wheels": WHEELS},
            lambda key, topic, body, stamp: self.taken.append((key, body, stamp)),
            lambda key, why: self.refused.append(f"{key}: {why}"), lambda: 10.0)
        self.command = self.channel.other

    async def send(self, *packets: bytes) -> None:
        for packet in packets:
            self.command.send(packet)
        for _ in range(10):
            await asyncio.sleep(0)


@pytest.fixture
async def end():
    made = End()
    yield made
    made.channel.close()


async def test_a_message_with_and_without_its_time(end):
    await end.send(b'tug/wheels\n{"left_radps": 2}', b'tug/wheels 9.5\n{"left_radps":1.5}')
    assert end.taken == [("tug/wheels", Wheels(2.0), None), ("tug/wheels", Wheels(1.5), 9.5)]
    assert end.refused == []


WHEEL = "tug/wheels: not a Wheels: "


@pytest.mark.parametrize(("packet", "line"), [
    (b'tug/order\n{"text":"x"}', "tug/order: not one of the keys"),
    (b"\xff\xfe\n{}", "\ufffd\ufffd: not one of the keys"), (b"tug/wheels", WHEEL),
    (b'tug/wheels\n{"left_radps":"x"}', f"{WHEEL}Expected `float`, got `str`"),
    (b'tug/wheels\n{"left":1}', WHEEL), (b"tug/wheels\n" + b"[" * 100_000, WHEEL),
    (b'tug/wheels soon\n{"left_radps":1}', WHEEL),
    (b'tug/wheels 10.2\n{"left_radps":1}', "tug/wheels: stamp 10.2: "),
    (b'tug/wheels nan\n{"left_radps":1}', "tug/wheels: stamp nan: "),
    (b"tug/wheels\n" + b" " * MAX_PACKET, f"tug/wheels: more than {MAX_PACKET} bytes"),
    (b"", ""),  # which is not the end
], ids=range(11))
async def test_what_is_no_message_is_refused_and_the_next_one_is_taken(end, packet, line):
    await end.send(packet, b'tug/wheels\n{"left_radps":1}')
    (refused,) = end.refused
    assert refused.startswith(line)
    assert len(end.taken) == 1


async def test_its_end_is_the_end(end):
    end.command.close()
    for _ in range(10):
        await asyncio.sleep(0)
    end.channel.send("tug/order", ORDER, Text("x"), HEADER)
    assert end.taken == []


async def test_what_the_command_hears(end):
    end.channel.send("tug/order", ORDER, Text("x" * MAX_PACKET), HEADER)
    end.channel.send("tug/order", ORDER, Text("go"), HEADER)
    assert end.command.recv(1000) == b'tug/order 1.5 driver 2\n{"text":"go"}'
    (refused,) = end.refused
    assert refused.startswith(f"tug/order: packet of {MAX_PACKET + 34} bytes; at most")


async def test_for_one_that_does_not_read_the_newest_sample_waits_and_commands_up_to_a_bound(end):
    text = Text("x" * 60_000)
    for number in range(400):
        end.channel.send("tug/order", ORDER, text, HEADER)
        end.channel.send("tug/wheels", WHEELS, Wheels(float(number)), HEADER)
    assert "tug/order: the command does not read its socket; a message to it is lost" in end.refused
    assert len(end.channel._waiting) <= channel_module._WAITING
    end.command.setblocking(False)
    heard = []
    while b"399.0" not in (heard[-1] if heard else b"") and len(heard) < 1000:
        await asyncio.sleep(0)
        try:
            heard.append(end.command.recv(MAX_PACKET))
        except BlockingIOError:
            continue
    assert heard[-1] == b'tug/wheels 1.5 driver 2\n{"left_radps":399.0}'
