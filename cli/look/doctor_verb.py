"""`rampart doctor`: the requirements of a run, and the consequence of each missing one."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import re
import resource
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import msgspec

from rampart.actors.supervision.root import needed_of
from rampart.cli.output import print_rows
from rampart.cli.verbs import JSON, add_verb

PROCESSES = 40
"""Processes of the largest shipped system."""

LEAST_PYTHON = (3, 11)
NEEDED_MB = 600
"""Proportional memory of the largest shipped system, with a margin."""

EXTRAS = {
    "keys": ("cryptography", "no run with --keys"),
    "ros2": ("rosbags", "no gateway to ROS 2"),
    "foxglove": ("foxglove", "no `rampart live foxglove`"),
    "prometheus": ("prometheus_client", "no `rampart live metrics`"),
    "export": ("pyarrow", "no `rampart bag export --to parquet`"),
    "video": ("imageio_ffmpeg", "no `rampart replay --video`")}
"""Extra → its module, and the consequence if it is not installed."""

State = Literal["ok", "without", "missing"]
_SHOWN: dict[State, str] = {"ok": "ok", "without": "-", "missing": "NO"}


class Finding(msgspec.Struct, frozen=True):
    """One requirement of a run.

    Attributes:
        what: name of the requirement.
        state: *ok*; *without*: a run is possible, with `cost`; *missing*: no run is possible.
        found: version or value on this machine.
        cost: consequence if it is missing, else "".
    """

    what: str
    state: State
    found: str
    cost: str = ""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "doctor", "check whether this machine can run a system", doctor, JSON)


def doctor(options: argparse.Namespace) -> int:
    """Check the machine.

    Check the requirements of a run on this machine: Python, kernel, processors,
    memory, limits, libraries, Chromium, ROS 2. List the consequence of each
    missing one.

    Examples:
      rampart doctor
      rampart doctor --json

    exit code: 0 a run can start, 1 none can
    """
    findings = list(look())
    print_rows(("", "what", "found", "without it"), [
        (_SHOWN[finding.state], finding.what, finding.found, finding.cost)
        for finding in findings], findings, as_json=options.json)
    return 1 if any(finding.state == "missing" for finding in findings) else 0


def _finding(what: str, found: str, *, there: bool, cost: str, needed: bool = False) -> Finding:
    return Finding(what, "ok" if there else "missing" if needed else "without", found,
                   "" if there else cost)


def look() -> Iterator[Finding]:
    """Check interpreter, kernel, processors, memory, folder, limits, libraries and programs."""
    yield _finding("Python", platform.python_version(), there=sys.version_info >= LEAST_PYTHON,
                   cost=f"nothing runs; {'.'.join(map(str, LEAST_PYTHON))} or later", needed=True)
    is_linux, release = sys.platform == "linux", platform.release()
    version = tuple(int(part) for part in release.split("-")[0].split(".")[:2] if part.isdigit())
    yield _finding("Linux", f"{platform.system()} {release}", there=is_linux and version >= (5, 9),
                   cost="no run on real processes; --virtual works", needed=True)
    count, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    yield _finding("processors", f"{count}, load {load:.1f}", there=count >= 2 and load < count,
                   cost="other programs and too few processors make messages late, and the robot "
                        "stops: end them, or use --virtual, or --rate 0.5 for a simulated robot")
    meminfo = Path("/proc/meminfo").read_text(encoding="ascii")
    free_mb = int(re.findall(r"MemAvailable:\s+(\d+) kB", meminfo)[0]) / 1e3
    yield _finding("memory", f"{free_mb:,.0f} MB available", there=free_mb >= NEEDED_MB,
                   cost=f"the full system takes {NEEDED_MB} MB")
    place = Path(os.environ.get("XDG_RUNTIME_DIR") or "/dev/shm")  # noqa: S108 only checked
    room_mb = shutil.disk_usage(place).free / 1e6 if os.access(place, os.W_OK) else 0.0
    yield _finding("folder of a run", f"{place}, {room_mb:,.0f} MB to write", there=room_mb > 10,
                   cost="no run starts", needed=True)
    _, files = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = needed_of(resource.RLIMIT_NOFILE, PROCESSES)
    yield _finding("open files", f"hard limit {files}", there=files >= needed, needed=True,
                   cost=f"the full system needs {needed}: ulimit -Hn {needed}")
    _, nice = resource.getrlimit(resource.RLIMIT_NICE)
    may = os.geteuid() == 0 or nice >= 30
    yield _finding("niceness -10", "permitted" if may else "not permitted", there=may,
                   cost="a busy machine slows the simulated world, not the controller alone: "
                        "ulimit -e 30")
    for extra, (module, cost) in EXTRAS.items():
        there = importlib.util.find_spec(module) is not None
        yield _finding(f"extra {extra}", module if there else "not installed", there=there,
                       cost=cost)
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    yield _finding("Chromium", chromium or "not found", there=chromium is not None,
                   cost="tests of the operator's page are skipped")
    distribution = os.environ.get("ROS_DISTRO", "")
    yield _finding("ROS 2", distribution or "not sourced", there=bool(distribution),
                   cost="only `rampart ros2 check` compares with an installation")
