"""Messages of every actor: heartbeat, error report, fault injection."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from rampart.actors.bus.bounds import (
    Count,
    Duration,
    Lasting,
    Name,
    Names,
    Pid,
    Seconds,
    Text,
    Whole,
    oversized,
)

_Changes = Annotated[dict[Name, float], msgspec.Meta(max_length=64)]
_Values = Annotated[dict[Name, Any], msgspec.Meta(max_length=64)]

_VALUES_BYTES = 300_000
"""The longest value to set is a whole sweep of a laser."""

_VALUES_DEPTH = 6


ON_TIME = 0.0
"""Lateness in virtual time. msgspec compares defaults by identity, so it leaves out a field that
holds this object."""


class Message(msgspec.Struct, frozen=True, gc=False, forbid_unknown_fields=True):
    """Base of all messages: immutable, and an unknown field makes the payload invalid."""


class Heartbeat(Message, frozen=True, omit_defaults=True):
    """Sent from the actor's own loop; `progress` counts what the mailbox has handled.

    `late_s` is how late that loop was at most in the last two periods, simulated seconds; it is
    left out if none was.
    """

    pid: Pid
    progress: Count
    period_s: Duration
    rejected_payloads: Count
    overflowed: Count
    late_s: Seconds = ON_TIME


class Diagnostic(Message, frozen=True):
    """An error report: who, in what context, why, and what offended (OTP's four fields)."""

    node: Name
    context: Text
    reason: Text
    offender: Text
    count: Count


class Injection(Message, frozen=True):
    """A fault to inject where `topic` (key below `rampart/`) is published.

    Modes: `drop` sends nothing; `freeze` repeats the last healthy message with its old stamp;
    `stuck` repeats its body with fresh stamps; `delay` sends `delay_s` later; `duplicate` sends
    the same payload twice; `restamp` adds `stamp_s` to the stamp, as a clock that goes wrong;
    `corrupt` changes fields. The `*_fields` and `keep_ends` count only with corrupt:
    `set_fields` overwrites (one number fills a sequence or an array), `ramp_fields` adds rate *
    elapsed seconds, `add_fields` adds a bias, `noise_fields` adds Gaussian noise of that standard
    deviation, `keep_ends` shortens sequences and arrays to their first and last element. A field
    of a nested struct is named `outer.inner`, through sequences too; numbers in sequences and
    `*_f32` arrays are changed element by element, and `*_rad` stays in (-pi, pi].

    Durations are simulated seconds. `duration_s` 0 ends the injection at once; infinity is
    permanent: it lasts as long as the publishing process. `share` is the probability that a
    message is affected. With `on_s` and `off_s` the fault is intermittent: in force for `on_s`,
    away for `off_s`, and so on from the moment of injection. All that is random comes from
    `seed`.
    """

    injection: Name
    topic: Name
    mode: Name
    duration_s: Lasting
    delay_s: Duration = 0.0
    set_fields: _Values = {}
    ramp_fields: _Changes = {}
    keep_ends: Names = ()
    add_fields: _Changes = {}
    noise_fields: _Changes = {}
    share: float = 1.0
    on_s: Duration = 0.0
    off_s: Duration = 0.0
    seed: Whole = 0
    stamp_s: Seconds = 0.0

    def __post_init__(self) -> None:
        """Refuse values to set that are larger than any message; `Any` has no bound of its own.

        Raises:
            ValueError: they are.
        """
        if self.set_fields and oversized(self.set_fields, _VALUES_BYTES, _VALUES_DEPTH):
            raise ValueError(f"set_fields: more than {_VALUES_BYTES} bytes, or nested more than "
                             f"{_VALUES_DEPTH} deep")


class InjectionReport(Message, frozen=True):
    """Where an injection took hold and how many messages it has changed so far."""

    injection: Name
    node: Name
    affected: Count
    finished: bool
    reason: Text
