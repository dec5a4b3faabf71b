"""Named faults of a robot, and the search for any fault by its name.

Every system has `MODE:TOPIC` (`topic_faults`) and faults of processes (`scenario`).
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import msgspec

from rampart.actors.bus.topic import Topic
from rampart.actors.ftm.messages import FaultOrder, NamedFault
from rampart.actors.runtime.injection import flaw
from rampart.actors.system.layout import published_keys
from rampart.actors.system.members import application_class, import_class
from rampart.actors.system.topics import find_topic, system_topics
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.faults.topic_faults import (
    NONSENSE,
    READING,
    Disturbance,
    Fault,
    Sizes,
    UnknownFaultError,
    closed,
    topic_fault,
)

PROCESS_FAULTS = ("kill", "stop", "wedge", "slow", "hang")

_FILLED_IN_S = 0.0
"""Duration of an order in the plan; the page fills it in."""


class Faults:
    """Faults of a robot; a robot with named faults has a derived class.

    Class attributes:
        named: Disturbances of topics by name; the group of each is its kind.
        others: By kind, faults that do not disturb topics, as a campaign draws them.
        titled: Those of `others` that the operator's page offers: name → kind and title.
        kinds: All kinds with their titles, in the order of tables.
        sizes: Sizes of errors that count before those of the fields.
    """

    named: Mapping[str, Fault] = {}
    others: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    titled: ClassVar[Mapping[str, tuple[str, str]]] = {}
    kinds: Mapping[str, str] = {"none": "no fault", "topic": "topics",
                                "reading": "nonsense readings", "process": "processes",
                                "several": "several at once"}
    sizes: ClassVar[Sizes] = Sizes()

    def own(self, fault: str, injection: str, duration_s: float | None) -> object | None:
        """Return the action of a fault that does not disturb a topic; None for other names.

        Args:
            fault: Name with its details.
            injection: Id under which its effect is reported.
            duration_s: Simulated seconds; None for the default.

        Returns:
            A tuple of `Order`, or an object that the robot's injector carries out.

        Raises:
            ScenarioError: The details are invalid.
        """
        del fault, injection, duration_s
        return None

    def find(self, name: str, seed: int, known: Sequence[Topic[Any]]) -> Fault:
        """Return a fault on topics by name: one of the robot's, or `MODE:TOPIC`.

        Args:
            name: As typed.
            seed: Of its random parts.
            known: All topics of the system, see `system_topics`.

        Raises:
            UnknownFaultError: There is no fault of this name.
        """
        if name in self.named:
            return self.named[name].varied(seed=seed)
        mode, colon, key = name.partition(":")
        if colon:
            return topic_fault(mode, key, seed, known, self.sizes)
        near = difflib.get_close_matches(name, self.named, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise UnknownFaultError(
            f"unknown fault {name!r}; {hint}`rampart inject --list` lists the known ones")

    def kind_of(self, name: str) -> str:
        """Return the kind of a fault, one of `kinds`."""
        if name in self.named:
            return self.named[name].group
        prefix = name.partition(":")[0]
        if prefix in PROCESS_FAULTS:
            return "process"
        if prefix in NONSENSE:
            return READING
        return next((kind for kind, names in self.others.items()
                     if any(other.partition(":")[0] == prefix for other in names)), "topic")

    def offered(self) -> tuple[NamedFault, ...]:
        """Return the faults that the operator's page offers by name, as data for a run's plan.

        The page itself has crashes of nodes, and composes `MODE:TOPIC`.
        """
        found = [NamedFault(f.name, f.title, f.group, _for_the_plan(f.duration_s),
                            injections=f.orders("", _FILLED_IN_S))
                 for f in self.named.values()]
        for name, (kind, title) in self.titled.items():
            orders = self.own(name, "", None)
            if not isinstance(orders, tuple):
                raise TypeError(f"{name}: the page can only publish; expected a tuple of orders")
            lasts_s = _for_the_plan(orders[0].message.duration_s)
            plain = [o.with_(duration_s=_FILLED_IN_S) for o in orders]
            found.append(NamedFault(name, title, kind, lasts_s, orders=tuple(
                FaultOrder(o.topic.key, msgspec.json.encode(o.message).decode()) for o in plain)))
        return tuple(found)


def _for_the_plan(lasts_s: float) -> float | None:
    """Return a duration for the plan, since JSON has no infinity; None for permanent."""
    return None if math.isinf(lasts_s) else lasts_s


def faults_of(spec: SystemSpec) -> Faults:
    """Return the faults of a system's robot.

    Raises:
        ValueError: The application or its class of faults does not exist, or a fault of the
            specification is invalid.
    """
    path = application_class(spec).faults
    found = import_class(path, Faults, "faults")() if path else Faults()
    if not spec.faults:
        return found
    found.named = {**found.named, **_specified(spec, found)}
    more = {row.kind: f"{row.kind} faults" for row in spec.faults}
    found.kinds = {**found.kinds, **{kind: title for kind, title in more.items()
                                     if kind not in found.kinds}}
    return found


def _specified(spec: SystemSpec, faults: Faults) -> dict[str, Fault]:
    known, published = system_topics(spec), published_keys(spec)
    made = {}
    for row in spec.faults:
        what = Disturbance(
            row.topic, row.mode, row.delay_s, set_fields=row.set, ramp_fields=row.ramp,
            keep_ends=row.keep_ends, add_fields=row.add, noise_fields=row.noise,
            stamp_s=row.stamp_s)
        topic = find_topic(row.topic, known)
        if row.name in faults.named:
            raise ValueError(f"fault {row.name}: the robot has a fault of this name already")
        reason = closed(row.topic)
        if topic is None or not (reason or row.topic in published):
            near = difflib.get_close_matches(row.topic, published, 3)
            hint = f"; the nearest: {', '.join(near)}" if near else ""
            raise ValueError(f"fault {row.name}: topic = {row.topic!r}: no node publishes it{hint}")
        if reason := reason or flaw(what.order("", row.duration_s), topic.type):
            raise ValueError(f"fault {row.name}: {reason}")
        made[row.name] = Fault(row.name, row.title, (what,), row.detected_by, row.duration_s,
                               row.kind)
    return made
