"""How long from the moment in which a node's event loop hangs to its detection?

Runs a system on real processes, hangs nodes in turn, and takes the time in this process until the
report of a detection module that names the node arrives. A node of any system hangs by SIGUSR2, as
`kill-node NODE --signal WEDGE` has it; those of the small one that is run by default, `fast` with
50 turns a second and `slow` with 20, in other ways as well. What else is detected is told, too.

    python -m benchmarks.hangs
    python -m benchmarks.hangs --how spin
    python -m benchmarks.hangs --system systems/osmosis.toml --node osmosis_control
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.hanging_loop import HANG, HOW, SYSTEM, Hang
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import DetectionReport, DetectionState
from rampart.actors.recovery.respawn import accused
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan
from rampart.actors.supervision.launcher import Launcher
from rampart.actors.supervision.process_title import find_processes
from rampart.files import working_folder

_BACK_S = 3.0
_LONGEST_S = 3.0


class Stopwatch(Actor):
    """Notes what is detected, with wall seconds of this process."""

    outputs = (HANG,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.found: list[tuple[float, str, DetectionReport]] = []
        self._named: dict[str, tuple[str, ...]] = {}

    @on(topics.DETECTION)
    def detection(self, report: DetectionReport, header: Header) -> None:
        """Note what becomes active, and whom it names anew."""
        if report.state is DetectionState.IDLE:
            self._named.pop(header.source, None)
        elif self._named.get(header.source) != report.nodes:
            self._named[header.source] = report.nodes
            self.found.append((time.monotonic(), header.source, report))


def _names(report: DetectionReport, node: str) -> bool:
    return any(accused(name)[0] == node for name in report.nodes)


async def _hang(watch: Stopwatch, port: int, node: str, how: str) -> tuple[float | None, str]:
    while not (found := [p for p in find_processes(port) if node in p.names]):  # noqa: ASYNC110
        await asyncio.sleep(0.1)  # it is being started
    victim = max(found, key=lambda p: p.incarnation)
    count, begun_s = len(watch.found), time.monotonic()
    if how:
        watch.publish(HANG, Hang(how), name=node)
    else:
        os.kill(victim.pid, signal.SIGUSR2)
    while time.monotonic() < begun_s + _LONGEST_S:
        for at_s, module, report in watch.found[count:]:
            if _names(report, node):
                return at_s - begun_s, f"{module}: {report.reason}"
        await asyncio.sleep(0.001)
    return None, "not detected"


async def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Run the system, hang the nodes, and return one row per node."""
    plan = RunPlan("bench", options.port, system_file=options.system)
    launcher = Launcher(plan, "benchmark")
    rows = []
    try:
        await launcher.load()
        await launcher.start()
        watch = Stopwatch(Context(OBSERVER, 1, Clock(launcher.plan.origin_s),
                                  launcher.observers_bus()))
        task = asyncio.create_task(watch.run())
        while watch.clock.now() < _BACK_S:  # noqa: ASYNC110 simulated time 0 is when all are loaded
            await asyncio.sleep(0.1)
        for node in options.node:
            took, how, begin = [], set(), len(watch.found)
            for _ in range(options.hangs):
                took_s, why = await _hang(watch, options.port, node, options.how)
                took.append(took_s)
                how.add(why)
                await asyncio.sleep(_BACK_S + random.uniform(0.0, 0.05))
            found = sorted(s * 1e3 for s in took if s is not None)
            rows.append({"node": node, "hangs": options.hangs, "detected": len(found),
                         "median_ms": round(statistics.median(found), 1) if found else None,
                         "p95_ms": round(found[int(0.95 * (len(found) - 1))], 1) if found else None,
                         "min_ms": round(found[0], 1) if found else None,
                         "max_ms": round(found[-1], 1) if found else None, "how": sorted(how),
                         "others": [f"{module}: {report.reason}" for _, module, report
                                    in watch.found[begin:] if not _names(report, node)]})
            if not options.json:
                print(rows[-1], flush=True)
        watch.stop()
        await task
    finally:
        await launcher.end()
    return rows


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--hangs", type=int, default=20, help="per node (default: 20)")
    parser.add_argument("--node", action="append", help="of the default system: fast, slow")
    parser.add_argument("--how", choices=HOW, default="", help="default: SIGUSR2")
    parser.add_argument("--system", default="")
    parser.add_argument("--port", type=int, default=7960)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if (options.system and not options.node) or (options.system and options.how):
        parser.error("--system: needs --node, and does not go with --how")
    with tempfile.TemporaryDirectory() as directory:
        own = Path(directory, "loops.toml")
        own.write_text(SYSTEM, encoding="utf-8")
        options.node = options.node or ["fast", "slow"]
        options.system = str(Path(options.system or own).resolve())
        working_folder.admit(Path(options.system).parent if options.system != str(own) else
                             Path(__file__).parent.parent)
        rows = asyncio.run(measure(options))
    if options.json:
        print(json.dumps(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
