"""Messages between the root and its clients, the supervisor and `run`.

The supervisor sends each `ForkRequest` as a datagram, and receives one `Reply` to it. Any datagram
also shows that the supervisor's event loop works. `run` sends `FromRun` and receives `FromRoot` as
lines of JSON, which may be of any length.
"""

from __future__ import annotations

import msgspec

from rampart.actors.runtime.run_plan import RunPlan

REQUEST_BYTES = 4096
"""Longest `ForkRequest` or `Reply`: the name of a process, a number, a line."""

ALIVE, WELL = b" ", b"+"
"""Datagrams by which the supervisor shows that it works, and that the FTM Manager works as well."""


class LaunchError(Exception):
    """The run cannot start; the text is one line for the user."""


class ForkRequest(msgspec.Struct, frozen=True):
    """Start a process; `name` is one of its actors."""

    name: str
    incarnation: int


class Reply(msgspec.Struct, frozen=True):
    """The pid of the new process, or 0 and why there is none."""

    request: ForkRequest
    pid: int = 0
    error: str = ""


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """Reserve the resources of a run, and load its system."""

    plan: RunPlan
    title: str


class Start(msgspec.Struct, frozen=True, tag="start"):
    """Start routers and supervisor; simulated time 0 is this reading of the monotonic clock."""

    origin_s: float


class Recording(msgspec.Struct, frozen=True, tag="recording"):
    """The file of the recording, and why nothing more is written to it; the root informs tools."""

    file: str
    problem: str


class End(msgspec.Struct, frozen=True, tag="end"):
    """End all processes of the run in order."""


class Begun(msgspec.Struct, frozen=True, tag="begun"):
    """The plan with folder, ports and root; all actors; and how long loading took, seconds."""

    plan: RunPlan
    names: tuple[str, ...]
    load_s: float


class Done(msgspec.Struct, frozen=True, tag="done"):
    """`Start` or `End` is carried out."""


class Refused(msgspec.Struct, frozen=True, tag="refused"):
    """`Begin` or `Start` failed."""

    why: str


class Restarted(msgspec.Struct, frozen=True, tag="restarted"):
    """The root has restarted the supervisor."""

    name: str


class Trouble(msgspec.Struct, frozen=True, tag="trouble"):
    """A problem of the root, in one line."""

    text: str


class Interrupt(msgspec.Struct, frozen=True, tag="interrupt"):
    """The user wants the run to end, and has sent this signal."""

    signal: str


FromRun = Begin | Start | Recording | End
FromRoot = Begun | Done | Refused | Restarted | Trouble | Interrupt
