"""Fault injection where messages are born: a gate in each actor's publish path.

A fault on a topic acts in the process that publishes it, so every reader sees the same fault,
and it is the real bus that carries (or does not carry) the result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import msgspec

from actors.runtime.messages import Injection
from actors.runtime.topic import ROOT

MODES = ("drop", "freeze", "delay", "corrupt")


@dataclass(slots=True)
class Outgoing:
    """One message as it leaves: `delay_s` is added before it is sent."""

    body: Any
    stamp: float
    delay_s: float = 0.0


@dataclass(slots=True)
class _Active:
    order: Injection
    since_s: float
    affected: int = 0
    frozen: Outgoing | None = None


@dataclass(slots=True)
class FaultGate:
    """The injections in force in one actor. Pure: time is an argument."""

    _active: dict[str, _Active] = field(default_factory=dict)
    _last: dict[str, Outgoing] = field(default_factory=dict)

    def order(self, injection: Injection, now_s: float) -> str:
        """Put an injection in force; return the reason if it cannot be, else an empty text."""
        if injection.mode not in MODES:
            return f"mode = {injection.mode!r}: must be one of {', '.join(MODES)}"
        self._active[injection.injection] = _Active(injection, now_s)
        return ""

    def expire(self, injection: str) -> int:
        """End an injection and return how many messages it changed."""
        active = self._active.pop(injection, None)
        return active.affected if active else 0

    def apply(self, key: str, body: Any, stamp: float, now_s: float) -> Outgoing | None:
        """Return the message as the faults in force leave it, or None if it is dropped.

        Raises:
            ValueError: a corruption names a field that the message does not have.
        """
        out = Outgoing(body, stamp)
        if not self._active:
            return out
        for active in self._active.values():
            if f"{ROOT}/{active.order.topic}" != key:
                continue
            order = active.order
            if order.mode == "drop":
                active.affected += 1
                return None
            if order.mode == "delay":
                out.delay_s += order.delay_s
            elif order.mode == "freeze":
                active.frozen = active.frozen or self._last.get(key) or out
                out = Outgoing(active.frozen.body, active.frozen.stamp, out.delay_s)
            else:
                out.body = corrupt(out.body, order, now_s - active.since_s)
            active.affected += 1
        return out

    def remember(self, key: str, out: Outgoing) -> None:
        """Keep the last message per key, so that a freeze has something to repeat."""
        self._last[key] = out


def corrupt(body: Any, order: Injection, elapsed_s: float) -> Any:
    """Return the body with fields set, ramped and shortened as the order says.

    Raises:
        ValueError: no such field, or the value does not fit it.
    """
    data = msgspec.to_builtins(body, builtin_types=(bytes,))
    for path, value in order.set_fields.items():
        holder, name = _resolve(data, path)
        holder[name] = value
    for path, rate in order.ramp_fields.items():
        holder, name = _resolve(data, path)
        holder[name] = holder[name] + rate * elapsed_s
    for path in order.keep_ends:
        holder, name = _resolve(data, path)
        if len(holder[name]) > 2:
            holder[name] = [holder[name][0], holder[name][-1]]
    try:
        return msgspec.convert(data, type(body), builtin_types=(bytes,))
    except msgspec.ValidationError as error:
        raise ValueError(f"corrupt {type(body).__name__}: {error}") from None


def _resolve(data: dict[str, Any], path: str) -> tuple[dict[str, Any], str]:
    *outer, name = path.split(".")
    holder: Any = data
    for chunk in outer:
        holder = holder.get(chunk) if isinstance(holder, dict) else None
    if not isinstance(holder, dict) or name not in holder:
        raise ValueError(f"field {path!r}: no such field")
    return holder, name
