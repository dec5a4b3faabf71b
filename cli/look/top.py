"""The screen of `rampart top`. Colours only repeat the words."""

from __future__ import annotations

import argparse
import asyncio
import math
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rampart.actors.bus import run_info
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.cli.output import print_json, say
from rampart.cli.robot_lines import Row
from rampart.cli.run_picture import RunPicture, Watch, manager_in_words
from rampart.cli.session import LOOK_S, connect, is_over, pause, stopped_by_signals
from rampart.cli.terminal import END, keys
from rampart.files.plain_text import printable
from rampart.manager.strategies.registry import decision_in_words

_ONCE_S = 2.0
"""Simulated seconds in which all states arrive, and the slowest rates can be measured."""

_DECISIONS = 3
_LABEL, _PROCESSES = 9, 55
"""Widths of a label, and of the table of processes."""

_BESIDE = 80
"""Least width of a screen that has the rates of topics beside the processes."""


class Frame(NamedTuple):
    """The data of one screen.

    Attributes:
        title: title of the run.
        port: base port of the run.
        rate: simulated seconds per second.
        time_s: simulated time.
        picture: messages of the run.
        usage: by process name: `cpu` percent of a core, `mb` resident, `age_s` real seconds.
        guards: rows of processes that are not in the supervisor's table.
        recording: state of the recording; "" without one.
    """

    title: str
    port: int
    rate: float
    time_s: float
    picture: RunPicture
    usage: Mapping[str, Mapping[str, float]] = {}
    guards: Sequence[Mapping[str, Any]] = ()
    recording: str = ""


async def top(options: argparse.Namespace) -> int:
    """Show the run."""
    stop = asyncio.Event()
    live = not (options.once or options.json) and sys.stdout.isatty()
    with stopped_by_signals(stop):
        async with connect(options.port) as session:
            watch = Watch(session)
            if not live:
                return await _once(watch, options, stop)
            await _live(watch, stop)
            if not stop.is_set():
                say(f"the run has ended: {session.run.title} (port {session.run.base_port})")
    return 0


def frame_of(watch: Watch) -> Frame:
    """Take a sample, and return the data of one screen."""
    run, now_s, used = watch.session.run, watch.look(), watch.used
    run = run_info.ask(run.base_port) or run
    return Frame(run.title, run.base_port, run.rate, now_s, watch.picture, used["nodes"],
                 used["guards"], run.recording_in_words)


async def _once(watch: Watch, options: argparse.Namespace, stop: asyncio.Event) -> int:
    frame = frame_of(watch)
    for _ in range(math.ceil(watch.session.real_s(_ONCE_S) / LOOK_S)):
        await pause(stop, LOOK_S)
        frame = frame_of(watch)
    if options.json:
        print_json(picture_json(frame))
        return 0
    columns, _ = shutil.get_terminal_size((100, 60))
    Console(width=columns).print(screen(frame, columns))
    return 0


async def _live(watch: Watch, stop: asyncio.Event) -> None:
    """Show a run until it ends or the user quits."""
    console = Console()
    with keys(lambda key: stop.set() if key in {"q", "Q", END} else None), Live(
            console=console, screen=True, auto_refresh=False) as live:
        while not stop.is_set() and not is_over(watch.session.run):
            live.update(screen(frame_of(watch), console.width), refresh=True)
            await pause(stop, LOOK_S)


def picture_json(frame: Frame) -> dict[str, Any]:
    """Return the data of `--json`."""
    picture = frame.picture
    return {
        "title": frame.title, "port": frame.port, "rate": frame.rate,
        "time_s": round(frame.time_s, 3), **picture.lines.data(picture.latest),
        "manager": picture.latest(ftm_topics.MANAGER_STATUS),
        "detections": dict(sorted(picture.detections.items())),
        "recoveries": dict(sorted(picture.recoveries.items())),
        "decisions": [{"time_s": stamp_s, "decision": record.decision, "words": _words(record)}
                      for stamp_s, record in picture.decisions],
        "processes": [{**row, **frame.usage.get(row["name"], {})} for row in _processes(frame)],
        "rates_hz": picture.rates()}


def screen(frame: Frame, width: int) -> Group:
    """Return the screen: the state in lines, then processes and, if it is wide, rates."""
    title = (f" rampart top  {printable(frame.title)}  port {frame.port}  {frame.time_s:.1f} s "
             f"x{frame.rate:g} ")
    state = Table.grid(padding=(0, 1), expand=True)
    state.add_column(width=_LABEL)
    state.add_column(ratio=1, no_wrap=True, overflow="ellipsis")
    for label, text, style in _state(frame):
        state.add_row(Text(label, "bold"), Text(printable(text), style))
    table = _table("process", "state", "life", "again", "age", "cpu", "MB")
    for row in _processes(frame):
        used = frame.usage.get(row["name"])
        trouble = row["state"] != fm.NodeState.RUNNING
        table.add_row(
            printable(row["name"]), str(row["state"]), str(row["incarnation"]),
            str(row["restarts"]), *((_age(used["age_s"]), f"{used['cpu']:.0f}%",
                                     f"{used['mb']:.0f}") if used else "---"),
            style="bold red" if trouble else "")
    body = Table.grid(padding=(0, 2), expand=True)
    body.add_column(width=min(_PROCESSES, width))
    body.add_column(ratio=1)
    if width >= _BESIDE:
        rates = _table("topic", "Hz")
        for key, hz in frame.picture.rates().items():
            if hz > 0:
                rates.add_row(printable(key.replace("{name}", "*")), f"{hz:.1f}")
        body.add_row(table, rates)
    else:
        body.add_row(table)
    return Group(Text(title, "reverse", no_wrap=True, overflow="ellipsis"), state, body)


def _table(*heads: str) -> Table:
    """Return a table whose first column takes the room that the others, of numbers, leave."""
    table = Table(box=None, padding=(0, 1, 0, 0), header_style="bold underline", expand=True)
    for number, head in enumerate(heads):
        table.add_column(head, no_wrap=True, overflow="ellipsis", ratio=None if number else 1,
                         justify="right" if number else "left")
    return table


def _state(frame: Frame) -> Iterator[tuple[str, str, str]]:
    """Yield label, text and style of each line."""
    picture = frame.picture
    manager: fm.ManagerStatus | None = picture.latest(ftm_topics.MANAGER_STATUS)
    busy = manager is not None and (manager.active or manager.activated)
    for label, text, style, topic in (
            *picture.lines.rows(picture.latest),
            Row("manager", manager_in_words(manager), "yellow" if busy else "",
                ftm_topics.MANAGER_STATUS)):
        silent_s = picture.silence_s(topic, frame.time_s) if topic else 0.0
        silent = f"SILENT for {silent_s:.0f} s; last: " if silent_s else ""
        yield label, silent + text, "bold yellow" if silent else style
    yield "detection", *_detections(picture)
    if frame.recording:
        yield "recording", frame.recording, ""
    for number, (stamp_s, record) in enumerate(list(picture.decisions)[:-_DECISIONS - 1:-1]):
        yield ("" if number else "decisions",
               f"{stamp_s:.1f} s  {record.decision}: {_words(record)}", "")


def _detections(picture: RunPicture) -> tuple[str, str]:
    found = sorted(picture.detections.items())
    manager: fm.ManagerStatus | None = picture.latest(ftm_topics.MANAGER_STATUS)
    silent = manager.silent if manager else ()
    active = [f"{name} silent" for name in silent]
    active += [f"{name} {report.reason}" for name, report in found
               if report.state is fm.DetectionState.ACTIVE and name not in silent]
    if active:
        modules = len({*silent, *picture.detections})
        return f"{len(active)} of {modules}: {'; '.join(active)}", "yellow"
    return (f"none of {len(found)} modules detects anything" if found else "no report", "")


def _words(record: fm.DecisionRecord) -> str:
    return decision_in_words(record.active, record.rule, record.recoveries, record.strategy)


def _processes(frame: Frame) -> list[Mapping[str, Any]]:
    """Return a row for each process, first those that do not run."""
    table: fm.NodeTable | None = frame.picture.latest(ftm_topics.NODES)
    rows: list[Mapping[str, Any]] = [*map(_row, table.nodes if table else ()), *frame.guards]
    return sorted(rows, key=lambda row: bool(row["state"] == fm.NodeState.RUNNING))


def _row(node: fm.NodeInfo) -> dict[str, Any]:
    """Return the shown fields of a node."""
    row = msgspec.structs.asdict(node)
    # These are in the metrics and the status.
    for counted in ("heard_s", "rejected_payloads", "overflowed", "next_attempt_s"):
        del row[counted]
    return row


def _age(seconds: float) -> str:
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    if hours >= 100:
        return f"{hours // 24}d"
    return f"{hours}h{minute:02}m" if hours else f"{minute}:{second:02}"
