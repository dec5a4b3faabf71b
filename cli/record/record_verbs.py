"""`rampart record`, `rampart replay` and `rampart bag`: recordings.

Inspect recordings: MCAP files of `rampart run --record`, of `rampart record`, or
of other programs.

Examples:
  rampart bag info run.mcap
  rampart bag repair torn.mcap whole.mcap
  rampart bag export run.mcap --to parquet
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.run_info import RunInfo, find_run
from rampart.actors.recording.bag_reader import BagReader, Summary, repair, time_zero_s
from rampart.actors.recording.bag_writer import BagError, check_target
from rampart.actors.recording.process import result_of, stop_pipe
from rampart.actors.recording.recorder import Recorder
from rampart.actors.system.topics import system_topics
from rampart.cli import systems
from rampart.cli.output import (
    NoEffectError,
    positive,
    print_json,
    print_table,
    say,
)
from rampart.cli.record.export import Export
from rampart.cli.record.replaying import PLAYING, TOPICS, matcher, replay
from rampart.cli.session import tools_credentials
from rampart.cli.verbs import (
    JSON,
    PORT,
    add_family,
    add_verb,
    flag,
    number,
    option,
)
from rampart.files.plain_text import one_line


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    add_verb(verbs, "record", "record the run", record, PORT,
             option("file", metavar="FILE", nargs="?",
                    help="MCAP file (default: rampart-TIME.mcap)"),
             option("--topics", **TOPICS, help="record only keys that match a pattern"),
             number("--duration", "S", "end after S real seconds"),
             flag("--overwrite", "replace FILE if it exists"))
    add_verb(verbs, "replay", "play back a recording", replay,
             option("file", metavar="FILE", help="MCAP file"),
             *PLAYING)
    bag = add_family(verbs, "bag", "inspect a recording; needs no run", __doc__)
    add_verb(bag, "info", "show run, duration, channels and damage", bag_info,
             option("file", metavar="FILE", help="MCAP file"), JSON)
    add_verb(bag, "repair", "copy the readable part into a new file", bag_repair,
             option("file", metavar="IN", help="MCAP file"),
             option("out", metavar="OUT", help="new file"),
             flag("--overwrite", "replace OUT if it exists"))
    add_verb(bag, "export", "write tables in CSV or Parquet", bag_export,
             option("file", metavar="IN", help="MCAP file"),
             option("out", metavar="FOLDER", nargs="?",
                    help="new folder (default: IN without its suffix)"),
             option("--to", choices=("csv", "parquet"), default="csv",
                    help="format (default: csv)"),
             option("--topics", **TOPICS, help="write only channels that match a pattern"), JSON)


def record(options: argparse.Namespace) -> int:
    """Record a run.

    Record all messages of a run from now until Ctrl-C, the end of the run, or
    --duration. `rampart run --record FILE` records from the first message on.
    The robot never waits for the recorder.

    Examples:
      rampart record
      rampart record crash.mcap --duration 60
      rampart record poses.mcap --topics 'localization/*' 'detection/*'
    """
    positive("--duration", options.duration, below=1e9)
    run = find_run(options.port)
    wants = matcher(options.topics, _keys(run) if options.topics else ())
    path = Path(options.file or time.strftime("rampart-%Y%m%d-%H%M%S.mcap"))
    check_target(path, overwrite=options.overwrite)
    credentials = tools_credentials(run)[0] if run.hosts else None
    recorder = Recorder(run.base_port, path, overwrite=options.overwrite, wants=wants,
                        credentials=lambda _run: credentials)
    recorder.open()
    stop = stop_pipe()
    say(f"recording {run.title} in {path}; ctrl-C ends it")
    try:
        why = recorder.run(stop, options.duration)
    except (BagError, ValueError, OSError) as error:
        raise NoEffectError(str(error)) from None
    say(f"{result_of(recorder)}; it ends because {why}")
    if recorder.writer is None or not recorder.writer.messages:
        raise NoEffectError("no message arrived")
    return 0


def _keys(run: RunInfo) -> list[str]:
    """Return all full keys of a run's system."""
    return [key for topic in system_topics(systems.load(run.system_file))
            for key in ([topic.at(n) for n in run.nodes] if topic.is_family else [topic.at()])]


def bag_info(options: argparse.Namespace) -> int:
    """Print what is in a file.

    Show size, run and duration, and each channel with its messages and rate. An
    incomplete file is read as far as possible.

    Examples:
      rampart bag info run.mcap
      rampart bag info run.mcap --json

    exit code: 0 all was read, 1 a part cannot be read, 2 bad usage
    """
    summary = Summary(BagReader(Path(options.file)))
    if options.json:
        print_json(described(summary))
    else:
        for name, text in _lines(summary):
            say(f"{name:<11}{one_line(text)}")
        say()
        print_table(("channel", "schema", "messages", "rate"), [
            (one_line(row["channel"]), one_line(row["schema"]), row["messages"],
             f"{row['rate_hz']:.2f} Hz" if row["rate_hz"] is not None else "")
            for row in summary.table()])
    return 1 if summary.reader.gaps else 0


def _lines(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield name and text of each line about a file."""
    reader, run = summary.reader, summary.run
    yield "file", f"{reader.path}, {reader.size_bytes / 1e6:.1f} MB, {reader.library}"
    duration = f"{summary.duration_s:.1f} s"
    if reader.is_recording:
        yield "run", (f"{run.get('title', '')} ({run.get('run_id', '')}), rate "
                      f"{run.get('rate', '')}, rampart {run.get('rampart_version', '')}")
        yield "began", run.get("started") or "in virtual time"
        first_s = (summary.first_ns or 0) / 1e9 + summary.time_zero_s
        duration += f", from {first_s:.1f} s of simulated time"
    else:
        profile = f", profile {reader.profile!r}" if reader.profile else ""
        yield "run", f"none: not a recording of a run{profile}"
    yield "duration", duration
    yield "messages", f"{summary.messages} on {len(reader.channels)} channels"
    losses = _losses(summary)
    yield "lost", "unknown" if losses is None else (
        ", ".join(f"{count} of {name}" for name, count in losses.items()) or "none")
    if not reader.closed:
        closing = "no: its writer was interrupted"
    elif reader.damage:
        closing = "yes"
    else:
        closing = f"properly, because {summary.end.get('ended', 'its writer had finished')}"
    yield "closed", closing + (f"; damaged: {reader.damage}" if reader.damage else "")
    for line in left_behind(reader):
        yield "gone", line
    if summary.files:
        yield "attached", ", ".join(name for name, _, _ in summary.files)


def bag_repair(options: argparse.Namespace) -> int:
    """Write a whole file.

    Copy the readable part of an incomplete file into a new file with an index,
    which some viewers require. The old file is not changed.

    Examples:
      rampart bag repair torn.mcap whole.mcap

    exit code: 0 all was copied, 1 a part was lost, 2 bad usage
    """
    reader = BagReader(Path(options.file))
    copied = repair(reader, Path(options.out), overwrite=options.overwrite)
    lines = left_behind(reader)
    say(f"{options.out}: {copied} messages; left behind: "
        f"{one_line(', '.join(lines)) or 'nothing'}")
    return 1 if lines else 0


def bag_export(options: argparse.Namespace) -> int:
    """Write a recording as tables.

    Write one file per topic into a new folder, with one row per message. Format is
    CSV, or Parquet with the extra: pip install 'rampart-robot[export]'. The first
    column is simulated time; the others are the fields of the message, such as
    body.x_m. Channels for viewers (view/…) are written only with --topics.

    Examples:
      rampart bag export run.mcap
      rampart bag export run.mcap tables --to parquet --topics 'localization/*'

    exit code: 0 all was written, 1 a damaged part was left out, 2 bad usage
    """
    path = Path(options.file)
    folder = Path(options.out or path.with_suffix(""))
    reader = BagReader(path)
    wants = None
    if options.topics:
        wants = matcher(options.topics, [row["channel"] for row in Summary(reader).table()])
    done = Export(reader, wants)
    done.write(folder, options.to)
    return _copied(options, folder, done.counts, done.left_out, reader)


def _copied(options: argparse.Namespace, folder: Path, counts: Counter[str],
            left_out: Mapping[str, tuple[int, str]], reader: BagReader) -> int:
    """Report the written and the omitted messages, and return the exit code.

    Raises:
        NoEffectError: no message was written.
    """
    if not counts:
        shutil.rmtree(folder)
        raise NoEffectError(f"{options.file}: no message that could be written")
    left = {one_line(topic): {"times": times, "why": one_line(why)}
            for topic, (times, why) in left_out.items()}
    if options.json:
        print_json({"folder": str(folder), "messages": dict(counts), "left_out": left,
                    "gone": gone(reader)})
    else:
        say(f"{folder}: {counts.total()} messages on {len(counts)} topics")
        for topic, one in left.items():
            say(f"left out: {topic}: {one['why']} ({one['times']} times)")
        for line in left_behind(reader):
            say(f"gone: {one_line(line)}")
    return 1 if reader.gaps else 0


def described(summary: Summary) -> dict[str, Any]:
    """Return the data of `--json`."""
    reader = summary.reader
    return {
        "file": str(reader.path), "size_bytes": reader.size_bytes, "profile": reader.profile,
        "library": reader.library, "recording": reader.is_recording, "closed": reader.closed,
        "damage": reader.damage, "gone": gone(reader), "duration_s": round(summary.duration_s, 3),
        "messages": summary.messages, "time_zero_s": summary.time_zero_s, "run": summary.run,
        "end": summary.end, "lost": _losses(summary),
        "attachments": [name for name, _, _ in summary.files], "channels": summary.table()}


def gone(reader: BagReader) -> list[dict[str, Any]]:
    """Return the unreadable parts as plain data, with times in simulated seconds or null."""
    def seconds(at_ns: int | None) -> float | None:
        return None if at_ns is None else round(at_ns / 1e9 + time_zero_s(reader), 3)

    return [{"what": gap.what, "from_byte": gap.from_byte, "to_byte": gap.to_byte,
             "from_s": seconds(gap.from_ns), "to_s": seconds(gap.to_ns)} for gap in reader.gaps]


def left_behind(reader: BagReader) -> list[str]:
    """Return the unreadable parts in words."""
    return [f"bytes {gap['from_byte']} to {gap['to_byte']}" + (
        f", {gap['from_s']:.2f} to {gap['to_s']:.2f} s" if gap["from_s"] is not None else "")
        + f": {gap['what']}" for gap in gone(reader)]


def _losses(summary: Summary) -> dict[str, int] | None:
    """Return source → lost messages; None if the file has no count."""
    try:
        return msgspec.json.decode(summary.end.get("lost", ""), type=dict[str, int])
    except (ValueError, RecursionError):
        return None
