"""A headless Chromium driven over its DevTools protocol: enough to look at the operator's page."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import websockets

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which(
    "google-chrome")


class Browser:
    """One tab. `errors` collects what the page complained about, `requests` what it asked for."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._ids = itertools.count(1)
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._reader = asyncio.ensure_future(self._read())

    async def _read(self) -> None:
        async for text in self._connection:
            message = json.loads(text)
            if "id" in message:
                self._answers.pop(message["id"]).set_result(message)
            elif message["method"] == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(message["params"]["exceptionDetails"])[:500])
            elif message["method"] == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            elif message["method"] == "Network.webSocketCreated":
                self.requests.append(message["params"]["url"])
            elif message["method"] == "Log.entryAdded":
                self.errors.append(message["params"]["entry"]["text"])

    async def call(self, method: str, **parameters: Any) -> Any:
        number = next(self._ids)
        self._answers[number] = asyncio.get_running_loop().create_future()
        await self._connection.send(
            json.dumps({"id": number, "method": method, "params": parameters}))
        answer = await asyncio.wait_for(self._answers[number], 15)
        assert "error" not in answer, answer
        return answer["result"]

    async def show(self, url: str, width: int = 1500, height: int = 1060,
                   scheme: str = "light", motion: str = "no-preference") -> None:
        await self.call("Emulation.setDeviceMetricsOverride", width=width, height=height,
                        deviceScaleFactor=1, mobile=width < 500)
        await self.call("Emulation.setEmulatedMedia", features=[
            {"name": "prefers-color-scheme", "value": scheme},
            {"name": "prefers-reduced-motion", "value": motion}])
        await self.call("Page.bringToFront")  # keys go to a tab only while it has the focus
        await self.call("Emulation.setFocusEmulationEnabled", enabled=True)
        await self.call("Page.enable")
        await self.call("Runtime.enable")
        await self.call("Log.enable")
        await self.call("Network.enable")
        await self.call("Page.navigate", url=url)

    async def value(self, expression: str) -> Any:
        found = await self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return found["result"].get("value")

    async def until(self, expression: str, timeout_s: float = 20.0) -> None:
        deadline = asyncio.get_running_loop().time() + timeout_s
        while await self.value(expression) is not True:
            assert asyncio.get_running_loop().time() < deadline, (expression, self.errors)
            await asyncio.sleep(0.05)

    async def screenshot(self, path: str | Path, *, whole: bool = False) -> None:
        shot = await self.call("Page.captureScreenshot", captureBeyondViewport=whole)
        Path(path).write_bytes(base64.b64decode(shot["data"]))

    def close(self) -> None:
        self._reader.cancel()


async def mouse(tab: Browser, kind: str, x: float, y: float) -> None:
    """Have the left button pressed, moved or released at a point of the page."""
    await tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1,
                   clickCount=1)


@contextlib.asynccontextmanager
async def browser() -> AsyncIterator[Browser]:
    """Start Chromium, open a tab, and end everything afterwards."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
             "--disable-background-networking", "--remote-debugging-port=0",
             f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            address = await _debug_address(Path(folder) / "DevToolsActivePort")
            async with websockets.connect(address, max_size=None) as first:
                await first.send(json.dumps({"id": 1, "method": "Target.getTargets"}))
                targets = json.loads(await first.recv())["result"]["targetInfos"]
            page = next(t["targetId"] for t in targets if t["type"] == "page")
            root = address.partition("/devtools/")[0]
            async with websockets.connect(f"{root}/devtools/page/{page}", max_size=None) as tab:
                opened = Browser(tab)
                try:
                    yield opened
                finally:
                    opened.close()
        finally:
            process.kill()
            await asyncio.to_thread(process.wait)


async def _debug_address(file: Path) -> str:
    for _ in range(400):
        if file.exists() and len(lines := file.read_text().split()) == 2:
            return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        await asyncio.sleep(0.05)
    raise AssertionError("Chromium did not start")
