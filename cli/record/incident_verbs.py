"""`rampart incident`: what the black box has kept of the time around faults.

Inspect incidents: the time around each decision on a fault, each failed process,
and the sudden end of a run. Each run on one machine keeps them, except in virtual time
or with --no-black-box, in $XDG_STATE_HOME/rampart (~/.local/state/rampart).

Examples:
  rampart incident list
  rampart incident show
  rampart incident replay 20261127-0912 --hmi-port 8090
  rampart incident export 20261127-0912 crash.mcap
  rampart incident history
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from rampart.actors.bus.envelope import UNREADABLE, decode
from rampart.actors.bus.run_info import find_runs
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm.history import Fault, clear_history, read_history
from rampart.actors.ftm.narrator import Narrator
from rampart.actors.recording import incidents
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of, time_zero_s
from rampart.actors.recording.bag_writer import complete, open_target
from rampart.actors.recording.incidents import Incident, incidents_in, state_folder
from rampart.actors.recording.message_form import Forms
from rampart.actors.recording.run_documents import recorded_system
from rampart.cli.output import UsageError, print_json, print_rows, print_table, say
from rampart.cli.record.replaying import PLAYING, replay
from rampart.cli.verbs import JSON, add_family, add_verb, flag, option
from rampart.files.plain_text import one_line


def names(**_: Any) -> list[str]:
    """Return the names of all incidents."""
    return [kept.incident.name for kept in _kept()]


_NAME = option("name", metavar="NAME", nargs="?", completer=names,
               help="name of the incident, or its beginning (default: the newest)")


class Kept(NamedTuple):
    """An incident, and the path of its recording, which may not exist."""

    incident: Incident
    path: Path

    @property
    def state(self) -> str:
        """Whether it is whole."""
        return self.incident.partial or (
            "" if incidents.is_over(self.path.parent, self.incident) else "not over yet")


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    family = add_family(verbs, "incident", "show what was kept around faults", __doc__)
    add_verb(family, "list", "list the incidents of all runs", incident_list, JSON)
    add_verb(family, "show", "show the story of an incident", show, _NAME, JSON)
    add_verb(family, "replay", "play an incident back", replay_incident, _NAME, *PLAYING)
    add_verb(family, "export", "copy an incident to an MCAP file", export, _NAME,
             option("out", metavar="OUT", nargs="?",
                    help="new file (default: incident-NAME.mcap)"),
             flag("--overwrite", "replace OUT if it exists"))
    for where, name in ((family, "history"), (verbs, "incidents")):
        add_verb(where, name, "list the faults of all runs", history,
                 flag("--clear", "acknowledge healed faults: they become cleared"), JSON,
                 hidden=where is verbs)


def incident_list(options: argparse.Namespace) -> int:
    """Print the incidents.

    List the incidents of all runs, oldest first, also those of a run that was
    killed. Times are simulated seconds of the run.

    Examples:
      rampart incident list
      rampart incident list --json
    """
    found = _kept()
    if not (found or options.json):
        say(f"no incidents in {state_folder('')}")
        return 0
    print_rows(("name", "system", "run", "from s", "to s", "cause", "incomplete"), [
        (kept.incident.name, kept.incident.system, kept.incident.run,
         round(kept.incident.from_s, 1), round(kept.incident.to_s, 1),
         one_line(kept.incident.cause, 80), kept.state) for kept in found],
        {"incidents": [_data(kept) for kept in found]}, as_json=options.json)
    return 0


def show(options: argparse.Namespace) -> int:
    """Print one incident.

    Show what happened, in the words of the console: cause, events, each decision
    with its certificate, and per node its messages, silences and restarts.

    Examples:
      rampart incident show
      rampart incident show 20261127-0912 --json
    """
    with _recording(options.name) as kept:
        story = Story(kept.path)
        if options.json:
            print_json({**_data(kept), **story.data()})
            return 0
        incident = kept.incident
        say(f"incident  {incident.name} of {incident.system}, run {incident.run}, {incident.at}")
        say(f"cause     {one_line(incident.cause)}")
        say(f"recorded  {incident.from_s:.1f} to {incident.to_s:.1f} s, "
            f"{story.messages} messages{incident.partial and f'; incomplete: {incident.partial}'}")
        say()
        for at_s, text in story.lines:
            say(f"[{at_s:8.2f} s] {one_line(text)}")
        for record in story.decisions:
            say()
            say(f"certificate of decision {record.decision}: rule {record.rule} of "
                f"{record.strategy}")
            say(f"  path      {'; '.join(record.path) or 'no comparison needed'}")
            rejected = "; ".join(f"{name}: {why}" for name, why in record.rejected)
            say(f"  rejected  {one_line(rejected) or 'no alternative'}")
        say()
        print_table(("node", "messages", "longest silence s", "last message s", "restarts"),
                    [(name, *row) for name, row in story.nodes.items()])
    return 0


async def replay_incident(options: argparse.Namespace) -> int:
    """Play an incident back.

    Play back an incident as `rampart replay` does a recording: on a separate bus, or
    with the operator's page, MuJoCo's viewer, or as a video.

    Examples:
      rampart incident replay --hmi-port 8090
      rampart incident replay 20261127-0912 --rate 0.5
    """
    with _recording(options.name) as kept:
        options.file = str(kept.path)
        return await replay(options)


def export(options: argparse.Namespace) -> int:
    """Copy an incident.

    Write the recording of an incident: an MCAP file with all messages, and with
    specification, versions, options and files attached. It opens in
    viewers, and with `rampart bag` and `rampart replay` on any machine.

    Examples:
      rampart incident export
      rampart incident export 20261127-0912 crash.mcap
    """
    with _recording(options.name) as kept:
        out = Path(options.out or f"incident-{kept.incident.name}.mcap")
        with open_target(out, overwrite=options.overwrite) as file, complete(out), (
                kept.path.open("rb")) as source:
            shutil.copyfileobj(source, file)
    say(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {one_line(kept.incident.cause)}")
    return 0


def history(options: argparse.Namespace) -> int:
    """Print the faults of all runs.

    List the faults of all runs of each system, the last one first. A fault is
    suspected when a detection module is active, confirmed by a decision or by the
    supervisor, healed after 10 s without it, and cleared by --clear.

    Examples:
      rampart incident history
      rampart incident history --clear
    """
    rows: list[tuple[str, Fault]] = []
    for folder in _folders():
        if options.clear:
            say(f"{folder.name}: {clear_history(folder)} faults cleared")
        rows += ((folder.name, fault) for fault in read_history(folder))
    if options.clear:
        return 0
    if not (rows or options.json):
        say(f"no faults in {state_folder('')}")
        return 0
    print_rows(("state", "system", "mechanism", "node", "times", "first", "last", "error"), [
        (fault.state, system, one_line(fault.mechanism), one_line(fault.node), fault.times,
         _day(fault.first_s), _day(fault.last_s), one_line(fault.error, 80))
        for system, fault in rows], {"faults": [
            {"system": system, **msgspec.structs.asdict(fault)} for system, fault in rows]},
        as_json=options.json)
    return 0


class Story:
    """The story of a recording, as far as it can be read.

    Args:
        path: file of the recording.

    Attributes:
        messages: number of messages of the bus.
        lines: simulated time and text of each event.
        decisions: decisions on a fault, with their certificates.
        nodes: by node, its messages, longest silence and last message (simulated seconds), and
            restarts.
    """

    def __init__(self, path: Path) -> None:
        self.messages = 0
        self.lines: list[tuple[float, str]] = []
        self.decisions: list[fm.DecisionRecord] = []
        self.nodes: dict[str, tuple[int, float, float, int]] = {}
        summary = Summary(BagReader(path))
        _, known = recorded_system(summary.files)
        forms, narrator = Forms(known.topics), Narrator(known.system.titles)
        first: dict[str, int] = {}
        reader = BagReader(path)
        for channel, message in reader.messages():
            if (key := key_of(channel)) is None:
                continue
            self.messages += 1
            at_s = message.log_time / 1e9 + time_zero_s(summary.reader)
            form = forms.of(key)
            if form.topic is None:
                continue
            try:
                header, body = decode(form.topic, form.payload(message.data))
            except UNREADABLE:
                continue
            name = header.source
            count, silence_s, last_s, _ = self.nodes.get(name, (0, 0.0, at_s, 0))
            self.nodes[name] = (
                count + 1, round(max(silence_s, at_s - last_s), 2), round(at_s, 2),
                header.incarnation - first.setdefault(name, header.incarnation))
            found = narrator.describe(body, header)
            self.lines += ((at_s, line.text) for line in found)
            if found and isinstance(body, fm.DecisionRecord) and body.active:
                self.decisions.append(body)
        self.nodes = dict(sorted(self.nodes.items()))

    def data(self) -> dict[str, Any]:
        """Return the story as plain data."""
        return {
            "messages": self.messages,
            "events": [{"at_s": round(at_s, 3), "text": text} for at_s, text in self.lines],
            "decisions": [msgspec.to_builtins(record) for record in self.decisions],
            "nodes": {name: dict(zip(("messages", "longest_silence_s", "last_s", "restarts"), row,
                                     strict=True)) for name, row in self.nodes.items()}}


def _folders() -> list[Path]:
    """Return the folders of the systems.

    Raises:
        UsageError: the user has no home directory.
    """
    return sorted(path for path in state_folder("").glob("*") if path.is_dir())


def _kept() -> list[Kept]:
    """Return all incidents, oldest first, also of runs that were cut off."""
    living = {run.run_id for run in find_runs()}
    found = []
    for folder in _folders():
        incidents.settle(folder, living)
        found += [Kept(*one) for one in incidents_in(folder)]
    return sorted(found, key=lambda kept: kept.incident.name)


@contextlib.contextmanager
def _recording(name: str | None) -> Iterator[Kept]:
    """Yield an incident with its recording in a temporary file.

    Raises:
        UsageError: it is not known, or cannot be read.
    """
    found = [kept for kept in _kept() if kept.incident.name.startswith(name or "")]
    if not found:
        raise UsageError(f"{name}: no such incident; `rampart incident list` lists them"
                         if name else f"no incidents in {state_folder('')}")
    if name and len(found) > 1:
        raise UsageError(f"{name}: {len(found)} incidents begin so, from "
                         f"{found[0].incident.name} to {found[-1].incident.name}")
    kept = found[-1]
    if kept.path.exists():  # of version 1.0
        yield kept
        return
    with tempfile.TemporaryDirectory(prefix="rampart-incident-") as folder:
        path = Path(folder, kept.path.name)
        yield Kept(incidents.write_recording(kept.path.parent, kept.incident, path), path)


def _data(kept: Kept) -> dict[str, Any]:
    return {**msgspec.to_builtins(kept.incident), "partial": kept.state,
            "file": str(kept.path) if kept.path.exists() else None}


def _day(at_s: float) -> str:
    return datetime.datetime.fromtimestamp(at_s).astimezone().isoformat(" ", "seconds")[:19]
