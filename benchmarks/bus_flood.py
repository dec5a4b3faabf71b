"""Does a member that floods the bus keep the robot from braking?

Runs a mission of the paper's system in real time. Again and again the GPS receiver is made to say
that the robot is on the grass: DM1 reports, and RM1 brakes. Measured is the time from the report to
the brake, by the stamps of the two messages. First without a flood, then with 40,000 messages a
second from one member of the bus, of each of these kinds:

* `garbage`: bytes that are no message, on DM1's own key, which the manager hears;
* `reports`: well-formed reports of a detection module that does not exist;
* `questions`: for the newest report of every detection module, as a newcomer asks once;
* `names`: orders to inject of 26,000 unknown nodes in turn, which every node hears.

The bound is the spec's `arbitration_s`. Example: `python -m benchmarks.bus_flood --brakes 40`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import find_runs
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.cli.session import Session, connect

ROOT = Path(__file__).resolve().parents[1]
PORT = 8680
KINDS = ("garbage", "reports", "questions", "names")
PER_S = 40_000
_POINT = load_airport("vallombre").prohibited_polygon().representative_point()
_GRASS = (_POINT.x, _POINT.y)

JOIN = """
import sys, time, zenoh
from rampart.actors.bus.zenoh_session import open_session
from rampart.actors.bus.run_info import find_runs
from rampart.cli.session import tools_credentials
def join():
    run = next(run for run in find_runs() if run.base_port == int(sys.argv[-1]))
    return open_session(run.endpoints, tools_credentials(run)[0])
"""
"""How a program becomes a member of the run whose base port is its last argument; with the key that
`RAMPART_KEY` names, if the run has keys."""

FLOOD = JOIN + """
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm, topics as ftm_topics
from rampart.actors.bus.envelope import Header, encode
from rampart.actors.bus.messages import Injection
kind, per_s, seconds, own = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
order = Injection("i", "no/topic", "drop", 1.0)
report = fm.DetectionReport(fm.DetectionState.IDLE, "", (), 0.0)
def message(i):
    if kind == "garbage":
        return ftm_topics.DETECTION.at(own or "DM1"), b"\\xff" * 200
    if kind == "reports":
        name = own or "DM99"
        return ftm_topics.DETECTION.at(name), encode(Header(name, 1, i, 0.0), report)
    name = f"stranger{i % 26_000}" if kind == "names" else "stranger"
    return bus_topics.INJECT.at(), encode(Header(name, 1, i, 0.0), order)
def ask():
    session.get(ftm_topics.DETECTION.pattern, lambda reply: None, timeout=0.1)
with join() as session:
    time.sleep(1)
    print("here", flush=True)
    publishers, begun, sent = {}, time.monotonic(), 0
    while (passed := time.monotonic() - begun) < seconds:
        due = int(passed * per_s)
        while sent < due:
            sent += 1
            if kind == "questions":
                ask()
                continue
            key, payload = message(sent)
            if key not in publishers:
                publishers[key] = session.declare_publisher(
                    key, congestion_control=zenoh.CongestionControl.DROP, express=True)
            publishers[key].put(payload)
        time.sleep(0.001)
    print(sent / (time.monotonic() - begun), flush=True)
"""


class Watch:
    """Hears when DM1 reports and when RM1 brakes, by their own stamps."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.reported_s: float | None = None
        self.braked_s: float | None = None
        self._released = 0
        session.listen(ftm_topics.DETECTION, self._report, ftm_topics.DETECTION.at("DM1"))
        session.listen(topics.BRAKE, self._brake)

    def _report(self, _key: str, header: Header, body: fm.DetectionReport) -> None:
        if header.source == "DM1" and body.state is fm.DetectionState.ACTIVE \
                and self.reported_s is None:
            self.reported_s = header.stamp

    def _brake(self, _key: str, header: Header, body: m.BrakeCommand) -> None:
        if header.source != "RM1":
            return
        self._released = 0 if body.engaged else self._released + 1
        if body.engaged and self.braked_s is None:
            self.braked_s = header.stamp

    async def once(self, number: int) -> float | None:
        """Make the receiver lie once; seconds to the brake, None if it did not come."""
        self.reported_s = self.braked_s = None
        clock = self._session.clock
        lie = bm.Injection(f"{self._session.name}-{number}", topics.GPS.key, "corrupt", 0.5,
                          set_fields={"x_m": _GRASS[0], "y_m": _GRASS[1]})
        await self._session.command(
            bus_topics.INJECT, lie, lambda: self.reported_s is not None, 3.0)
        deadline_s = clock.now() + 3.0
        while self.braked_s is None and clock.now() < deadline_s:  # noqa: ASYNC110 or never
            await asyncio.sleep(0.01)
        found = (None if self.reported_s is None or self.braked_s is None
                 else self.braked_s - self.reported_s)
        await asyncio.sleep(0.8)
        return found

    async def release(self) -> None:
        """Have the operator release the brake, until RM1 has said several times that it is."""
        self._released = 0
        while self._released < 3:
            if not self._released:
                self._session.publish(ftm_topics.RESET, fm.Reset("RM1", "benchmark"))
            await asyncio.sleep(0.1)


@contextlib.contextmanager
def running() -> Iterator[None]:
    """Have a mission run meanwhile."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "launch.py"), "--system", "paper", "--no-hmi", "--port",
             str(PORT), "--report", folder, "--patience", "100000"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield
        finally:
            process.terminate()
            process.wait()


async def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return one row of milliseconds for each kind of flood, the first without one."""
    while not any(run.base_port == PORT for run in find_runs()):  # noqa: ASYNC110 a process starts
        await asyncio.sleep(0.1)
    rows = []
    async with connect(PORT) as session:
        watch, numbers = Watch(session), itertools.count()
        await asyncio.sleep(max(0.0, 3.0 - session.clock.now()))
        for kind in ("none", *(options.kind or KINDS)):
            flood = None
            if kind != "none":
                flood = await asyncio.create_subprocess_exec(
                    sys.executable, "-c", FLOOD, kind, str(options.per_s), "100000",
                    "", str(PORT), cwd=ROOT)
                await asyncio.sleep(3.0)
            samples = []
            for _ in range(options.brakes):
                samples.append(await watch.once(next(numbers)))
                await asyncio.wait_for(watch.release(), 30.0)
            if flood is not None:
                flood.terminate()
                await flood.wait()
                await asyncio.sleep(2.0)
            found = sorted(1e3 * s for s in samples if s is not None)
            row = {"flood": kind, "brakes": len(found), "missing": len(samples) - len(found)}
            if found:
                row |= {"median_ms": round(statistics.median(found), 1),
                        "p95_ms": round(found[min(len(found) - 1, int(0.95 * len(found)))], 1),
                        "max_ms": round(found[-1], 1)}
            rows.append(row)
            if not options.json:
                print(" ".join(f"{k}={v}" for k, v in row.items()), flush=True)
    return rows


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.bus_flood", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--brakes", type=int, default=20, help="brakes for each kind (default: 20)")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this one (repeatable)")
    parser.add_argument("--per-s", type=int, default=PER_S, help=f"messages (default: {PER_S})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    with running():
        rows = asyncio.run(measure(options))
    if options.json:
        print(json.dumps(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
