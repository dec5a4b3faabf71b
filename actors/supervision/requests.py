"""What the root is asked, and what it answers.

Two kinds of processes ask it. The supervisor sends a `ForkRequest`, one datagram each, and gets one
`Reply` for it; any datagram also shows that the supervisor's loop turns. The process that watches
the run sends `FromRun` and receives `FromRoot`, as lines of
JSON: so no document is too large.
"""

from __future__ import annotations

import msgspec

from rampart.actors.runtime.run_plan import RunPlan

REQUEST_BYTES = 4096
"""Longest `ForkRequest` or `Reply`: the name of a process, a number, a line."""

WORD = b" "
"""The supervisor sends it when it has nothing to ask for."""


class LaunchError(Exception):
    """The run cannot be started; the text is one line for the user."""


class ForkRequest(msgspec.Struct, frozen=True):
    """Start a process: by the name of one of its actors, and its incarnation."""

    name: str
    incarnation: int


class Reply(msgspec.Struct, frozen=True):
    """The new process that was asked for, by its number, or why there is none."""

    request: ForkRequest
    pid: int = 0
    error: str = ""


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """Claim what a run needs, and load it."""

    plan: RunPlan
    title: str


class Start(msgspec.Struct, frozen=True, tag="start"):
    """Start routers and supervisor, with this reading of the monotonic clock as time 0."""

    origin_s: float


class Recording(msgspec.Struct, frozen=True, tag="recording"):
    """Tell tools which file the run is recorded in, and why nothing more is written to it."""

    file: str
    problem: str


class End(msgspec.Struct, frozen=True, tag="end"):
    """End all processes of the run in order."""


class Begun(msgspec.Struct, frozen=True, tag="begun"):
    """The plan with folder, ports and launcher; all actors; and how long loading took, seconds."""

    plan: RunPlan
    names: tuple[str, ...]
    load_s: float


class Done(msgspec.Struct, frozen=True, tag="done"):
    """`Start` or `End` was carried out."""


class Refused(msgspec.Struct, frozen=True, tag="refused"):
    """`Begin` or `Start` was not possible."""

    why: str


class Restarted(msgspec.Struct, frozen=True, tag="restarted"):
    """The root has brought back the supervisor, or a router."""

    name: str


class Trouble(msgspec.Struct, frozen=True, tag="trouble"):
    """Something that the root cannot do, in one line."""

    text: str


class Interrupt(msgspec.Struct, frozen=True, tag="interrupt"):
    """The user wants the run to end: by which signal."""

    signal: str


FromRun = Begin | Start | Recording | End
FromRoot = Begun | Done | Refused | Restarted | Trouble | Interrupt
