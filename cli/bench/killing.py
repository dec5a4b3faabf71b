"""Kills in rounds: each round kills once under each keeper, so that a slow moment hits all.

From `os.kill` in this process until another process hears the replacement, by the monotonic clock.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec

from rampart.actors.ftm import topics
from rampart.cli.bench import peers as peers_of
from rampart.cli.bench.actors import OUTPUT
from rampart.cli.bench.figures import Kill, Killed, killed
from rampart.cli.bench.peers import ACTOR, COMMAND, OURS
from rampart.cli.bench.processes.observer import Heard
from rampart.cli.bench.programs import BenchError, Line, Program
from rampart.cli.bench.systems import START_S, System, observer, peers_system

BACK_S = 20.0
"""Wall seconds within which a replacement has to be heard."""

PAUSE_S = 0.3
"""Between a replacement's first output and the next kill, wherever that is."""

_PHASE_S = 0.05
"""The input comes so often: kills are out of step with it."""

Show = Callable[[str], None]


def heard(line: Line) -> Heard | None:
    """Return what an observer's line says, None if it is no such line."""
    try:
        return msgspec.json.decode(line.text, type=Heard)
    except msgspec.DecodeError:
        return None


class Victim:
    """A node that is killed again and again.

    Args:
        name: Of the row.
        title: Likewise.
        ear: Observer that hears it.
        finds: Returns what an observer's line says of this node, None for nothing.
        keeper: Without whom it does not come back.
        teller: Whose lines say that it has ended; the keeper if None.
        ended: Whether such a line says that.
        decided: Whether such a line says that the manager has decided on a recovery.
        pid_of: Returns the process to be killed, when this was heard of it.

    Attributes:
        failure: Why it is killed no more; "" as long as it is.
        besides: How often it was replaced without being killed.
    """

    def __init__(self, name: str, title: str, *, ear: Program, finds: Callable[[Heard], bool],
                 keeper: Program, ended: Callable[[Line], bool], pid_of: Callable[[Heard], int],
                 teller: Program | None = None,
                 decided: Callable[[Line], bool] = lambda _: False) -> None:
        self.name, self.title, self.failure, self.besides = name, title, "", 0
        self.kills: list[Kill] = []
        self._ear, self._finds = ear, finds
        self._keeper, self._teller = keeper, teller or keeper
        self._ended, self._decided = ended, decided
        self._pid_of = pid_of
        self._newest: Heard | None = None
        self._looked = 0

    @property
    def note(self) -> str:
        """What a reader of its row has to know, "" for nothing."""
        besides = f"replaced without a kill: {self.besides}" if self.besides else ""
        return "; ".join(filter(None, (self.failure, besides)))

    def wait(self) -> None:
        """Wait until it is heard for the first time."""
        self._attempt(lambda: self._hear(0, START_S))

    def kill(self) -> None:
        """Kill it once, and wait for its replacement."""
        self._attempt(self._kill)

    def _attempt(self, what: Callable[[], object]) -> None:
        if self.failure:
            return
        try:
            what()
        except BenchError as error:
            done = f"after {len(self.kills)} kills: " if self.kills else ""
            self.failure = f"{done}{error}"

    def _hear(self, start: int, within_s: float) -> Heard:
        before = self._newest

        def new(line: Line) -> Heard | None:
            found = heard(line)
            return found if found and self._finds(found) and (
                before is None or found.number != before.number) else None

        self._newest = self._ear.wait_for(new, within_s, f"an output of {self.name}", start,
                                          self._keeper)
        self._looked = len(self._ear.lines)
        return self._newest

    def _catch_up(self) -> None:
        """Know who is there now: a keeper may have taken a process for hung and replaced it."""
        for line in self._ear.lines[self._looked:]:
            found = heard(line)
            if found is not None and self._finds(found) and (
                    self._newest is None or found.number != self._newest.number):
                self._newest = found
                self.besides += 1
        self._looked = len(self._ear.lines)

    def _kill(self) -> None:
        time.sleep(random.uniform(0, _PHASE_S))  # noqa: S311
        self._catch_up()
        if self._newest is None:
            raise RuntimeError(f"{self.name} was not waited for")
        pid = self._pid_of(self._newest)
        start, told = len(self._ear.lines), len(self._teller.lines)
        at_s = time.monotonic()
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:  # the replacement is on its way, and the next round finds it
            self._hear(start, BACK_S)
            self.besides += 1
            self.kills.append(Kill())  # so that rounds stay side by side
            return
        found = self._hear(start, BACK_S)
        with contextlib.suppress(BenchError):  # the word of it may come after the output
            self._teller.wait_for(lambda line: self._ended(line) or None, PAUSE_S, "", told)
        lines = self._teller.lines[told:]
        begun_s = found.body.get("begun_s") if isinstance(found.body, dict) else None
        self.kills.append(Kill(*(None if then_s is None else round((then_s - at_s) * 1e3, 3) for
                                 then_s in (_first_s(lines, self._ended),
                                            _first_s(lines, self._decided),
                                            begun_s, found.at_s))))


def _first_s(lines: Sequence[Line], which: Callable[[Line], bool]) -> float | None:
    """Return when the first of some lines came."""
    return next((line.at_s for line in lines if which(line)), None)


def in_rounds(victims: Sequence[Victim], kills: int, show: Show,
              pause_s: float = PAUSE_S) -> None:
    """Kill each victim so many times, one after the other in each round."""
    for number in range(kills):
        for victim in victims:
            show(f"round {number + 1} of {kills}: {victim.name}")
            victim.kill()
            time.sleep(pause_s)


def node_of(name: str) -> str:
    """Return the node of `peers_system` that is killed for one of `OURS`."""
    return name.removeprefix("rampart-")


def _tells(detected: re.Pattern[str], line: Line) -> bool:
    return detected.search(line.text) is not None


def crashed(node: str) -> Callable[[Line], bool]:
    """Return whether a line of an observer says that the supervisor has found a node dead."""
    def is_so(line: Line) -> bool:
        found = heard(line)
        return (found is not None and found.key == topics.PROCESS_EVENT.key
                and found.body["node"] == node and found.body["event"] == "crashed")

    return is_so


def measure_peers(names: Sequence[str], kills: int, installed: Path, folder: Path,
                  show: Show) -> tuple[Killed, ...]:
    """Kill the same node under each keeper of processes.

    Args:
        names: Of `KEEPERS`.
        kills: Of each.
        installed: Environment in which peers are installed.
        folder: For configurations and sockets.
        show: Shows what is being done.

    Raises:
        BenchError: The bus or the Rampart system cannot be started.
    """
    endpoint = f"unixsock-stream/{folder}/bus"
    victims: dict[str, Victim] = {}
    notes: dict[str, str] = {}
    with contextlib.ExitStack() as running:
        ear = running.enter_context(observer("bus", endpoint))

        def victim(name: str, title: str, keeper: Program, ended: Callable[[Line], bool], *,
                   of: Program = ear, teller: Program | None = None) -> None:
            source = name if of is ear else node_of(name)
            victims[name] = Victim(
                name, title, ear=of, keeper=keeper, teller=teller, ended=ended,
                finds=lambda found: found.key == OUTPUT.key and found.source == source,
                pid_of=lambda found: int(found.body["pid"]))

        for peer in (peers_of.PEERS[name] for name in names if name not in OURS):
            show(f"starting {peer.name}")
            try:
                program = peers_of.start(peer, folder / peer.name, endpoint, installed)
            except BenchError as error:
                notes[peer.name] = str(error)
                continue
            if program is None:
                notes[peer.name] = peers_of.INSTALL
                continue
            running.enter_context(program)
            title = f"{peer.title}{peers_of.version(peer, installed)}"
            victim(peer.name, title, program, partial(_tells, peer.detected))
        if set(OURS) & set(names):
            show("starting Rampart")
            file = folder / "peers.toml"
            file.write_text(peers_system(peers_of.node_command(COMMAND, endpoint)), "utf-8")
            system = running.enter_context(System(
                file, folder, [OUTPUT.key], [topics.PROCESS_EVENT.key]))
            for name in OURS:
                if name in names:
                    victim(name, OURS[name], system.program, teller=system.ear,
                           ended=crashed(node_of(name)), of=ear if name == COMMAND else system.ear)
        for each in victims.values():
            show(f"waiting for {each.name}")
            each.wait()
        in_rounds(list(victims.values()), kills, show)
    beside = victims[ACTOR].kills if ACTOR in victims else ()
    return tuple(
        killed(name, victims[name].title, victims[name].kills, victims[name].note, beside)
        if name in victims else killed(name, peers_of.PEERS[name].title, (), notes[name])
        for name in names)
