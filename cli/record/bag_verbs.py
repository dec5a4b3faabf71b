"""`rampart bag`: what is in a recording, and how to mend a torn one."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rampart.actors.recording.bag_reader import BagReader, Summary, repair
from rampart.actors.recording.bag_writer import BagError
from rampart.cli.output import UsageError, print_json, print_table, say
from rampart.files.reading import plain_line

_WIDTH = 11
"""Of the names in front of the lines."""


def add(verbs: Any, formatter: Any) -> None:
    """Add the verbs to the parser."""
    bag = verbs.add_parser(
        "bag", formatter_class=formatter, help="what is in a recording (needs no run)",
        description="Look at recordings: MCAP files of `launch.py --record`, `rampart record`, or\n"
                    "others.",
        epilog="examples:\n  rampart bag info run.mcap\n  rampart bag repair torn.mcap whole.mcap")
    subverbs = bag.add_subparsers(dest="subverb", required=True, metavar="VERB")
    parser = subverbs.add_parser(
        "info", formatter_class=formatter, help="duration, run, channels, whether it is whole",
        description="Show duration, size, what was run, and each channel with messages and rate.\n"
                    "A file that was never closed, or is cut off, is read as far as it goes.",
        epilog="examples:\n  rampart bag info run.mcap\n  rampart bag info run.mcap --json")
    parser.add_argument("file", metavar="FILE")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=bag_info)
    parser = subverbs.add_parser(
        "repair", formatter_class=formatter, help="write what can be read into a whole file",
        description="Copy everything that can be read of a torn file into a new one with an\n"
                    "index, for viewers that insist on it. The old one stays as it is.",
        epilog="examples:\n  rampart bag repair torn.mcap whole.mcap")
    parser.add_argument("file", metavar="IN")
    parser.add_argument("out", metavar="OUT")
    parser.add_argument("--overwrite", action="store_true", help="OUT may exist")
    parser.set_defaults(run=bag_repair)


def bag_info(options: argparse.Namespace) -> int:
    """Print what is in a file."""
    try:
        summary = Summary(BagReader(Path(options.file)))
    except BagError as error:
        raise UsageError(str(error)) from None
    if options.json:
        print_json(described(summary))
        return 0
    reader, run = summary.reader, summary.run
    _say(f"file       {options.file}, {reader.size_bytes / 1e6:.1f} MB, {reader.library}")
    if reader.is_recording:
        _say(f"run        {run.get('title', '')} ({run.get('run_id', '')}), "
            f"rate {run.get('rate', '')}, rampart {run.get('rampart_version', '')}")
        _say(f"began      {run.get('started') or 'in virtual time'}")
    else:
        _say(f"run        none: not a recording of a run{_profile(reader.profile)}")
    first_s = (summary.first_ns or 0) / 1e9 + summary.time_zero_s
    say(f"duration   {summary.duration_s:.1f} s, from {first_s:.1f} s of simulated time"
        if reader.is_recording else f"duration   {summary.duration_s:.1f} s")
    say(f"messages   {summary.messages} on {len(reader.channels)} channels")
    _say(f"lost       {_lost(summary)}")
    _say(f"closed     {_closing(summary)}")
    if summary.files:
        _say(f"attached   {', '.join(name for name, _, _ in summary.files)}")
    say()
    print_table(("channel", "schema", "messages", "rate"), [
        (plain_line(row["channel"]), plain_line(row["schema"]), row["messages"],
         f"{row['rate_hz']:.2f} Hz" if row["rate_hz"] is not None else "")
        for row in summary.table()])
    return 0


def bag_repair(options: argparse.Namespace) -> int:
    """Write a whole file."""
    try:
        reader = BagReader(Path(options.file))
        copied = repair(reader, Path(options.out), overwrite=options.overwrite)
    except BagError as error:
        raise UsageError(str(error)) from None
    say(f"{options.out}: {copied} messages; left behind: {reader.damage or 'nothing'}")
    return 0


def _say(line: str) -> None:
    """Print a line in which words of the file are; they steer no terminal."""
    head, words = line[:_WIDTH], line[_WIDTH:]
    say(head + plain_line(words))


def described(summary: Summary) -> dict[str, Any]:
    """Return everything as plain data; scripts rely on these names."""
    reader = summary.reader
    return {
        "file": str(reader.path), "size_bytes": reader.size_bytes, "profile": reader.profile,
        "library": reader.library, "recording": reader.is_recording,
        "closed": reader.closed, "damage": reader.damage,
        "duration_s": round(summary.duration_s, 3), "messages": summary.messages,
        "time_zero_s": summary.time_zero_s, "run": summary.run, "end": summary.end,
        "lost": _losses(summary), "attachments": [name for name, _, _ in summary.files],
        "channels": summary.table()}


def _losses(summary: Summary) -> dict[str, int] | None:
    """Return source → messages lost; None if the file does not say."""
    try:
        return {str(k): int(v) for k, v in json.loads(summary.end["lost"]).items()}
    except (KeyError, ValueError, AttributeError, TypeError, RecursionError, OverflowError):
        return None


def _lost(summary: Summary) -> str:
    losses = _losses(summary)
    if losses is None:
        return "unknown"
    return ", ".join(f"{count} of {name}" for name, count in losses.items()) or "none"


def _closing(summary: Summary) -> str:
    reader = summary.reader
    if reader.closed:
        why = f", because {summary.end['ended']}" if "ended" in summary.end else ""
        return f"properly{why}" if not reader.damage else f"yes; damaged: {reader.damage}"
    return "no: its writer did not come to the end" + (
        f"; {reader.damage}" if reader.damage else "")


def _profile(profile: str) -> str:
    return f", profile {profile!r}" if profile else ""
