"""Planned faults of a run, at a time or a point of the mission. Pure.

A planned fault is written `FAULT[@WHEN][+DURATION]`:

* FAULT is a name of the catalogue (`rampart inject --list`), `MODE:TOPIC` for any topic, or a fault
  of a process: `kill:NODE`, `stop:NODE`, `wedge:NODE`, `slow:NODE[:SECONDS]`, `hang:NODE`. `hang`
  stops each present and future process of the node right after its start. `slow:all` (an overloaded
  machine) and `stop:all` (a paused container) hit all processes. A robot may declare further faults
  with details behind a colon (`Faults.own`).
* WHEN is simulated seconds; `goalN` for the beginning of goal N of the mission; or `goalN:SECONDS`
  for a time after it. The default is 10 s.
* DURATION is simulated seconds, or `inf` for the rest of the run. The default is the fault's own.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Topic
from rampart.actors.runtime.fault_watch import Order
from rampart.sim.faults.faults import PROCESS_FAULTS, Faults

DEFAULT_AT_S = 10.0

_MAX_DIGITS = 9
_SLOW_S = 0.1
ALL = "all"
"""Stands for all nodes, in `slow` and `stop`."""
_LASTS_S = {"kill": 0.0, "wedge": math.inf, "stop": 5.0, "slow": 10.0, "hang": math.inf}


class ScenarioError(ValueError):
    """An invalid planned fault; the message is one line."""


class PlannedFault(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fault with its time and duration.

    Args:
        fault: FAULT as above, without WHEN and DURATION.
        at_s: Simulated seconds; after the beginning of `goal`, if there is one.
        goal: Goal of the mission, counted from 1; 0 for none.
        duration_s: Simulated seconds; None for the fault's own.
        share: Share of messages that a fault of a topic affects.
        on_s: How long an intermittent fault of a topic is in force ...
        off_s: ... and then absent.
        seed: Of its random parts.
    """

    fault: str
    at_s: float = DEFAULT_AT_S
    goal: int = 0
    duration_s: float | None = None
    share: float = 1.0
    on_s: float = 0.0
    off_s: float = 0.0
    seed: int = 0

    def text(self) -> str:
        """Return it as typed, with the rest in brackets."""
        when = f"{self.at_s:g}"
        if self.goal:
            when = f"goal{self.goal}:{when}" if self.at_s else f"goal{self.goal}"
        lasts = "" if self.duration_s is None else f"+{self.duration_s:g}"
        more = [f"share {self.share:g}"] if self.share < 1 else []
        if self.on_s or self.off_s:
            more.append(f"on {self.on_s:g} off {self.off_s:g}")
        return f"{self.fault}@{when}{lasts}" + (f" [{', '.join(more)}]" if more else "")


class OnProcess(msgspec.Struct, frozen=True):
    """An action on the process of a node, "" for all; `pace_s` is for `slow`."""

    what: str
    node: str
    pace_s: float = 0.0
    duration_s: float = 0.0


def parse_fault(text: str) -> PlannedFault:
    """Read `FAULT[@WHEN][+DURATION]`.

    Raises:
        ScenarioError: The text has another form.
    """
    rest, plus, lasts = text.strip().partition("+")
    fault, at, when = rest.partition("@")
    if not fault:
        raise ScenarioError(f"fault {text!r}: must be FAULT[@WHEN][+DURATION], e.g. "
                            "kill:NODE@30 or drop:TOPIC@goal2+5")
    duration_s = _seconds(text, lasts, "DURATION", infinite=True) if plus else None
    if not at:
        return PlannedFault(fault, duration_s=duration_s)
    if not when.startswith("goal"):
        return PlannedFault(fault, _seconds(text, when, "WHEN"), duration_s=duration_s)
    number, colon, after = when.removeprefix("goal").partition(":")
    if not number.isdecimal() or len(number) > _MAX_DIGITS or int(number) < 1:
        raise ScenarioError(f"fault {text!r}: goal{number}: goals are counted from 1")
    return PlannedFault(fault, _seconds(text, after, "WHEN") if colon else 0.0, int(number),
                        duration_s)


def _seconds(text: str, value: str, what: str, *, infinite: bool = False) -> float:
    seconds = _number(value)
    if not seconds >= 0 or (not infinite and math.isinf(seconds)):
        raise ScenarioError(f"fault {text!r}: {what} {value!r}: must be simulated seconds"
                            + (", or inf" if infinite else ", or goalN, or goalN:SECONDS"))
    return seconds


def action_of(planned: PlannedFault, injection: str, nodes: Collection[str],
              known: Sequence[Topic[Any]], faults: Faults) -> object:
    """Return the action of a fault: a tuple of `Order`, `OnProcess`, or an action of the robot.

    Args:
        planned: The fault.
        injection: Id under which its effect is reported.
        nodes: Nodes whose processes a fault may hit.
        known: All topics of the system, see `system_topics`.
        faults: Of the robot.

    Raises:
        ScenarioError: The node is unknown, or the details of the fault are invalid.
        UnknownFaultError: The fault is unknown.
    """
    kind, *details = planned.fault.split(":")
    lasts_s = planned.duration_s
    if kind in PROCESS_FAULTS:
        node = details[0] if details else ""
        if kind in ("slow", "stop") and node == ALL:
            node = ""
        elif node not in nodes:
            raise ScenarioError(f"fault {planned.fault!r}: no node {node!r} that a fault can hit; "
                                f"there are: {', '.join(nodes)} (not the world: it stands for the "
                                "real one, and nothing could restart it)")
        pace_s = number(planned.fault, details[1:], _SLOW_S, most=60.0) if kind == "slow" else 0.0
        return OnProcess(kind, node, pace_s, _LASTS_S[kind] if lasts_s is None else lasts_s)
    own = faults.own(planned.fault, injection, lasts_s)
    if own is not None:
        return own
    fault = faults.find(planned.fault, planned.seed, known).varied(
        share=planned.share, on_s=planned.on_s, off_s=planned.off_s)
    return tuple(Order(bus_topics.INJECT, order) for order in fault.orders(injection, lasts_s))


def number(fault: str, details: Sequence[str], default: float, most: float = 1.0) -> float:
    """Return the only detail of a fault, a number from 0 to `most`; the default without details.

    Raises:
        ScenarioError: It is not a number, out of range, or not the only detail.
    """
    if not details:
        return default
    value = _number(details[0])
    if not 0 <= value <= most or len(details) > 1:
        raise ScenarioError(f"fault {fault!r}: {':'.join(details)!r}: must be one number "
                            f"between 0 and {most:g}")
    return value


def _number(text: str) -> float:
    """Return the number in a text, NaN if there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


class FaultOutcome(msgspec.Struct, frozen=True):
    """Effect of a planned fault.

    Attributes:
        fault: As planned, in text.
        injected_s: When it was injected, simulated seconds; None if it was not.
        affected: Number of messages or ticks that it changed, or 1 for a process or an obstacle.
        reason: Why it had no effect, else empty.
    """

    fault: str
    injected_s: float | None = None
    affected: int = 0
    reason: str = ""

    @property
    def effective(self) -> bool:
        """Whether it changed anything."""
        return self.affected > 0
