"""The base of all tables of a system spec, its errors, and the tables without references.

The other tables are in `rampart.manager.spec.schema`.
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
"""The address of a node's socket has no room for more (`rampart.actors.bus.run_folder`)."""

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]

DERIVED = math.nan
"""Default of a timing value that is derived; numbers in a file are finite."""

_LONGEST_SHOWN = 200
"""Characters of a value in a message."""

Row = TypeVar("Row")


class SpecificationError(ValueError):
    """A system spec is refused. The message is one line.

    Attributes:
        file: Name of the file, as given by the caller.
        path: Place in the file, e.g. `mechanism FTM2: detect`.
        problem: What is wrong, and what was expected.
    """

    def __init__(self, file: str, path: str, problem: str, *value: object) -> None:
        self.file = file
        self.path = path
        self.problem = problem
        given = f" = {shown(value[0], _LONGEST_SHOWN)}" if value else ""
        super().__init__(one_line(f"{file}: {path}{given}: {problem}"))


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all tables of a spec: immutable; an unknown field is an error."""


class Timing(Table, frozen=True):
    """All times, in seconds; values that default to `DERIVED` follow from the robot.

    In a system without a [robot] they are five periods of the awaited messages (`PERIODS`).

    Attributes:
        heartbeat_period_s: Between two heartbeats of an actor.
        control_period_s: Between two commands, poses or scans.
        manager_period_s: Between two statuses of the FTM Manager.
        detection_period_s: Between two reports of a detection module in the same state.
        arbitration_s: From sending a detection report to receiving the recovery's command.
        actuation_s: From receiving a recovery's command to its effect on the wheels.
        respawn_s: From the detection of a node's death to its first useful message.
        heartbeat_timeout_s: A node without heartbeat for this long counts as crashed.
        command_timeout_s: A command older than this is stale.
        localization_timeout_s: A pose older than this is stale.
        scan_timeout_s: The Safety Pilot stops if the last laser scan is older than this.
        dead_man_timeout_s: The base brakes by itself without a command for this long.
        manager_timeout_s: The Safety Pilot stops without manager status for this long.
        detection_silence_timeout_s: A detection module without report for this long counts as
            active.
        startup_grace_s: Time that a module has for its first report.
        release_hold_s: A detection module has to stay idle for this long before its mechanism is.
        release_hold_max_s: To which this hold grows while the module flaps.
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
"""The period of the messages that each timeout of `[timing]` waits for."""

FAILOVER_S = 0.3
"""Longest gap in messages when a router dies, real seconds: usually some milliseconds; 0.26 s were
measured after a router had been stopped."""

GUARDED = frozenset({"heartbeat_timeout_s", "command_timeout_s", "localization_timeout_s"})
"""Timeouts of detection modules and the supervisor, which allow for that gap themselves."""


class Layers(Table, frozen=True):
    """Protection layers; each can be switched off, for the paper's unprotected baseline.

    Attributes:
        dead_man: The base brakes when commands cease.
        safety_pilot_checks: The Safety Pilot refuses commands out of bounds, stale or out of
            sequence. It stops for obstacles in any case.
        manager_watch: The Safety Pilot stops when the FTM Manager is silent.
        supervisor_respawn: The supervisor restarts the nodes that no recovery module restarts.
        ftm: Detection modules, recovery modules and the FTM Manager run.
        checkpoints: Nodes keep their state on stable storage and continue with it.
    """

    dead_man: bool = True
    safety_pilot_checks: bool = True
    manager_watch: bool = True
    supervisor_respawn: bool = True
    ftm: bool = True
    checkpoints: bool = True


class End(Table, frozen=True):
    """When a run of the system ends.

    Attributes:
        after_s: Simulated seconds, unless the command line has others; None for no end.
    """

    after_s: Positive | None = None


class Finding(NamedTuple):
    """A problem: place, what is wrong and expected, and the value if there is one."""

    path: str
    problem: str
    value: tuple[Any, ...] = ()


_NAME = re.compile(r"[A-Za-z][\w-]{0,63}\Z", re.ASCII)
_IN_A_ROW = re.compile(r"\$\.(node|detection|recovery|mechanism|event|fault|host)\[(\d+)\](\.|\Z)")


def by_name(path: str, document: Mapping[str, Any]) -> str:
    """Return a path such as `$.node[2].kind` with the row's name: `node pump: kind`.

    The path stays as it is if it is not in such a row, or the row has no name.
    """
    found = _IN_A_ROW.match(path)
    if not found or path.endswith("].name"):  # duplicate names need the place
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
    """Return the finding for an unknown name; it lists the known ones."""
    return Finding(path, f"unknown {what}; known: {', '.join(known) or 'none'}", (value,))


def find_wrong_names(path: str, names: Iterable[str], what: str, known: Collection[str],
                     again: str) -> Iterator[Finding]:
    """Find names in a list that are unknown, or listed twice, which `again` says."""
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


class BlackBox(Table, frozen=True):
    """A black box, and what it keeps around faults. See `rampart.actors.recording.black_box`.

    Attributes:
        before_s: Simulated seconds that are kept before a decision on a fault, the failure of a
            process, or the sudden end of a run.
        after_s: Simulated seconds that are kept after it.
        limit_mb: Largest size of all files of the system.
    """

    before_s: Annotated[float, msgspec.Meta(ge=1, le=600)] = 60.0
    after_s: Annotated[float, msgspec.Meta(ge=1, le=600)] = 15.0
    limit_mb: Annotated[float, msgspec.Meta(ge=0.5, le=1_000_000)] = 256.0


class Supervision(Table, frozen=True):
    """Limits of restarts; real seconds. See `rampart.actors.supervision.supervised_process`.

    Attributes:
        intensity: Restarts of one process within `period_s`; at one more it is given up.
        period_s: The window in which restarts are counted.
        backoff_s: Wait before a restart once half of `intensity` is used up; each further restart
            waits twice as long.
        backoff_max_s: Longest such wait.
        attempt_s: Wait from giving up to the next attempt; each failure doubles it.
        attempt_max_s: Longest such wait.
        spares: Number of processes in the pool, each ready to become any node.
    """

    intensity: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 50
    period_s: Positive = 60.0
    backoff_s: Positive = 0.05
    backoff_max_s: Positive = 2.0
    attempt_s: Positive = 10.0
    attempt_max_s: Positive = 60.0
    spares: Annotated[int, msgspec.Meta(ge=0, le=16)] = 2
