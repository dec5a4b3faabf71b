"""What goes wrong in a run, and when: faults planned for a time or a point of the mission. Pure.

A planned fault is written `FAULT[@WHEN][+DURATION]`:

* FAULT is a name of the catalogue (`rampart inject --list`), `MODE:TOPIC` for any topic,
  `kill:NODE`, `stop:NODE`, `wedge:NODE`, `slow:NODE[:SECONDS]` or `hang:NODE` for any process,
  `slow:all` for every one at once, as on a machine that is overloaded, `stop:all`, as when a
  container is paused, or one that the robot declares (`Faults.own`), which may have details behind
  a colon, too. `hang` stops each process of the node that there is or will be, right after its
  start.
* WHEN is simulated seconds, or `goalN` for the moment in which goal N of the mission begins,
  or `goalN:SECONDS` for so long after it. Left out it is 10 s.
* DURATION is simulated seconds, or `inf` for the rest of the run. Left out it is the fault's own.
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
"""In place of a node, of `slow` and `stop`: all of them."""
_LASTS_S = {"kill": 0.0, "wedge": math.inf, "stop": 5.0, "slow": 10.0, "hang": math.inf}


class ScenarioError(ValueError):
    """A planned fault that makes no sense; the message is one line."""


class PlannedFault(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fault, when it comes, and how long it stays.

    Args:
        fault: What, as described above, without WHEN and DURATION.
        at_s: Simulated seconds; after the beginning of `goal`, if there is one.
        goal: Goal of the mission, counted from 1; 0 for none.
        duration_s: Simulated seconds; None for the fault's own.
        share: Of the messages that are affected, for faults of topics.
        on_s: For an intermittent fault of a topic: in force so long ...
        off_s: ... and then away so long.
        seed: Of all that is random in it.
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
        """Return it as it is typed; what cannot be typed is put in brackets."""
        when = f"{self.at_s:g}"
        if self.goal:
            when = f"goal{self.goal}:{when}" if self.at_s else f"goal{self.goal}"
        lasts = "" if self.duration_s is None else f"+{self.duration_s:g}"
        more = [f"share {self.share:g}"] if self.share < 1 else []
        if self.on_s or self.off_s:
            more.append(f"on {self.on_s:g} off {self.off_s:g}")
        return f"{self.fault}@{when}{lasts}" + (f" [{', '.join(more)}]" if more else "")


class OnProcess(msgspec.Struct, frozen=True):
    """Something done to the process of a node, "" for those of all; `pace_s` is for slow."""

    what: str
    node: str
    pace_s: float = 0.0
    duration_s: float = 0.0


def parse_fault(text: str) -> PlannedFault:
    """Read `FAULT[@WHEN][+DURATION]`.

    Raises:
        ScenarioError: It is not of this form.
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
    """Return what is to be done: a tuple of `Order`, `OnProcess`, or what the robot knows to do.

    Args:
        planned: The fault.
        injection: Id under which its effect is reported.
        nodes: Names of all nodes with a process that a fault may hit.
        known: All topics of the system, see `system_topics`.
        faults: Of the robot.

    Raises:
        ScenarioError: There is no such node, or the details of the fault make no sense.
        UnknownFaultError: There is no such fault.
    """
    kind, *details = planned.fault.split(":")
    lasts_s = planned.duration_s
    if kind in PROCESS_FAULTS:
        node = details[0] if details else ""
        if kind in ("slow", "stop") and node == ALL:
            node = ""
        elif node not in nodes:
            raise ScenarioError(f"fault {planned.fault!r}: no node {node!r}; there are: "
                                f"{', '.join(nodes)}")
        pace_s = number(planned.fault, details[1:], _SLOW_S, most=60.0) if kind == "slow" else 0.0
        return OnProcess(kind, node, pace_s, _LASTS_S[kind] if lasts_s is None else lasts_s)
    own = faults.own(planned.fault, injection, lasts_s)
    if own is not None:
        return own
    fault = faults.find(planned.fault, planned.seed, known).varied(
        share=planned.share, on_s=planned.on_s, off_s=planned.off_s)
    return tuple(Order(bus_topics.INJECT, order) for order in fault.orders(injection, lasts_s))


def number(fault: str, details: Sequence[str], default: float, most: float = 1.0) -> float:
    """Return the one number in the details of a fault, from 0 to `most`; the default without any.

    Raises:
        ScenarioError: It is none, or out of range, or there is more.
    """
    if not details:
        return default
    value = _number(details[0])
    if not 0 <= value <= most or len(details) > 1:
        raise ScenarioError(f"fault {fault!r}: {':'.join(details)!r}: must be one number "
                            f"between 0 and {most:g}")
    return value


def _number(text: str) -> float:
    """Return the number in a text, which is none (nan) of one that is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


class FaultOutcome(msgspec.Struct, frozen=True):
    """What became of a planned fault.

    Attributes:
        fault: As planned, in text.
        injected_s: When it was injected, simulated seconds; None if its moment never came.
        affected: How many messages or ticks it changed, or 1 for a process or an obstacle.
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
