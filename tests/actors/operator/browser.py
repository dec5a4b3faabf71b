"""A headless Chromium driven over its DevTools protocol: enough to look at the operator's page."""

from __future__ import annotations

import asyncio
import atexit
import base64
import contextlib
import functools
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


SHORT = ("var $ = (css) => document.querySelector(css);"
         "var $$ = (css) => [...document.querySelectorAll(css)];")
"""Short names for scripts of tests: the first element of a selector, and all."""


class Browser:
    """One tab, or Chromium; `errors`: what the page complained of, `requests`: what it loaded."""

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
        await self.call("Page.addScriptToEvaluateOnNewDocument", source=SHORT)
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


@functools.cache
def _started() -> Path:
    """Start Chromium once for all tabs of this process, and return its folder.

    It ends with this process, however that ends: the kernel kills it.
    """
    folder = tempfile.mkdtemp()
    process = subprocess.Popen(
        ["setpriv", "--pdeathsig", "KILL", CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu",
         "--no-first-run", "--disable-background-networking", "--remote-debugging-port=0",
         f"--user-data-dir={folder}", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    atexit.register(process.wait)
    atexit.register(process.kill)
    return Path(folder)


@contextlib.asynccontextmanager
async def browser() -> AsyncIterator[Browser]:
    """Open a tab with its own cookies and storage in Chromium, and close it afterwards."""
    assert CHROMIUM is not None
    address = await _debug_address(_started() / "DevToolsActivePort")
    root = address.partition("/devtools/")[0]
    async with _connected(address) as chromium:
        context = await chromium.call("Target.createBrowserContext", disposeOnDetach=True)
        target = await chromium.call("Target.createTarget", url="about:blank", **context)
        async with _connected(f"{root}/devtools/page/{target['targetId']}") as tab:
            yield tab
        await chromium.call("Target.disposeBrowserContext", **context)


@contextlib.asynccontextmanager
async def _connected(address: str) -> AsyncIterator[Browser]:
    async with websockets.connect(address, max_size=None, ping_interval=None) as connection:
        opened = Browser(connection)
        try:
            yield opened
        finally:
            opened.close()


async def _debug_address(file: Path) -> str:
    for _ in range(400):
        if file.exists() and len(lines := file.read_text().split()) == 2:
            return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        await asyncio.sleep(0.05)
    raise AssertionError("Chromium did not start")
