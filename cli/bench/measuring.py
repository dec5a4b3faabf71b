"""One run of the benchmark: what was chosen is checked, measured part by part, and written."""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from rampart import systems
from rampart.cli import systems as systems_of_tools
from rampart.cli.bench import floors, killing, page, restart, size
from rampart.cli.bench.figures import PARTS, SIZES, Figures, Machine
from rampart.cli.bench.peers import KEEPERS
from rampart.cli.bench.programs import BenchError
from rampart.cli.output import (
    FORMAT,
    UsageError,
    between,
    print_json,
    print_table,
    progress,
    refusing,
    say,
    unknown,
    warn,
)
from rampart.cli.verbs import extra
from rampart.sim.runs.report import write_atomically

MOST_KILLS, MOST_PROCESSES = 1000, 500
_OF_NODES = ["restart", "keys"]
_DIGITS, _PATH_BYTES = 5, 40


def bench(options: argparse.Namespace) -> int:
    """Measure what the options say, and return the exit code.

    Raises:
        UsageError: they make no sense.
    """
    parts = [part for part in PARTS if part in (options.only or PARTS)]
    keepers, sizes, file, nodes = _checked(options, parts)
    kills, out = options.kills, _folder(options.out)
    figures = Figures(version("rampart"), time.strftime("%Y-%m-%d %H:%M %Z"),
                      shlex.join(["rampart", *sys.argv[1:]]), machine())
    failed = False
    with _interruptible(), _folder_for_sockets() as folder, progress() as show:
        measure: dict[str, Callable[[], Any]] = {
            "peers": lambda: killing.measure_peers(
                keepers, kills, Path(options.peers_in), folder, show),
            "floors": lambda: floors.measure_floors(kills, folder, show, figures.peers or ()),
            "restart": lambda: restart.measure_restart(file, nodes, kills, folder, show),
            "size": lambda: size.measure_size(sizes, kills, folder, show),
            "keys": lambda: _of_keys().measure_keys(file, nodes, kills, folder, show)}
        for part in parts:
            try:
                rows = measure[part]()
            except BenchError as error:
                warn(f"{part}: {error}")
                failed = True
                continue
            figures = msgspec.structs.replace(figures, **{part: rows})
            failed = failed or any(row.note for row in rows)
            show("")
            if not options.json:
                _tell(next(each for each in page.sections(figures) if each.name == part))
    _write(figures, out)
    if options.json:
        print_json(figures)
    else:
        say(f"page: {out / 'bench.html'}; figures: {out / 'bench.json'}")
    return 1 if failed else 0


def _of_keys() -> Any:
    """Return the part of that name.

    Raises:
        BenchError: the extra that it needs is not installed.
    """
    try:
        extra("keys", "cryptography")
    except UsageError as error:
        raise BenchError(str(error)) from None
    from rampart.cli.bench import keys  # noqa: PLC0415 of the extra

    return keys


def _checked(options: argparse.Namespace, parts: Sequence[str]
             ) -> tuple[list[str], list[int], Path, list[str]]:
    """Return keepers, sizes, system and its nodes, as they were chosen.

    Raises:
        UsageError: one of them cannot be, or is no business of the parts.
    """
    between("--kills", options.kills, 1, MOST_KILLS)
    for name, value, of in (("peer", options.peer, ["peers"]), ("node", options.node, _OF_NODES),
                            ("system", options.system, _OF_NODES)):
        if value and not set(of) & set(parts):
            raise UsageError(f"--{name}: only with the part {' or '.join(of)}; leave out --only, "
                             f"or say --only {of[0]}")
    for name in options.peer:
        if name not in KEEPERS:
            raise unknown("peer", name, KEEPERS)
    sizes = []
    for text in options.sizes.split(","):
        if not (text.isascii() and text.isdecimal() and len(text) < _DIGITS):
            raise UsageError(f"--sizes {options.sizes}: {text!r} is no number of processes; whole "
                             f"numbers with commas between are right, as {SIZES}")
        between("--sizes", int(text), size.LEAST, MOST_PROCESSES)
        sizes.append(int(text))
    file = systems.find(options.system) if options.system else systems.DEFAULT
    nodes: list[str] = []
    if set(_OF_NODES) & set(parts):
        systems_of_tools.load(options.system)
        with refusing(ValueError):
            members = restart.members_of(file)
        for name in options.node:
            if name not in members:
                raise unknown("node", name, members)
        nodes = options.node or restart.usual(members)
    return list(dict.fromkeys(options.peer)) or list(KEEPERS), sizes, file.resolve(), nodes


def _folder(text: str) -> Path:
    """Return the folder for what is written, made if need be.

    Raises:
        UsageError: there can be none.
    """
    folder = Path(text)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UsageError(f"--out {folder}: no directory that can be written "
                         f"({error.strerror})") from None
    return folder


def _tell(section: page.Section) -> None:
    say(section.title)
    print_table(section.head, section.rows)
    say()


def _write(figures: Figures, folder: Path) -> None:
    write_atomically(folder / "bench.json", msgspec.json.format(
        msgspec.json.encode({"format": FORMAT, **msgspec.to_builtins(figures)}), indent=2))
    write_atomically(folder / "bench.html", page.html(figures).encode())
    for section in page.sections(figures):
        if section.plot:
            write_atomically(folder / f"{section.name}.svg",
                             page.svg(section.plot, alone=True).encode())


def machine() -> Machine:
    """Return where this runs, in general words."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return Machine(
        len(os.sched_getaffinity(0)), round(pages / 2**30),
        f"{platform.system()} on {platform.machine()}", f"Python {platform.python_version()}",
        version("eclipse-zenoh"), round(os.getloadavg()[0], 2))


@contextlib.contextmanager
def _folder_for_sockets() -> Iterator[Path]:
    """Give a folder whose path leaves room for the name of a unix socket; it goes at the end."""
    place = tempfile.gettempdir()
    with tempfile.TemporaryDirectory(
            prefix="rampart-bench-", dir=place if len(place) < _PATH_BYTES else "/tmp",  # noqa: S108
            ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Have the first signal that ends a program end all that was started; further ones wait."""
    ends = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def interrupt(_number: int, _frame: object) -> None:
        for number in ends:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ends
              if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
