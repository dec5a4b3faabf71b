"""Takes the pictures of the operator's page that README and docs show.

Run it with `python -m benchmarks.pictures [DIRECTORY]`; by default they go to
docs/images. A real run of mission AB in which one wheel gets weak, so that the robot goes on at
reduced speed, and Osmosis Control is killed. The film shows a kill of Localization before that.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from rampart.testing import RealRun
from tests import ROOT
from tests.actors.operator.browser import Browser, browser

PAGE_PORT = 8580
MOST_KB = 250
LIVE = "document.getElementById('link').textContent === 'live'"
RATE = 1.0
FAULT_S = 76.0
WIDE = (1500, 1290)
FILM_WIDTH = 1000
FILM_S = 9.0
BEFORE_S = 2.0
FRAME_S = 0.4


def size_kb(file: Path) -> float:
    """Return the size of a file."""
    return file.stat().st_size / 1000


async def shoot(tab: Browser, file: Path, *, whole: bool = False) -> None:
    """Take a picture; one that is large gets a palette, which the many colours of a photo need."""
    await tab.until(LIVE, 60)
    raw = file.with_suffix(".raw.png")
    await tab.screenshot(raw, whole=whole)
    image = Image.open(io.BytesIO(raw.read_bytes())).convert("RGB")
    raw.unlink()
    image.save(file, optimize=True)
    if size_kb(file) > MOST_KB:
        image.quantize(256, method=Image.Quantize.FASTOCTREE).save(file, optimize=True)
    print(f"{file}: {image.size[0]} x {image.size[1]}, {size_kb(file):.0f} kB")


async def film(tab: Browser, run: RealRun, victim: str, file: Path) -> None:
    """Film a node that is killed, and what follows; at most one frame each `FRAME_S`."""
    loop = asyncio.get_running_loop()
    begin_s, is_killed = loop.time(), False
    frames: list[Image.Image] = []
    times_s: list[float] = []
    raw = file.with_suffix(".raw.png")
    while (now_s := loop.time() - begin_s) < FILM_S:
        if now_s > BEFORE_S and not is_killed:
            await asyncio.to_thread(run.kill, victim)
            is_killed = True
        await tab.screenshot(raw)
        image = Image.open(io.BytesIO(raw.read_bytes())).convert("RGB")
        frames.append(image.resize((FILM_WIDTH, FILM_WIDTH * image.height // image.width)))
        times_s.append(now_s)
        await asyncio.sleep(max(0.0, begin_s + now_s + FRAME_S - loop.time()))
    raw.unlink()
    ends_s = [*times_s[1:], FILM_S]
    frames[0].save(file, save_all=True, append_images=frames[1:], loop=0, quality=70, method=6,
                   duration=[round(1000 * (end_s - time_s))
                             for time_s, end_s in zip(times_s, ends_s, strict=True)])
    print(f"{file}: {len(frames)} frames, {size_kb(file):.0f} kB")


async def look(tab: Browser, width: int, height: int, scheme: str) -> None:
    """Open the page."""
    await tab.show(f"http://127.0.0.1:{PAGE_PORT}/", width, height, scheme)
    await tab.call("Emulation.setScrollbarsHidden", hidden=True)
    await tab.until(LIVE)
    await tab.until("document.querySelectorAll('#nodes tr').length > 20")
    await asyncio.sleep(1.5)


async def take(run: RealRun, into: Path) -> None:
    """Take all pictures of a run."""
    async with browser() as tab:
        await asyncio.to_thread(run.sleep_until, 20.0)
        await look(tab, *WIDE, "dark")
        await film(tab, run, "localization", into / "kill-and-recovery.webp")
        await asyncio.to_thread(run.sleep_until, 58.0)
        await look(tab, *WIDE, "light")
        await shoot(tab, into / "hmi-desktop.png")
        await asyncio.to_thread(run.sleep_until, FAULT_S + 1)
        await asyncio.to_thread(run.kill, "osmosis_control")
        await look(tab, *WIDE, "dark")
        await tab.until("document.querySelectorAll('#order .running').length > 0")
        await tab.value("document.querySelector('#decisions details').open = true")
        await shoot(tab, into / "hmi-recovery.png", whole=True)
        await look(tab, 360, 740, "light")
        await shoot(tab, into / "hmi-phone.png")


def main() -> int:
    """Run, and take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, nargs="?", default=ROOT / "docs" / "images")
    into: Path = parser.parse_args().directory
    into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, RealRun(
            Path(folder), "osmosis", "--rate", f"{RATE:g}", "--hmi-port", str(PAGE_PORT),
            "--fault", f"weak-wheel@{FAULT_S:g}+60", hmi=True) as run:
        asyncio.run(take(run, into.resolve()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
