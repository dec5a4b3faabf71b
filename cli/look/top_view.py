"""The view of `rampart top`: a picture of the run in, lines of the terminal out. Pure.

Every line fits the width, and all lines fit the height. Colours only repeat the words.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
from rich.cells import cell_len, set_cell_size
from rich.text import Text

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.cli.robot_lines import Row
from rampart.cli.run_picture import RunPicture, manager_in_words
from rampart.files.plain_text import printable
from rampart.manager.strategies.registry import decision_in_words

_LABEL = 10
_PROCESS_WIDTH = 57
_RATES_WIDTH = 28
_LEAST_PROCESSES = 6


@dataclass(frozen=True, slots=True)
class Frame:
    """The data of one screen.

    Attributes:
        title: title of the run.
        port: base port of the run.
        rate: simulated seconds per second.
        time_s: simulated time.
        picture: messages of the run.
        usage: by process name: `cpu` percent of a core, `mb` resident, `age_s` real seconds.
        guards: rows of processes that are not in the supervisor's table.
        skip: number of processes scrolled away.
        by_cpu: whether the busiest process comes first.
        recording: state of the recording; "" without one.
    """

    title: str
    port: int
    rate: float
    time_s: float
    picture: RunPicture
    usage: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    guards: Sequence[Mapping[str, Any]] = ()
    skip: int = 0
    by_cpu: bool = False
    recording: str = ""


def lines(frame: Frame, width: int, height: int) -> list[Text]:
    """Return the screen, at most `height` lines of at most `width` cells."""
    head = [_title(frame, width), *_state(frame, width)]
    foot = Text("q quit, c sort by CPU, arrows scroll", style="dim")
    room = height - len(head) - 2  # a heading, and the last line
    head += _decisions(frame, min(3, max(0, room - _LEAST_PROCESSES)))
    body = _tables(frame, width, max(0, height - len(head) - 1))
    screen = [*[*head, *body][:max(0, height - 1)], foot]
    return [_fit(line, width) for line in screen[-max(height, 0):]] if height > 0 else []


def picture_json(frame: Frame) -> dict[str, Any]:
    """Return the same as data."""
    picture = frame.picture
    return {
        "title": frame.title, "port": frame.port, "rate": frame.rate,
        "time_s": round(frame.time_s, 3), **picture.lines.data(picture.latest),
        "manager": picture.latest(ftm_topics.MANAGER_STATUS),
        "detections": dict(sorted(picture.detections.items())),
        "recoveries": dict(sorted(picture.recoveries.items())),
        "decisions": [{"time_s": stamp_s, "decision": record.decision, "words": _words(record)}
                      for stamp_s, record in picture.decisions],
        "processes": [{**row, **frame.usage.get(row["name"], {})} for row in _rows(frame)],
        "rates_hz": picture.rates()}


def _fit(line: Text, width: int) -> Text:
    """Return a line cut to the width, with an ellipsis."""
    line.no_wrap = True
    line.truncate(width, overflow="ellipsis")
    return line


# -- the state, one line each -------------------------------------------------------------------


def _title(frame: Frame, width: int) -> Text:
    left = f" rampart top  {printable(frame.title)}"
    right = f"port {frame.port}  {frame.time_s:.1f} s x{frame.rate:g} "
    gap = max(2, width - cell_len(left) - cell_len(right))
    return Text(left + " " * gap + right, style="reverse")


def _state(frame: Frame, width: int) -> list[Text]:
    picture, now_s = frame.picture, frame.time_s
    manager: fm.ManagerStatus | None = picture.latest(ftm_topics.MANAGER_STATUS)
    busy = manager is not None and (manager.active or manager.activated)
    rows = [
        *picture.lines.rows(picture.latest, width),
        Row("manager", manager_in_words(manager), "yellow" if busy else "",
            ftm_topics.MANAGER_STATUS),
        Row("detection", *_detections(picture))]
    if frame.recording:
        rows.append(Row("recording", frame.recording))
    shown = []
    for label, text, style, topic in rows:
        line = Text(f"{label:<{_LABEL}}", style="bold")
        silent_s = picture.silence_s(topic, now_s) if topic else 0.0
        if silent_s:
            line.append(f"SILENT for {silent_s:.0f} s; last: ", style="bold yellow")
        shown.append(line.append(printable(text), style=style))
    return shown


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


def _decisions(frame: Frame, count: int) -> list[Text]:
    newest = list(frame.picture.decisions)[::-1][:count]
    return [Text(f"{'decisions' if not i else '':<{_LABEL}}", style="bold").append(
        printable(f"{stamp_s:.1f} s  {record.decision}: {_words(record)}"), style="not bold")
        for i, (stamp_s, record) in enumerate(newest)]


# -- the tables ---------------------------------------------------------------------------------


def _row(node: fm.NodeInfo) -> dict[str, Any]:
    """Return the shown fields of a node."""
    row = msgspec.structs.asdict(node)
    # These are in the metrics and the status.
    for counted in ("heard_s", "rejected_payloads", "overflowed", "next_attempt_s"):
        del row[counted]
    return row


def _rows(frame: Frame) -> list[Mapping[str, Any]]:
    """Return a row for each process: first those that do not run, then by processor time."""
    table: fm.NodeTable | None = frame.picture.latest(ftm_topics.NODES)
    rows: list[Mapping[str, Any]] = [
        *map(_row, table.nodes if table else ()), *frame.guards]

    def place(row: Mapping[str, Any]) -> tuple[bool, float]:
        busy = frame.usage.get(row["name"], {}).get("cpu", 0.0) if frame.by_cpu else 0.0
        return row["state"] == fm.NodeState.RUNNING, -busy

    return sorted(rows, key=place)


def _tables(frame: Frame, width: int, height: int) -> list[Text]:
    """Return processes and, on a wide screen, rates of topics beside them."""
    if height < 2:
        return []
    beside = width >= _PROCESS_WIDTH + 20
    left = _processes(frame, _PROCESS_WIDTH if beside else width, height)
    if not beside:
        return left
    right = _rates(frame, width - _PROCESS_WIDTH, height)
    blank = Text(" " * _PROCESS_WIDTH)
    return [Text.assemble(process or blank, rate or "")
            for process, rate in itertools.zip_longest(left, right)]


def _processes(frame: Frame, width: int, height: int) -> list[Text]:
    rows = _rows(frame)
    head = f"{'process':<18} {'state':<8} {'life':>4} {'again':>5} {'age':>6} {'cpu':>4} {'MB':>5}"
    shown = [Text(set_cell_size(head, width), style="bold underline")]
    room = height - 1
    skip = max(0, min(frame.skip, len(rows) - room))
    for row in rows[skip:skip + room]:
        used = frame.usage.get(row["name"])
        figures = (f"{_age(used['age_s']):>6} {used['cpu']:>3.0f}% {used['mb']:>5.0f}"
                   if used else f"{'-':>6} {'-':>4} {'-':>5}")
        name = set_cell_size(printable(row["name"]), 18)
        text = f"{name} {row['state']:<8} {row['incarnation']:>4} {row['restarts']:>5} {figures}"
        trouble = row["state"] != fm.NodeState.RUNNING
        shown.append(Text(set_cell_size(text, width), style="bold red" if trouble else ""))
    if not rows:
        shown.append(Text(set_cell_size("no table of the supervisor yet", width)))
    hidden = len(rows) - skip - room
    if hidden > 0 and room > 0:
        shown[-1] = Text(set_cell_size(f"... {hidden + 1} more below", width), style="dim")
    return shown


def _rates(frame: Frame, width: int, height: int) -> list[Text]:
    rates = [(key, hz) for key, hz in frame.picture.rates().items() if hz > 0]
    columns = max(1, width // _RATES_WIDTH)
    column = width // columns
    shown = [Text(set_cell_size("  topic" + "Hz".rjust(column - 7), width), style="bold underline")]
    per_column = min(height - 1, math.ceil(len(rates) / columns)) if rates else 0
    for i in range(per_column):
        shown.append(Text("".join(
            f"  {set_cell_size(_short(key, column - 8), column - 8)}{hz:>6.1f}"
            for key, hz in rates[i::per_column][:columns])))
    return shown


def _short(key: str, width: int) -> str:
    """Return a key that fits, cut at its beginning."""
    key = key.replace("{name}", "*")
    return key if len(key) <= width else "~" + key[-max(0, width - 1):]


def _age(seconds: float) -> str:
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    if hours >= 100:
        return f"{hours // 24}d"
    return f"{hours}h{minute:02}m" if hours else f"{minute}:{second:02}"
