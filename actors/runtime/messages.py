"""Messages that every actor knows: heartbeat, error report, fault injection. No robot here."""

from __future__ import annotations

from typing import Any

import msgspec


class Message(msgspec.Struct, frozen=True, gc=False, forbid_unknown_fields=True):
    """Base of all messages: immutable, and an unknown field makes the payload invalid."""


class Heartbeat(Message, frozen=True):
    """Sent from the actor's own loop; `progress` counts what the mailbox has handled."""

    pid: int
    progress: int
    period_s: float
    rejected_payloads: int
    overflowed: int


class Hello(Message, frozen=True):
    """A node has just started: who has states to tell repeats them now, not at the next period."""


class Diagnostic(Message, frozen=True):
    """An error report: who, in what context, why, and what offended (OTP's four fields)."""

    node: str
    context: str
    reason: str
    offender: str
    count: int


class Injection(Message, frozen=True):
    """A fault to inject where `topic` (key below `rampart/`) is published.

    `mode`: drop, freeze, delay, corrupt. `delay_s` counts only with delay; the rest only with
    corrupt: `set_fields` overwrites fields, `ramp_fields` adds rate * elapsed seconds to them,
    `keep_ends` shortens sequences to their first and last element. A field of a nested struct
    is named `outer.inner`. Durations are simulated seconds; 0 ends the injection at once.
    """

    injection: str
    topic: str
    mode: str
    duration_s: float
    delay_s: float = 0.0
    set_fields: dict[str, Any] = {}
    ramp_fields: dict[str, float] = {}
    keep_ends: tuple[str, ...] = ()


class InjectionReport(Message, frozen=True):
    """Where an injection took hold and how many messages it has changed so far."""

    injection: str
    node: str
    affected: int
    finished: bool
    reason: str
