"""`rampart record`, `rampart replay` and `rampart bag`: recordings, and how to mend a torn one.

Look at recordings: MCAP files of `launch.py --record`, `rampart record`, or
others.

Examples:
  rampart bag info run.mcap
  rampart bag repair torn.mcap whole.mcap
  rampart bag export run.mcap --to parquet
  rampart bag ros2 run.mcap run-ros2
"""

from __future__ import annotations

import argparse
import asyncio
import fnmatch
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.run_info import NoRunError, RunInfo, find_run
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.recording.bag_reader import BagReader, Summary, repair, time_zero_s
from rampart.actors.recording.bag_writer import BagError, check_target
from rampart.actors.recording.other_hosts import OtherHosts, others_of
from rampart.actors.recording.process import stop_pipe, told
from rampart.actors.recording.recorder import Recorder
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.cli import systems
from rampart.cli.following import stopped_by_signals
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    between,
    positive,
    print_json,
    print_table,
    refusing,
    say,
)
from rampart.cli.record.export import Export
from rampart.cli.record.replaying import DEFAULT_PORT, Replay
from rampart.cli.session import tools_credentials
from rampart.cli.verbs import (
    JSON,
    PORT,
    add_family,
    add_verb,
    extra,
    flag,
    number,
    option,
    whole,
)
from rampart.files import working_folder
from rampart.files.plain_text import one_line

_PORTS = (1024, 65535)


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    topics: dict[str, Any] = {"metavar": "GLOB", "nargs": "+", "action": "extend", "default": []}
    add_verb(verbs, "record", "record a run that is there", record, PORT,
             option("file", metavar="FILE", nargs="?",
                    help="MCAP file (default: rampart-TIME.mcap)"),
             option("--topics", **topics,
                    help="only keys that match one, as in `rampart topic list`"),
             number("--duration", "S", "end after S real seconds"),
             flag("--overwrite", "FILE may exist"))
    add_verb(verbs, "replay", "play a recording back", replay, option("file", metavar="FILE"),
             number("--rate", "R", "simulated seconds per second (default: 1)", 1.0),
             flag("--loop", "begin anew at the end; each lap is a later life of every node"),
             option("--topics", **topics, help="only keys that match one"),
             number("--start", "S", "begin at simulated second S of the run"),
             number("--delay", "S", "real seconds before the first message, for readers to come",
                    0.0),
             whole("--hmi-port", "PORT", "show the operator's page, on this port of loopback", 0),
             whole("--port", "N", f"Zenoh port of the replay (default: {DEFAULT_PORT})",
                   DEFAULT_PORT))
    bag = add_family(verbs, "bag", "what is in a recording (needs no run)", __doc__)
    add_verb(bag, "info", "duration, run, channels, whether it is whole", bag_info,
             option("file", metavar="FILE"), JSON)
    add_verb(bag, "repair", "write what can be read into a whole file", bag_repair,
             option("file", metavar="IN"), option("out", metavar="OUT"),
             flag("--overwrite", "OUT may exist"))
    add_verb(bag, "export", "write it as tables, CSV or Parquet", bag_export,
             option("file", metavar="IN"),
             option("out", metavar="FOLDER", nargs="?", help="default: IN without its suffix"),
             option("--to", choices=("csv", "parquet"), default="csv", help="default: csv"),
             option("--topics", **topics, help="only channels that match one"), JSON)
    add_verb(bag, "ros2", "write it as a bag of ROS 2", bag_ros2,
             option("file", metavar="IN"), option("out", metavar="FOLDER"),
             option("--system", metavar="SPEC", help="file, or name of a shipped system, whose "
                    "actors and definitions count (default: what the recording has of its own)"),
             option("--distribution", metavar="NAME", help="of ROS 2 (default: the gateway's, or "
                    "jazzy)"),
             JSON)


def record(options: argparse.Namespace) -> int:
    """Record a run.

    Record everything that is sent in a run, from now until ctrl-C, the end of
    the run, or --duration. `launch.py --record FILE` records from the first
    message on. The robot does not wait for the recorder, whatever becomes of it.

    Examples:
      rampart record
      rampart record crash.mcap --duration 60
      rampart record poses.mcap --topics 'localization/*' 'detection/*'
    """
    positive("--duration", options.duration, below=1e9)
    with refusing(NoRunError, BagError):
        run = find_run(options.port)
        wants = _wanted(options.topics, run)
        path = Path(options.file or time.strftime("rampart-%Y%m%d-%H%M%S.mcap"))
        check_target(path, overwrite=options.overwrite)
        recorder = Recorder(run.base_port, path, overwrite=options.overwrite, wants=wants,
                            others=_others(run), shown=lambda run: tools_credentials(run)[0])
        recorder.open()
    stop = stop_pipe()
    say(f"recording {run.title} in {path}; ctrl-C ends it")
    try:
        why = recorder.run(stop, options.duration)
    except (BagError, ValueError, OSError) as error:
        raise NoEffectError(str(error)) from None
    say(f"{told(recorder)}; it ends because {why}")
    if recorder.writer is None or not recorder.writer.messages:
        raise NoEffectError("nothing was sent meanwhile")
    return 0


async def replay(options: argparse.Namespace) -> int:
    """Play a recording back.

    Play a recording back onto a bus of its own. Tools find it like a run
    (`rampart topic echo`, `rampart status`), with --port if a robot runs too;
    orders are refused, and nothing of it reaches a robot.

    Examples:
      rampart replay run.mcap --hmi-port 8090
      rampart replay run.mcap --rate 4 --start 60 --loop
      rampart replay run.mcap --topics 'manager/*' --delay 2
    """
    _check(options)
    with refusing(BagError):
        path = Path(options.file)
        known = Summary(BagReader(path)).keys if options.topics else ()
        player = Replay(path, port=options.port, rate=options.rate, loop=options.loop,
                        start_s=options.start, hmi_port=options.hmi_port, said=say,
                        wants=matcher(options.topics, known))
    stop = asyncio.Event()
    with stopped_by_signals(stop):
        if player.summary.reader.damage:
            say(f"{options.file}: damaged ({player.summary.reader.damage}); playing what is left")
        page = f", page http://127.0.0.1:{options.hmi_port}/" if options.hmi_port else ""
        say(f"playing {options.file} on port {options.port} at rate {options.rate:g}{page}; "
            "ctrl-C ends it")
        await player.run(stop, options.delay)
    refused = f", {player.refused} of another version left out" if player.refused else ""
    say(f"played {player.played} messages{refused}")
    if not player.played:
        raise NoEffectError("nothing was played")
    return 0


def matcher(globs: list[str], known: Iterable[str]) -> Callable[[str], bool]:
    """Return whether a full key is wanted, by patterns as users type them; all if there is none.

    Raises:
        UsageError: a pattern matches nothing that is known.
    """
    keys = [key.removeprefix(f"{ROOT}/") for key in known]
    patterns = [g.removeprefix("/").removeprefix(f"{ROOT}/") for g in globs]
    for pattern in patterns:
        if not any(fnmatch.fnmatchcase(key, pattern) for key in keys):
            families = sorted({key.split("/")[0] for key in keys})
            raise UsageError(f"--topics {pattern}: matches no topic; there are "
                             f"{', '.join(f'{name}/…' for name in families)} "
                             "(`rampart topic list`, `rampart bag info`)")
    if not patterns:
        return lambda _key: True
    return lambda key: any(
        fnmatch.fnmatchcase(key.removeprefix(f"{ROOT}/"), pattern) for pattern in patterns)


def _others(run: RunInfo) -> OtherHosts | None:
    """Return what there is to be heard of other hosts of a run.

    Raises:
        UsageError: the system's specification, or the folder of keys, cannot be used.
    """
    if not run.hosts:
        return None
    with refusing(ValueError, OSError):
        plan = RunPlan(system_file=run.system_file, host=run.host)
        tools_credentials(run)
        working_folder.admit(Path(run.system_file).parent)
        return others_of(Layout(plan, load_system(plan)))


def _wanted(globs: list[str], run: RunInfo) -> Callable[[str], bool]:
    """Return whether a key is wanted; all actors are loaded only if the declared ones do not do."""
    if not globs:
        return matcher(globs, ())
    spec = systems.load(run.system_file)
    try:
        return matcher(globs, keys_of(run, systems.declared(spec)))
    except UsageError:
        return matcher(globs, keys_of(run, systems.topics_of(spec)))


def keys_of(run: RunInfo, known: Iterable[Topic[Any]]) -> list[str]:
    """Return all full keys that may be used in a run, of the known topics."""
    return [key for topic in known
            for key in ([topic.at(n) for n in run.nodes] if topic.is_family else [topic.at()])]


def _check(options: argparse.Namespace) -> None:
    between("--rate", options.rate, 0.01, 1000)
    if not 0 <= options.delay < 1e6:
        raise UsageError(f"--delay {options.delay:g}: must not be negative")
    if options.start is not None and not -1e9 < options.start < 1e9:
        raise UsageError(f"--start {options.start:g}: must be a time of the run in seconds")
    between("--port", options.port, *_PORTS)
    between("--hmi-port", options.hmi_port or _PORTS[0], *_PORTS)
    if options.hmi_port == options.port:
        raise UsageError(f"--hmi-port {options.hmi_port}: is the replay's own --port; choose "
                         "another --hmi-port")


def bag_info(options: argparse.Namespace) -> int:
    """Print what is in a file.

    Show duration, size, what was run, and each channel with messages and rate.
    A file that was never closed, or is cut off, is read as far as it goes. The
    exit code is 1 if something in it cannot be read.

    Examples:
      rampart bag info run.mcap
      rampart bag info run.mcap --json
    """
    with refusing(BagError):
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
    if summary.unheard:
        spans = [f"{host} from {begin_s:.1f} s {'on' if end_s is None else f'to {end_s:.1f} s'}"
                 for host, those in summary.unheard.items() for begin_s, end_s in those]
        yield "unheard", (", ".join(spans)
                          or f"no host: {' and '.join(summary.unheard)} all the time")
    if not reader.closed:
        closing = "no: its writer did not come to the end"
    elif reader.damage:
        closing = "yes"
    else:
        closing = f"properly, because {summary.end.get('ended', 'its writer came to the end')}"
    yield "closed", closing + (f"; damaged: {reader.damage}" if reader.damage else "")
    for line in left_behind(reader):
        yield "gone", line
    if summary.files:
        yield "attached", ", ".join(name for name, _, _ in summary.files)


def bag_repair(options: argparse.Namespace) -> int:
    """Write a whole file.

    Copy everything that can be read of a torn file into a new one with an
    index, for viewers that insist on it. The old one stays as it is. The exit
    code is 1 if something was left behind.

    Examples:
      rampart bag repair torn.mcap whole.mcap
    """
    with refusing(BagError):
        reader = BagReader(Path(options.file))
        copied = repair(reader, Path(options.out), overwrite=options.overwrite)
    lines = left_behind(reader)
    say(f"{options.out}: {copied} messages; left behind: "
        f"{one_line(', '.join(lines)) or 'nothing'}")
    return 1 if lines else 0


def bag_export(options: argparse.Namespace) -> int:
    """Write a recording as tables.

    One file per topic in a new folder, one row per message: CSV, or Parquet with
    the extra `export`. The first column is simulated time; the others are the
    fields of the message, such as body.x_m. Without --topics the channels for
    viewers (view/…) are left out. The exit code is 1 if the recording is damaged
    and something of it was left behind.

    Examples:
      rampart bag export run.mcap
      rampart bag export run.mcap tables --to parquet --topics 'localization/*'
    """
    path = Path(options.file)
    folder = Path(options.out or path.with_suffix(""))
    with refusing(BagError):
        reader = BagReader(path)
        wants = None
        if options.topics:
            wants = matcher(options.topics, [row["channel"] for row in Summary(reader).table()])
        done = Export(reader, wants)
        done.write(folder, options.to)
    return _copied(options, folder, done.counts, done.left_out, reader)


def bag_ros2(options: argparse.Namespace) -> int:
    """Write a recording as a bag of ROS 2.

    A new folder with MCAP, cdr and ros2msg, as `ros2 bag record` makes it: for
    `ros2 bag play`, RViz, PlotJuggler. It has what passed a gateway to ROS 2, byte
    for byte; every topic of the run below /rampart, in types of their own; and
    what viewers see: /tf, /rosout, /view/scan, /view/map. The exit code is 1 if
    the recording is damaged and something of it was left behind.

    Examples:
      rampart bag ros2 run.mcap run-ros2
      rampart bag ros2 run.mcap run-ros2 --system warehouse.toml
    """
    extra("ros2", "rosbags")
    extra("ros2", "xxhash")
    from rampart.cli.record.ros_bags import write  # noqa: PLC0415 of the extra

    folder = Path(options.out)
    bag, reader = write(Path(options.file), folder, options.system, options.distribution)
    return _copied(options, folder, bag.counts, bag.left_out, reader)


def _copied(options: argparse.Namespace, folder: Path, counts: Counter[str],
            left_out: Mapping[str, tuple[int, str]], reader: BagReader) -> int:
    """Report what of a recording is in a folder and what is not, and return the exit code.

    Raises:
        NoEffectError: nothing is in it.
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
    """Return everything as plain data; scripts rely on these names."""
    reader = summary.reader
    return {
        "file": str(reader.path), "size_bytes": reader.size_bytes, "profile": reader.profile,
        "library": reader.library, "recording": reader.is_recording, "closed": reader.closed,
        "damage": reader.damage, "gone": gone(reader), "duration_s": round(summary.duration_s, 3),
        "messages": summary.messages, "time_zero_s": summary.time_zero_s, "run": summary.run,
        "end": summary.end, "lost": _losses(summary), "unheard": summary.unheard,
        "attachments": [name for name, _, _ in summary.files], "channels": summary.table()}


def gone(reader: BagReader) -> list[dict[str, Any]]:
    """Return what could not be read, as plain data; times are simulated seconds, or null."""
    def seconds(at_ns: int | None) -> float | None:
        return None if at_ns is None else round(at_ns / 1e9 + time_zero_s(reader), 3)

    return [{"what": gap.what, "from_byte": gap.from_byte, "to_byte": gap.to_byte,
             "from_s": seconds(gap.from_ns), "to_s": seconds(gap.to_ns)} for gap in reader.gaps]


def left_behind(reader: BagReader) -> list[str]:
    """Return the same in words, one for each gap."""
    return [f"bytes {one['from_byte']} to {one['to_byte']}" + (
        f", {one['from_s']:.2f} to {one['to_s']:.2f} s" if one["from_s"] is not None else "")
        + f": {one['what']}" for one in gone(reader)]


def _losses(summary: Summary) -> dict[str, int] | None:
    """Return source → lost messages; None if the file has no count."""
    try:
        return msgspec.json.decode(summary.end.get("lost", ""), type=dict[str, int])
    except (ValueError, RecursionError):
        return None
