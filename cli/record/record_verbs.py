"""`rampart record` and `rampart replay`."""

from __future__ import annotations

import argparse
import asyncio
import fnmatch
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.recording.bag_writer import BagError, check_target
from rampart.actors.recording.process import stop_pipe, told
from rampart.actors.recording.recorder import Recorder
from rampart.actors.run.run_info import NoRunError, RunInfo, find_run
from rampart.cli import systems
from rampart.cli.following import stopped_by_signals
from rampart.cli.output import NoEffectError, UsageError, say
from rampart.cli.record.replaying import DEFAULT_PORT, Replay

_PORTS = (1024, 65535)


def add(verbs: Any, formatter: Any, common: argparse.ArgumentParser) -> None:
    """Add the verbs to the parser."""
    parser = verbs.add_parser(
        "record", parents=[common], formatter_class=formatter, help="record a run that is there",
        description="Record everything that is sent in a run, from now until ctrl-C, the end of\n"
                    "the run, or --duration. `launch.py --record FILE` records from the first\n"
                    "message on. The robot does not wait for the recorder, whatever becomes of it.",
        epilog="examples:\n  rampart record\n  rampart record crash.mcap --duration 60\n"
               "  rampart record poses.mcap --topics 'localization/*' 'detection/*'")
    parser.add_argument("file", metavar="FILE", nargs="?",
                        help="MCAP file (default: rampart-TIME.mcap)")
    parser.add_argument("--topics", metavar="GLOB", nargs="+", action="extend", default=[],
                        help="only keys that match one, as in `rampart topic list`")
    parser.add_argument("--duration", type=float, metavar="S", help="end after S real seconds")
    parser.add_argument("--overwrite", action="store_true", help="FILE may exist")
    parser.set_defaults(run=record)

    parser = verbs.add_parser(
        "replay", formatter_class=formatter, help="play a recording back",
        description="Play a recording back onto a bus of its own. Tools find it like a run\n"
                    "(`rampart topic echo`, `rampart status`), with --port if a robot runs too;\n"
                    "orders are refused, and nothing of it reaches a robot.",
        epilog="examples:\n  rampart replay run.mcap --hmi-port 8090\n"
               "  rampart replay run.mcap --rate 4 --start 60 --loop\n"
               "  rampart replay run.mcap --topics 'manager/*' --delay 2")
    parser.add_argument("file", metavar="FILE")
    parser.add_argument("--rate", type=float, metavar="R", default=1.0,
                        help="simulated seconds per second (default: 1)")
    parser.add_argument("--loop", action="store_true",
                        help="begin anew at the end; each lap is a later life of every node")
    parser.add_argument("--topics", metavar="GLOB", nargs="+", action="extend", default=[],
                        help="only keys that match one")
    parser.add_argument("--start", type=float, metavar="S",
                        help="begin at simulated second S of the run")
    parser.add_argument("--delay", type=float, metavar="S", default=0.0,
                        help="real seconds before the first message, for readers to come")
    parser.add_argument("--hmi-port", type=int, metavar="PORT", default=0,
                        help="show the operator's page, on this port of loopback")
    parser.add_argument("--port", type=int, metavar="N", default=DEFAULT_PORT,
                        help=f"Zenoh port of the replay (default: {DEFAULT_PORT})")
    parser.set_defaults(run=lambda options: asyncio.run(replay(options)))


def record(options: argparse.Namespace) -> int:
    """Record a run."""
    if options.duration is not None and not 0 < options.duration < 1e9:
        raise UsageError(f"--duration {options.duration:g}: must be above 0")
    try:
        run = find_run(options.port)
    except NoRunError as error:
        raise UsageError(str(error)) from None
    wants = _wanted(options.topics, run)
    path = Path(options.file or time.strftime("rampart-%Y%m%d-%H%M%S.mcap"))
    try:
        check_target(path, overwrite=options.overwrite)
    except BagError as error:
        raise UsageError(str(error)) from None
    recorder = Recorder(run.base_port, path, overwrite=options.overwrite, wants=wants)
    try:
        recorder.open()
    except BagError as error:
        raise UsageError(str(error)) from None
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
    """Play a recording back."""
    _check(options)
    try:
        player = Replay(
            Path(options.file), port=options.port, rate=options.rate, loop=options.loop,
            start_s=options.start, hmi_port=options.hmi_port, said=say,
            wants=_late(options))
    except BagError as error:
        raise UsageError(str(error)) from None
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


def _late(options: argparse.Namespace) -> Callable[[str], bool]:
    """Return whether a key is wanted, checked against what is in the file."""
    if not options.topics:
        return lambda _key: True
    from rampart.actors.recording.bag_reader import BagReader, Summary  # noqa: PLC0415 only here

    return matcher(options.topics, Summary(BagReader(Path(options.file))).keys)


def _check(options: argparse.Namespace) -> None:
    if not 0.01 <= options.rate <= 1000:
        raise UsageError(f"--rate {options.rate:g}: must be between 0.01 and 1000")
    if not 0 <= options.delay < 1e6:
        raise UsageError(f"--delay {options.delay:g}: must not be negative")
    if options.start is not None and not -1e9 < options.start < 1e9:
        raise UsageError(f"--start {options.start:g}: must be a time of the run in seconds")
    for name, port in (("--port", options.port), ("--hmi-port", options.hmi_port or _PORTS[0])):
        if not _PORTS[0] <= port <= _PORTS[1]:
            raise UsageError(f"{name} {port}: must be between {_PORTS[0]} and {_PORTS[1]}")
    if options.hmi_port == options.port:
        raise UsageError(f"--hmi-port {options.hmi_port}: is the replay's own --port; choose "
                         "another --hmi-port")
