"""How long does an operator wait while strangers flood the page?

Runs mission AB of the shipped system in real time, once with the page open to this user alone, once
with a token, so that other users of this machine are let in as far as the files of the page. One
page stays connected and sends its stick 20 times a second; every half second somebody with the
token loads the page anew and opens its WebSocket. Measured without a flood, then, `--seconds` each,
with

* `idle`: 500 connections that say nothing, made anew as they are closed;
* `connect`: connections that make one request and are closed, one after the other, four at a time;
* `requests`: forty connections that ask for the page again and again;
* `handshakes`: WebSockets with a wrong token, as fast as they are refused.

The flood is another process, the user nobody's if this one is root's (and as busy as it can be: it
has a core's worth of whatever the machine has left). Example: `python -m benchmarks.hmi_flood`.
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

import httpx
import websockets

from rampart.actors.bus.run_info import find_runs
from rampart.actors.machine.process_usage import read_count
from rampart.actors.supervision.process_title import find_processes

ROOT = Path(__file__).resolve().parents[1]
PORT, PAGE_PORT = 8660, 8760
AT = f"127.0.0.1:{PAGE_PORT}"
TOKEN = "only-for-this-benchmark"
BEARER = {"Authorization": f"Bearer {TOKEN}"}

_FLOOD = """
import asyncio, contextlib, encodings.idna, os, sys
kind, host, port, user = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
if os.getuid() == 0:
    os.setgroups([]), os.setgid(user), os.setuid(user)
head = f"Host: {host}:{port}\\r\\n"
get = f"GET / HTTP/1.1\\r\\n{head}\\r\\n".encode()
shake = (f"GET /ws HTTP/1.1\\r\\n{head}Upgrade: websocket\\r\\nConnection: Upgrade\\r\\n"
         "Sec-WebSocket-Version: 13\\r\\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\\r\\n\\r\\n"
         ).encode()
async def one():
    reader, writer = await asyncio.open_connection(host, port)
    try:
        if kind == "idle":
            await reader.read()
        elif kind == "connect":
            writer.write(get)
            await reader.read(100)
        elif kind == "requests":
            while not reader.at_eof():
                writer.write(get)
                await reader.read(65536)
        else:
            writer.write(shake)
            await reader.read(1000)
    finally:
        writer.close()
async def again():
    while True:
        with contextlib.suppress(OSError):
            await one()
async def main():
    count = {"idle": 500, "connect": 4, "requests": 40, "handshakes": 4}[kind]
    await asyncio.gather(*(again() for _ in range(count)))
asyncio.run(main())
"""
KINDS = ("", "idle", "connect", "requests", "handshakes")


@contextlib.contextmanager
def running(token: str) -> Iterator[None]:
    """Run a mission until the block ends."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "launch.py"), "--json", "--port", str(PORT),
             "--hmi-port", str(PAGE_PORT), "--report", folder],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env={**os.environ, "RAMPART_HMI_TOKEN": token})
        try:
            for _ in range(600):
                found = [run for run in find_runs() if run.base_port == PORT]
                if found and time.monotonic() > found[0].origin_s + 2:
                    break
                time.sleep(0.1)
            yield
        finally:
            process.terminate()
            process.wait()


@contextlib.contextmanager
def flooded(kind: str) -> Iterator[None]:
    """Flood the page until the block ends."""
    if not kind:
        yield
        return
    flood = subprocess.Popen([sys.executable, "-c", _FLOOD, kind, "127.0.0.1", str(PAGE_PORT),
                              "65534"], stderr=subprocess.DEVNULL)
    try:
        time.sleep(1)
        yield
    finally:
        flood.kill()
        flood.wait()


def hmi_usage() -> tuple[int, float]:
    """Return the HMI's process, 0 if it is away, and the processor time that it has used, s."""
    pid = max((p.pid for p in find_processes(PORT) if "hmi" in p.names), default=0)
    count = read_count(pid) if pid else None
    return pid, count.cpu_s if count else 0.0


async def stick(until_s: float, waits: list[float], failed: list[str]) -> None:
    """Send a stick 20 times a second and note how long each answer takes, in milliseconds."""
    while time.monotonic() < until_s:
        try:
            async with websockets.connect(f"ws://{AT}/ws", additional_headers=BEARER) as page:
                while (sent := time.monotonic()) < until_s:
                    await page.send('{"type":"stick","panel":"Drive","held":false}')
                    while json.loads(await page.recv())["type"] != "stick":
                        pass
                    waits.append(1000 * (time.monotonic() - sent))
                    await asyncio.sleep(max(0.0, 0.05 - (time.monotonic() - sent)))
        except (OSError, websockets.WebSocketException) as error:
            failed.append(f"driver: {type(error).__name__}")


async def newcomers(until_s: float, waits: list[float], failed: list[str]) -> None:
    """Load the page and open its WebSocket, and note how long that takes, in milliseconds."""
    while time.monotonic() < until_s:
        began = time.monotonic()
        try:
            async with httpx.AsyncClient(timeout=10) as client:
                (await client.get(f"http://{AT}/")).raise_for_status()
            async with websockets.connect(f"ws://{AT}/ws", additional_headers=BEARER) as page:
                await page.recv()
        except (httpx.HTTPError, OSError, websockets.WebSocketException) as error:
            failed.append(type(error).__name__)
        waits.append(1000 * (time.monotonic() - began))
        await asyncio.sleep(max(0.0, 0.5 - (time.monotonic() - began)))


async def stage(kind: str, seconds: float) -> str:
    """Measure under one kind of flood and return a row."""
    answers: list[float] = []
    opened: list[float] = []
    failed: list[str] = []
    with flooded(kind):
        until_s = time.monotonic() + seconds
        before = hmi_usage()
        await asyncio.gather(stick(until_s, answers, failed), newcomers(until_s, opened, failed))
        after = hmi_usage()
    used = (f"{100 * (after[1] - before[1]) / seconds:.0f}" if before[0] == after[0]
            else "killed and back")
    return (f"| {kind or 'none'} | {_spread(answers)} | {_spread(opened)} "
            f"| {len(failed)} of {len(opened)} {' '.join(sorted(set(failed)))}| {used} |")


def _spread(values: list[float]) -> str:
    values.sort()
    return (f"{statistics.median(values):.0f} / {values[int(len(values) * 0.95)]:.0f} / "
            f"{values[-1]:.0f}")


def main() -> int:
    """Run all stages and print two tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="for each stage (default: 8)")
    options = parser.parse_args()
    for token in ("", TOKEN):
        print(f"\n{'with' if token else 'without'} a token, load {os.getloadavg()[0]:.1f}")
        print("| flood | stick's answer, ms: median / p95 / max | page and WebSocket, ms | failed "
              "| HMI, percent of a core |")
        with running(token):
            for kind in KINDS:
                print(asyncio.run(stage(kind, options.seconds)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
