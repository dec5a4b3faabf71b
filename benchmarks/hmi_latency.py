"""How long from a state on the bus to the pixel, and what does the operator's page cost?

Runs mission AB of the shipped system in real time, opens the page in a headless Chromium, and
measures, with `--seconds` for each stage:

* the controller without any page: what the HMI takes of a core, and the intervals between the
  commands that Osmosis Control publishes;
* one page: the time from its opening to the first map; the latency, from the stamp of a pose (the
  moment at which the sensors saw it, so localization is in it) and from its arrival on the bus in
  this process, to the begin of the animation frame *after* the one in which it was drawn; again
  processor share and intervals;
* ten pages: that one and nine more connections that read and answer like a page but draw nothing,
  since nine more browsers on this machine would be what is measured.

Clocks: poses are stamped on the machine's monotonic clock, the browser reads the wall clock; the
offset is taken before and after. Example: `python -m benchmarks.hmi_latency --seconds 15`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import websockets

from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.machine.process_usage import read_count
from rampart.actors.osmosis import topics
from rampart.actors.supervision.process_title import find_processes
from rampart.cli.session import Session, connect
from tests.actors.operator.browser import CHROMIUM, Browser, browser

ROOT = Path(__file__).resolve().parents[1]

PORT, PAGE_PORT = 8460, 8560
PAGES = 10

_WATCH = """
window.drawn = [];
const soon = (call) => requestAnimationFrame(() => requestAnimationFrame(call));
new MutationObserver((_, watch) => {
  const map = document.getElementById("map");
  if (!map || !map.querySelector(".light")) return;
  watch.disconnect();
  soon(() => { window.firstMap = performance.now(); });
  new MutationObserver(() => {
    const t = Number(map.dataset.t);
    requestAnimationFrame(() => window.drawn.push([t, performance.timeOrigin + performance.now()]));
  }).observe(map, { attributeFilter: ["data-t"] });
}).observe(document, { childList: true, subtree: true });
"""


class Stage(msgspec.Struct):
    """What was measured with a number of pages open."""

    pages: int
    hmi_percent: float
    command_intervals_ms: dict[str, float]


class Heard:
    """What this process hears on the bus: arrivals of poses, stamps of commands."""

    def __init__(self, session: Session) -> None:
        self.arrivals: dict[float, float] = {}
        self.commands: list[float] = []
        session.listen(topics.POSE, topics.POSE.at(), self._pose)
        session.listen(topics.COMMAND, topics.COMMAND.at(), self._command)

    def _pose(self, _key: str, header: Any, _body: Any) -> None:
        self.arrivals[round(header.stamp, 4)] = time.monotonic()

    def _command(self, _key: str, header: Any, _body: Any) -> None:
        self.commands.append(header.stamp)


def spread(values_ms: list[float]) -> dict[str, float]:
    """Return count, median, 95th and 99th percentile and maximum, in milliseconds."""
    if len(values_ms) < 2:
        return {"n": len(values_ms)}
    cuts = statistics.quantiles(values_ms, n=100, method="inclusive")
    return {"n": len(values_ms), "median": round(cuts[49], 1), "p95": round(cuts[94], 1),
            "p99": round(cuts[98], 1), "max": round(max(values_ms), 1)}


def hmi_cpu_s() -> float:
    """Return the processor time of the HMI's process so far."""
    pid = next(p.pid for p in find_processes(PORT) if "hmi" in p.names)
    count = read_count(pid)
    assert count is not None
    return count.cpu_s


async def stage(pages: int, heard: Heard, seconds: float) -> Stage:
    """Measure for a while."""
    heard.commands.clear()
    start, cpu_s = time.monotonic(), hmi_cpu_s()
    await asyncio.sleep(seconds)
    percent = 100 * (hmi_cpu_s() - cpu_s) / (time.monotonic() - start)
    gaps = [1000 * (b - a) for a, b in zip(heard.commands, heard.commands[1:], strict=False)]
    return Stage(pages, round(percent, 1), spread(gaps))


async def read_like_a_page() -> None:
    """Read all that is pushed and say that it was drawn."""
    async with websockets.connect(f"ws://127.0.0.1:{PAGE_PORT}/ws", max_size=None) as page:
        async for text in page:
            message = json.loads(text)
            if message["type"] == "state":
                await page.send(f'{{"type":"seen","version":{message["version"]}}}')


def latencies(drawn: list[list[float]], heard: Heard, run: RunInfo,
              wall_minus_monotonic_s: float) -> dict[str, dict[str, float]]:
    """Return what lies between a pose and its pixels."""
    from_stamp, from_bus = [], []
    for stamp, shown_ms in drawn:
        shown_s = shown_ms / 1000 - wall_minus_monotonic_s
        from_stamp.append(1000 * (shown_s - (run.origin_s + stamp / run.rate)))
        arrived_s = heard.arrivals.get(stamp)
        if arrived_s is not None:
            from_bus.append(1000 * (shown_s - arrived_s))
    return {"from_stamp_ms": spread(from_stamp), "from_bus_ms": spread(from_bus)}


async def open_page(tab: Browser) -> float:
    """Open the page and return milliseconds to the first map."""
    await tab.call("Page.enable")
    await tab.call("Page.addScriptToEvaluateOnNewDocument", source=_WATCH)
    await tab.show(f"http://127.0.0.1:{PAGE_PORT}/")
    await tab.until("window.firstMap !== undefined")
    return round(float(await tab.value("window.firstMap")), 1)


@contextlib.contextmanager
def running() -> Iterator[RunInfo]:
    """Run a mission until the block ends."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "launch.py"), "--json", "--port", str(PORT),
             "--hmi-port", str(PAGE_PORT), "--report", folder],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            for _ in range(600):
                found = [run for run in find_runs() if run.base_port == PORT]
                if found and time.monotonic() > found[0].origin_s + 2:
                    break
                time.sleep(0.1)
            yield found[0]
        finally:
            process.terminate()
            process.wait()


async def measure(seconds: float) -> dict[str, Any]:
    """Do all stages and return the figures."""
    async with connect(PORT) as session:
        run = session.run
        heard = Heard(session)
        stages = [await stage(0, heard, seconds)]
        async with browser() as tab:
            offset_s = time.time() - time.monotonic()
            first_map_ms = await open_page(tab)
            await asyncio.sleep(1)
            await tab.value("window.drawn.length = 0")
            stages.append(await stage(1, heard, seconds))
            shown = latencies(await tab.value("window.drawn"), heard, run, offset_s)
            again_ms = await open_page(tab)
            readers = [asyncio.create_task(read_like_a_page()) for _ in range(PAGES - 1)]
            await asyncio.sleep(1)
            await tab.value("window.drawn.length = 0")
            stages.append(await stage(PAGES, heard, seconds))
            shown_10 = latencies(await tab.value("window.drawn"), heard, run, offset_s)
            for reader in readers:
                reader.cancel()
            await asyncio.gather(*readers, return_exceptions=True)
        moved_ms = 1000 * abs(time.time() - time.monotonic() - offset_s)
        return {"first_map_ms": first_map_ms, "first_map_again_ms": again_ms,
                "latency_one_page": shown, "latency_ten_pages": shown_10,
                "stages": [msgspec.structs.asdict(s) for s in stages],
                "clock_moved_ms": round(moved_ms, 2), "load": os.getloadavg()[0],
                "cores": os.cpu_count()}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="for each stage (default: 15)")
    options = parser.parse_args()
    if CHROMIUM is None:
        print("hmi_latency: no Chromium on this machine", file=sys.stderr)
        return 1
    with running():
        print(json.dumps(asyncio.run(measure(options.seconds)), indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
