"""A recording as tables for spreadsheets and pandas: one file per topic, one row per message.

The first column is `time_s`: simulated seconds, or wall-clock seconds in files of other tools. The
others are the fields of the message, with dots if nested: `body.x_m`. A list is JSON in a cell.
Parquet, by the extra `export`, has the same tables.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.recording.bag_reader import BagReader, key_of, time_zero_s
from rampart.actors.recording.bag_writer import BagError, complete
from rampart.cli.verbs import extra

Row = dict[str, Any]


class Export:
    """Writes the tables of one recording. Use: `write`, once.

    Args:
        reader: reader of the recording.
        wants: whether a channel is exported; None exports the topics of a recording without its
            views, and all channels of other files.

    Attributes:
        counts: number of messages by topic.
        left_out: topic → number of omitted messages, and the first reason.
    """

    def __init__(self, reader: BagReader, wants: Callable[[str], bool] | None = None) -> None:
        self.counts = Counter[str]()
        self.left_out: dict[str, tuple[int, str]] = {}
        self._reader = reader
        self._wants = wants

    def write(self, folder: Path, kind: str) -> None:
        """Write the tables into a new folder, or no folder.

        Args:
            folder: must not exist.
            kind: `csv` or `parquet`.

        Raises:
            BagError: the folder exists or cannot be written, or the recording cannot be read.
            UsageError: the extra is not installed.
        """
        convert = _to_parquet() if kind == "parquet" else None
        if folder.exists():
            raise BagError(f"{folder}: exists already; choose another name")
        with complete(folder):
            folder.mkdir()
            for path in self._write_csv(folder):
                if convert:
                    convert(path)
                    path.unlink()

    def _write_csv(self, folder: Path) -> list[Path]:
        columns: dict[str, Row] = {}
        for topic, row in self._rows():
            columns.setdefault(topic, {}).update(dict.fromkeys(row))
        paths = _paths(folder, columns)
        with ExitStack() as files:
            tables = {
                topic: csv.DictWriter(files.enter_context(
                    path.open("w", newline="", encoding="utf-8")), list(columns[topic]))
                for topic, path in paths.items()}
            for table in tables.values():
                table.writeheader()
            for topic, row in self._rows():
                tables[topic].writerow({
                    name: msgspec.json.encode(value).decode() if isinstance(value, list) else value
                    for name, value in row.items()})
                self.counts[topic] += 1
        return list(paths.values())

    def _rows(self) -> Iterator[tuple[str, Row]]:
        """Yield topic and row of each message."""
        self.left_out.clear()
        zero_s: float | None = None
        for channel, message in self._reader.messages():
            if zero_s is None:
                zero_s = time_zero_s(self._reader)
            is_wanted = (self._wants(channel.topic) if self._wants else
                         key_of(channel) is not None or not self._reader.is_recording)
            if not is_wanted:
                continue
            if channel.message_encoding != "json":
                self._leave_out(channel.topic, f"encoding {channel.message_encoding!r}, not JSON")
                continue
            try:
                fields = msgspec.json.decode(message.data)
            except (ValueError, RecursionError) as error:
                self._leave_out(channel.topic, str(error))
                continue
            yield channel.topic, {"time_s": message.log_time / 1e9 + zero_s, **_flat("", fields)}

    def _leave_out(self, topic: str, why: str) -> None:
        count, first = self.left_out.get(topic, (0, why))
        self.left_out[topic] = count + 1, first


def _to_parquet() -> Callable[[Path], None]:
    """Return a function that writes a CSV file's table beside it."""
    tables = extra("export", "pyarrow.csv")
    parquet = extra("export", "pyarrow.parquet")

    def convert(path: Path) -> None:
        parquet.write_table(tables.read_csv(path), path.with_suffix(".parquet"))

    return convert


def _flat(name: str, value: Any) -> Row:
    """Return the fields of a value by their path."""
    if not isinstance(value, dict):
        return {name or "value": value}
    return {path: one for key, part in value.items()
            for path, one in _flat(f"{name}.{key}".lstrip("."), part).items()}


def _paths(folder: Path, topics: Any) -> dict[str, Path]:
    """Return a different file for each topic, such as `localization-pose.csv`."""
    paths: dict[str, Path] = {}
    for topic in topics:
        name = stem = re.sub(r"[^A-Za-z0-9_]+", "-", topic).strip("-")[:200] or "topic"
        number = 2
        while (path := folder / f"{name}.csv") in paths.values():
            name, number = f"{stem}-{number}", number + 1
        paths[topic] = path
    return paths
