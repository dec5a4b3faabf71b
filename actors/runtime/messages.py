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

    Modes: `drop` sends nothing; `freeze` repeats the last healthy message with its old stamp;
    `stuck` repeats its body with fresh stamps; `delay` sends `delay_s` later; `duplicate` sends
    the same payload twice; `restamp` adds `stamp_s` to the stamp, as a clock that goes wrong;
    `corrupt` changes fields. The `*_fields` and `keep_ends` count only with corrupt:
    `set_fields` overwrites, `ramp_fields` adds rate * elapsed seconds, `add_fields` adds a bias,
    `noise_fields` adds Gaussian noise of that standard deviation, `keep_ends` shortens
    sequences to their first and last element. A field of a nested struct is named
    `outer.inner`, through sequences too; numbers in sequences and `*_f32` arrays are changed
    element by element, and `*_rad` stays in (-pi, pi].

    Durations are simulated seconds. `duration_s` 0 ends the injection at once; infinity is
    permanent: it lasts as long as the publishing process. `share` is the probability that a
    message is affected. With `on_s` and `off_s` the fault is intermittent: in force for `on_s`,
    away for `off_s`, and so on from the moment of injection. All that is random comes from
    `seed`.
    """

    injection: str
    topic: str
    mode: str
    duration_s: float
    delay_s: float = 0.0
    set_fields: dict[str, Any] = {}
    ramp_fields: dict[str, float] = {}
    keep_ends: tuple[str, ...] = ()
    add_fields: dict[str, float] = {}
    noise_fields: dict[str, float] = {}
    share: float = 1.0
    on_s: float = 0.0
    off_s: float = 0.0
    seed: int = 0
    stamp_s: float = 0.0


class InjectionReport(Message, frozen=True):
    """Where an injection took hold and how many messages it has changed so far."""

    injection: str
    node: str
    affected: int
    finished: bool
    reason: str
