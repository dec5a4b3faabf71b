"""Small recordings, and a launcher that only answers who it is."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import Writer

from rampart.actors.bus import run_info
from rampart.actors.bus.envelope import Header, encode
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.recording.bag_writer import BagWriter
from rampart.actors.recording.recorder import Recorder
from rampart.actors.recording.run_documents import Documents, collect
from rampart.actors.recording.run_listener import RUN_ENDED
from tests import ROOT

PLAN = {"system_file": str(ROOT / "systems" / "paper.toml"), "airport": "vallombre",
        "mission": "AB", "strategy": "", "shadow": "", "seed": 1, "obstacles": 0, "ftm": True}
NAN = float("nan")

Sent = tuple[float, str, bytes]


def documents(**changes: object) -> Documents:
    known = {"run_id": "sample", "title": "a sample", "rate": 1.0,
             "nodes": ("localization", "DM1"), "started": "2026-01-01T00:00:00+00:00", **changes}
    return collect(PLAN, **known)


def pose(number: int, at_s: float, yaw_rad: float = 0.0, incarnation: int = 1) -> Sent:
    header = Header("localization", incarnation, number, at_s)
    return at_s, topics.POSE.at(), encode(header, m.Pose(float(number), 0.0, yaw_rad))


def sample(count: int = 20) -> list[Sent]:
    """Poses, one of them with NaN, garbage, and a detection that comes and goes."""
    sent = [pose(i + 1, i * 0.05, NAN if i == 3 else 0.1) for i in range(count)]
    report = fm.DetectionReport(fm.DetectionState.ACTIVE, "it is there", (), 0.2)
    idle = fm.DetectionReport(fm.DetectionState.IDLE, "", (), 0.2)
    key = ftm_topics.DETECTION.at("DM1")
    sent += [(0.2, key, encode(Header("DM1", 1, 1, 0.2), report)),
             (0.4, key, encode(Header("DM1", 1, 2, 0.4), idle)),
             (0.5, topics.POSE.at(), b"\xc1 is no msgpack"),
             (0.6, "rampart/no/such/topic", b"something")]
    return sorted(sent)


def write(path: Path, sent: list[Sent], *, close: bool = True, flush_every: int = 4) -> BagWriter:
    writer = BagWriter(path.open("wb"), documents(), views=documents().known.views(),
                       from_start=True)
    for number, one in enumerate(sent):
        writer.take(*one)
        if number % flush_every == 0:
            writer.flush()
    if close:
        writer.close()
    return writer


def foreign(path: Path, sent: Iterable[tuple[str, str, int, bytes]], profile: str = "",
            **settings: Any) -> Path:
    """Write a file of another tool: topic, encoding, time in ns and data of each message."""
    with path.open("wb") as file:
        writer, channels = Writer(file, **settings), {}
        writer.start(profile, "others")
        for topic, encoding, at_ns, data in sent:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding, 0)
            writer.add_message(channels[topic], at_ns, data, at_ns)
        writer.finish()
    return path


@contextlib.contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Let no file of this process become larger than some bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextlib.contextmanager
def running(recorder: Recorder, *, is_told: bool = True) -> Iterator[None]:
    """Run a recorder that is open in a thread; it is told that the run has ended, or sees that."""
    read_end, write_end = os.pipe()
    thread = threading.Thread(target=recorder.run, args=(read_end,))
    thread.start()
    try:
        yield
    finally:
        if is_told:
            os.write(write_end, bytes([RUN_ENDED]))
        thread.join(20)
        os.close(read_end)
        os.close(write_end)


def pid_of(program: str, port: int) -> int | None:
    """Return the pid of the recorder or black box of the run on a port; None if there is none."""
    title = f"rampart-{program}[{port}/".encode()
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdecimal() and (entry / "cmdline").read_bytes().startswith(title):
                return int(entry.name)
    return None


class AnsweringLauncher:
    """Tells recorders and tools that there is a run on a port; a context manager."""

    def __init__(self, port: int, origin_s: float, pid: int | None = None) -> None:
        self.info = run_info.RunInfo(
            pid or os.getpid(), port, 1.0, origin_s, PLAN["system_file"],
            "", ("localization", "DM1"), "sample", 0, "a sample", "", PLAN)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> AnsweringLauncher:
        self._socket.bind(run_info.address(self.info.base_port))
        self._socket.listen(8)
        self._socket.settimeout(0.1)
        self._going = True
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._going = False
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        while self._going:
            try:
                connection, _ = self._socket.accept()
            except TimeoutError:
                continue
            with connection, contextlib.suppress(BrokenPipeError):  # the client was killed
                connection.send(msgspec.json.encode(self.info))
