"""What the tables of a system specification have in common, and those that know no other.

`Timing` and `Layers` are tables of a spec; the rest of them is in `rampart.manager.spec.schema`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec

from rampart.files.plain_text import one_line, shown

_A_NAME = "a name: a letter, then letters, digits and underscores"
OptionalName = Annotated[str, msgspec.Meta(
    pattern=r"^([A-Za-z][A-Za-z0-9_]{0,63})?\Z", description=_A_NAME)]
Name = Annotated[str, msgspec.Meta(
    pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z", description=_A_NAME)]
"""As long as the address of a node's socket has room for (`actors.bus.run_folder`), and well
below what a message takes as a name (`rampart.actors.bus.bounds`), which may add to it."""

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]

DERIVED = math.nan
"""Default of a timing value that is derived; a file cannot say it, numbers there are finite."""

_LONGEST_SHOWN = 200
"""Characters of a value in a message."""


Row = TypeVar("Row")


class SpecificationError(ValueError):
    """A system spec that cannot be accepted. The message is one line.

    Attributes:
        file: Name of the file, as given by the caller.
        path: Where in it, e.g. `$.mechanism[2].detect`.
        problem: What is wrong and what would be right.
    """

    def __init__(self, file: str, path: str, problem: str, *value: object) -> None:
        self.file = file
        self.path = path
        self.problem = problem
        said = f" = {shown(value[0], _LONGEST_SHOWN)}" if value else ""
        super().__init__(one_line(f"{file}: {path}{said}: {problem}"))


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all tables of a spec: immutable, and a field it does not know is an error."""


class Timing(Table, frozen=True):
    """All times, in seconds. Those that default to `DERIVED` follow from the robot if left out.

    In a system without a [robot] they are five periods of what they wait for (`PERIODS`).

    Attributes:
        heartbeat_period_s: Between two heartbeats of an actor.
        control_period_s: Between two commands, poses or scans.
        manager_period_s: Between two statuses of the FTM Manager.
        detection_period_s: Between two reports of a detection module whose state stays the same.
        arbitration_s: From a detection report sent to the recovery's command received.
        actuation_s: From a recovery's command received to the wheels feeling it.
        respawn_s: From a node's death being known to its first useful message.
        heartbeat_timeout_s: Without heartbeat for so long, a node counts as crashed (DM4, 5, 7).
        command_timeout_s: Without new command for so long, it is stale (DM2).
        localization_timeout_s: Without new pose for so long, it is stale (DM6).
        scan_timeout_s: A laser sweep older than this shows nothing: the Safety Pilot stops.
        dead_man_timeout_s: Without command for so long, the base brakes by itself.
        manager_timeout_s: Without manager status for so long, the Safety Pilot stops.
        detection_silence_timeout_s: Without report for so long, a detection module counts as
            active.
        startup_grace_s: Silence of a module that was never heard is forgiven for so long.
        release_hold_s: A detection module has to be idle for so long before its mechanism is.
        release_hold_max_s: To which this grows while the module flaps.
    """

    heartbeat_period_s: Positive = 0.1
    control_period_s: Positive = 0.05
    manager_period_s: Positive = 0.1
    detection_period_s: Positive = 0.2
    arbitration_s: Positive = 0.05
    actuation_s: Positive = 0.1
    respawn_s: Positive = 0.4
    heartbeat_timeout_s: Positive = DERIVED
    command_timeout_s: Positive = DERIVED
    localization_timeout_s: Positive = DERIVED
    scan_timeout_s: Positive = DERIVED
    dead_man_timeout_s: Positive = DERIVED
    manager_timeout_s: Positive = DERIVED
    detection_silence_timeout_s: Positive = DERIVED
    startup_grace_s: NonNegative = 5.0
    release_hold_s: NonNegative = 0.5
    release_hold_max_s: NonNegative = 10.0


PERIODS = {
    "heartbeat_timeout_s": "heartbeat_period_s", "command_timeout_s": "control_period_s",
    "localization_timeout_s": "control_period_s", "scan_timeout_s": "control_period_s",
    "dead_man_timeout_s": "control_period_s", "manager_timeout_s": "manager_period_s",
    "detection_silence_timeout_s": "detection_period_s",
}
"""The period of what each timeout of `[timing]` waits for."""

FAILOVER_S = 0.3
"""For so long, real seconds, nothing may be heard when a router of the bus dies: some milliseconds
as a rule, 0.26 s were measured when it was stopped before."""

GUARDED = frozenset({"heartbeat_timeout_s", "command_timeout_s", "localization_timeout_s"})
"""Timeouts of detection modules and the supervisor, which blame nobody for what is lost then."""


class Layers(Table, frozen=True):
    """Guards, each of which can be switched off, to run the paper's unprotected baseline.

    Attributes:
        dead_man: The base brakes when commands cease.
        safety_pilot_checks: The Safety Pilot refuses commands out of bounds, stale or out of
            sequence. It stops for obstacles in any case.
        manager_watch: The Safety Pilot stops when the FTM Manager is silent.
        supervisor_respawn: The supervisor respawns what dies and is not the manager's to respawn.
        ftm: Detection modules, recovery modules and the FTM Manager run at all.
        checkpoints: Nodes that hold data keep it on stable storage and come back with it.
    """

    dead_man: bool = True
    safety_pilot_checks: bool = True
    manager_watch: bool = True
    supervisor_respawn: bool = True
    ftm: bool = True
    checkpoints: bool = True


class End(Table, frozen=True):
    """When a run of the system is over.

    Attributes:
        after_s: Simulated seconds after which it is, unless the command line says otherwise; None
            for a system that goes on until it is told to end.
    """

    after_s: Positive | None = None


class Finding(NamedTuple):
    """Something wrong: where, what, and the offending value if one value is to blame."""

    path: str
    problem: str
    value: tuple[Any, ...] = ()


_NAME = re.compile(r"[A-Za-z][\w-]{0,63}\Z", re.ASCII)
_IN_A_ROW = re.compile(r"\$\.(node|detection|recovery|mechanism|event|fault|host)\[(\d+)\](\.|\Z)")


def by_name(path: str, document: Mapping[str, Any]) -> str:
    """Return where something is, by the name of its table rather than by its place.

    Args:
        path: In the file, e.g. `$.node[2].kind`.
        document: The file.

    Returns:
        For example `node pump: kind`; the path, if it is not in such a table, or that has no name.
    """
    found = _IN_A_ROW.match(path)
    if not found or path.endswith("].name"):  # which may be there twice
        return path
    try:
        name = document[found[1]][int(found[2])]["name"]
    except (LookupError, TypeError):
        return path
    if not isinstance(name, str) or not _NAME.match(name):
        return path
    rest = path[found.end():]
    return f"{found[1]} {name}: {rest}" if rest else f"{found[1]} {name}"


def unknown(path: str, value: str, what: str, known: Collection[str]) -> Finding:
    """Return the finding for a name that is none; it lists those that are."""
    return Finding(path, f"unknown {what}; known: {', '.join(known) or 'none'}", (value,))


def find_wrong_names(path: str, names: Iterable[str], what: str, known: Collection[str],
                     again: str) -> Iterator[Finding]:
    """Find names in a list that are unknown, or listed `again`."""
    listed: set[str] = set()
    for place, name in enumerate(names):
        if name not in known:
            yield unknown(f"{path}[{place}]", name, what, known)
        if name in listed:
            yield Finding(f"{path}[{place}]", again, (name,))
        listed.add(name)


def numbered(table: str, rows: Iterable[Row]) -> Iterator[tuple[str, Row]]:
    """Yield the rows of an array of tables, each with its path in the file."""
    return ((f"$.{table}[{index}]", row) for index, row in enumerate(rows))


class Supervision(Table, frozen=True):
    """How often a process is restarted; wall seconds. See `actors.supervision.supervised_process`.

    Attributes:
        intensity: Restarts of one process within `period_s`; one more, and it is given up.
        period_s: The window in which they are counted.
        backoff_s: Before the first restart that comes after half of `intensity` in the window; each
            further one waits twice as long ...
        backoff_max_s: ... up to this.
        attempt_s: Between being given up and the next attempt; each that fails doubles it ...
        attempt_max_s: ... up to this.
        spares: Processes in the pool, each ready to become any node.
    """

    intensity: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 50
    period_s: Positive = 60.0
    backoff_s: Positive = 0.05
    backoff_max_s: Positive = 2.0
    attempt_s: Positive = 10.0
    attempt_max_s: Positive = 60.0
    spares: Annotated[int, msgspec.Meta(ge=0, le=16)] = 2
