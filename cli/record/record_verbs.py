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
import asyncio
import contextlib
import fnmatch
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.run_info import find_run
from rampart.actors.bus.topic import ROOT
from rampart.actors.recording.bag_reader import BagReader, Summary, repair, time_zero_s
from rampart.actors.recording.bag_writer import BagError, check_target
from rampart.actors.recording.process import result_of, stop_pipe
from rampart.actors.recording.recorder import Recorder
from rampart.cli.following import stopped_by_signals
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    between,
    positive,
    print_json,
    print_table,
    progress,
    say,
)
from rampart.cli.record.export import Export
from rampart.cli.record.film import FRAMES_HZ, Stage, Viewer, film
from rampart.cli.record.replaying import DEFAULT_PORT, RecordedRun, Replay
from rampart.cli.session import tools_credentials
from rampart.cli.verbs import (
    JSON,
    PORT,
    add_family,
    add_verb,
    flag,
    number,
    option,
    whole,
    word,
)
from rampart.files.plain_text import one_line

_PORTS = (1024, 65535)

_TOPICS: dict[str, Any] = {"metavar": "GLOB", "nargs": "+", "action": "extend", "default": []}

PLAYING = (
    number("--rate", "R", "simulated seconds per second (default: 1)", 1.0),
    option("--topics", **_TOPICS, help="play only keys that match a pattern"),
    number("--start", "S", "start at simulated second S of the run"),
    whole("--hmi-port", "PORT", "serve the operator's page on this port of 127.0.0.1", 0),
    flag("--viewer", "show the robot in MuJoCo's viewer"),
    word("--video", "FILE.mp4", "write a video of the robot in MuJoCo instead of playing; "
         "needs the extra `video`"),
    whole("--port", "N", f"base port of the replay (default: {DEFAULT_PORT})", DEFAULT_PORT))
"""Options of a replay."""


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    add_verb(verbs, "record", "record the run", record, PORT,
             option("file", metavar="FILE", nargs="?",
                    help="MCAP file (default: rampart-TIME.mcap)"),
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
             option("--topics", **_TOPICS, help="write only channels that match a pattern"), JSON)


def record(options: argparse.Namespace) -> int:
    """Record a run.

    Record all messages of a run from now until Ctrl-C, the end of the run, or
    --duration. `rampart run --record FILE` records from the first message on.
    The robot never waits for the recorder.

    Examples:
      rampart record
      rampart record crash.mcap --duration 60
    """
    positive("--duration", options.duration, below=1e9)
    run = find_run(options.port)
    path = Path(options.file or time.strftime("rampart-%Y%m%d-%H%M%S.mcap"))
    check_target(path, overwrite=options.overwrite)
    credentials = tools_credentials(run)[0] if run.hosts else None
    recorder = Recorder(run.base_port, path, overwrite=options.overwrite,
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


async def replay(options: argparse.Namespace) -> int:
    """Play a recording back.

    Play back a recording on a separate bus. Tools such as `rampart topic echo` and
    `rampart status` find it like a run; use --port if a robot runs, too. Orders
    are refused, and no message of the recording reaches a robot.
    A robot with a model in MuJoCo is shown in its viewer, or filmed without a bus:
    --rate is the simulated seconds per second of the video.

    Examples:
      rampart replay run.mcap --hmi-port 8090
      rampart replay run.mcap --viewer
      rampart replay run.mcap --video run.mp4 --rate 4
      rampart replay run.mcap --rate 4 --start 60 --topics 'manager/*'
    """
    _check(options)
    stop = asyncio.Event()
    with stopped_by_signals(stop):
        path = Path(options.file)
        known = Summary(BagReader(path)).keys if options.topics else ()
        chosen: dict[str, Any] = {"start_s": options.start,
                                  "wants": matcher(options.topics, known)}
        if options.video:
            return await _film(RecordedRun(path, **chosen), options, stop)
        player = Replay(path, port=options.port, rate=options.rate, hmi_port=options.hmi_port,
                        report=say, **chosen)
        if player.summary.reader.damage:
            say(f"{options.file}: damaged ({player.summary.reader.damage}); playing the rest")
        with contextlib.ExitStack() as stack:
            if options.viewer:
                viewer = stack.enter_context(contextlib.closing(Viewer(Stage(player))))
                player.viewer = viewer.take
            page = f", page http://127.0.0.1:{options.hmi_port}/" if options.hmi_port else ""
            say(f"playing {options.file} on port {options.port} at rate {options.rate:g}{page}; "
                "ctrl-C ends it")
            await player.run(stop)
    refused = f", {player.refused} of another version left out" if player.refused else ""
    say(f"played {player.played} messages{refused}")
    if not player.played:
        raise NoEffectError("no message was played")
    return 0


async def _film(run: RecordedRun, options: argparse.Namespace, stop: asyncio.Event) -> int:
    """Write a video of a recording, and return the exit code."""
    frames = 0
    with progress() as show, contextlib.closing(
            film(run, Path(options.video), options.rate)) as written:
        for at_s in written:
            frames += 1
            show(f"{options.video}: {at_s:.1f} s of simulated time")
            await asyncio.sleep(0)
            if stop.is_set():
                raise NoEffectError(f"{options.video}: interrupted, not written")
    say(f"{options.video}: {frames} frames, {frames / FRAMES_HZ:.1f} s")
    return 0


def matcher(globs: list[str], known: Iterable[str]) -> Callable[[str], bool]:
    """Return a filter of full keys for the patterns of --topics; without patterns all pass.

    Raises:
        UsageError: a pattern matches no known key.
    """
    keys = [key.removeprefix(f"{ROOT}/") for key in known]
    patterns = [g.removeprefix("/").removeprefix(f"{ROOT}/") for g in globs]
    for pattern in patterns:
        if not any(fnmatch.fnmatchcase(key, pattern) for key in keys):
            families = sorted({key.split("/")[0] for key in keys})
            raise UsageError(f"--topics {pattern}: matches no topic; known: "
                             f"{', '.join(f'{name}/…' for name in families)} "
                             "(`rampart topic list`, `rampart bag info`)")
    if not patterns:
        return lambda _key: True
    return lambda key: any(
        fnmatch.fnmatchcase(key.removeprefix(f"{ROOT}/"), pattern) for pattern in patterns)




def _check(options: argparse.Namespace) -> None:
    between("--rate", options.rate, 0.01, 1000)
    if options.start is not None and not -1e9 < options.start < 1e9:
        raise UsageError(f"--start {options.start:g}: must be a time of the run in seconds")
    if options.video and (options.viewer or options.hmi_port):
        raise UsageError(f"--video {options.video}: plays nothing; not with --viewer or --hmi-port")
    between("--port", options.port, *_PORTS)
    between("--hmi-port", options.hmi_port or _PORTS[0], *_PORTS)
    if options.hmi_port == options.port:
        raise UsageError(f"--hmi-port {options.hmi_port}: is the replay's own --port; choose "
                         "another --hmi-port")


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
