"""Declarations of an actor's class: its topics, timers and peers.

`rampart.actors.system.members` computes the connections of a system from them, before any actor is
made.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, TypeVar

import msgspec

from rampart.actors.bus.topic import Members, Topic
from rampart.actors.bus.topics import DIAGNOSTIC, HEARTBEAT, INJECT, INJECTION_REPORT
from rampart.actors.runtime.parameters import Named, topics_named
from rampart.manager.spec.schema import SystemSpec

F = TypeVar("F", bound=Callable[..., None])


BASE_OUTPUTS: tuple[Topic[Any], ...] = (HEARTBEAT, DIAGNOSTIC, INJECTION_REPORT)
"""Topics that every actor publishes besides its outputs."""

BASE_INPUTS: tuple[Topic[Any], ...] = (INJECT,)
"""Topics that every actor subscribes to besides its inputs: injections from tools."""


def on(topic: Topic[Any]) -> Callable[[F], F]:
    """Declare a method as the handler of a topic: `handler(self, message, header)`.

    Raises:
        TypeError: the argument is not a topic.
    """
    if not isinstance(topic, Topic):
        raise TypeError(f"@on({getattr(topic, '__name__', topic)}): expected a Topic")

    def mark(function: F) -> F:
        function.__dict__.setdefault("_rampart_topics", []).append(topic)
        return function

    return mark


def every(period_s: float, *, with_heartbeat: bool = False) -> Callable[[F], F]:
    """Declare a method to be called every `period_s` simulated seconds, first after one period.

    Args:
        period_s: simulated seconds.
        with_heartbeat: whether to call it with each heartbeat instead, if the period of heartbeats
            is not longer than `period_s`. Then the process wakes up once instead of twice.

    Raises:
        ValueError: the period is not a finite number above 0.
    """
    if not isinstance(period_s, int | float) or not 0 < period_s < math.inf:
        raise ValueError(f"@every({getattr(period_s, '__name__', period_s)}): expected a period "
                         "above 0, in simulated seconds")

    def mark(function: F) -> F:
        function.__dict__["_rampart_period_s"] = period_s
        function.__dict__["_rampart_with_heartbeat"] = with_heartbeat
        return function

    return mark


def _is_marked(member: object) -> bool:
    return hasattr(member, "_rampart_topics") or hasattr(member, "_rampart_period_s")


def _has_unmarked(base: type, name: str) -> bool:
    """Whether a class defines or annotates a name that is not a handler."""
    found = vars(base)
    return (name in found and not _is_marked(found[name])) or name in found.get(
        "__annotations__", {})


class Handlers:
    """Base of classes with methods that are marked by `on` or `every`.

    Class attributes:
        optional_inputs: inputs that no node of the system needs to publish. An unpublished input
            that is not listed here is refused before a run, as a typo.
    """

    optional_inputs: ClassVar[tuple[Topic[Any], ...]] = ()
    _handlers: ClassVar[tuple[tuple[Topic[Any], str], ...]] = ()
    _periodic: ClassVar[tuple[tuple[float, str], ...]] = ()
    _with_heartbeat: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, member in vars(cls).items():
            if _is_marked(member) and (base := next(
                    (b for b in cls.__mro__[1:] if _has_unmarked(b, name)), None)):
                raise TypeError(f"{cls.__name__}.{name}: {base.__name__} has this name already; "
                                "expected another name for the handler")
        handlers: dict[tuple[str, str], tuple[Topic[Any], str]] = {}
        periodic: dict[str, float] = {}
        beside: set[str] = set()
        for base in reversed(cls.__mro__):
            for name, member in vars(base).items():
                for topic in getattr(member, "_rampart_topics", ()):
                    handlers[(topic.key, name)] = (topic, name)
                if hasattr(member, "_rampart_period_s"):
                    periodic[name] = member._rampart_period_s
                    if member._rampart_with_heartbeat:
                        beside.add(name)
        for name, arguments in (*((name, 3) for _, name in handlers.values()),
                                *((name, 1) for name in periodic)):
            _check_call(cls, name, arguments)
        cls._handlers = tuple(handlers.values())
        cls._periodic = tuple((period, name) for name, period in periodic.items())
        cls._with_heartbeat = frozenset(beside)

    @classmethod
    def inputs(cls) -> tuple[Topic[Any], ...]:
        """Return the topics with handlers; of an actor, `BASE_INPUTS` are among them."""
        return tuple(dict.fromkeys(topic for topic, _ in cls._handlers))


_SIGNATURES = {1: "(self)", 3: "(self, message, header)"}


def _check_call(cls: type, name: str, arguments: int) -> None:
    """Raise TypeError for a handler that cannot be called, or never runs when it is called."""
    function = getattr(cls, name)
    what = f"{cls.__name__}.{name}"
    if inspect.iscoroutinefunction(function):
        raise TypeError(f"{what} is an async def and would never run; expected a plain def")
    if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
        raise TypeError(f"{what} has a yield and would never run; expected a plain def")
    try:
        inspect.signature(function).bind(*range(arguments))
    except TypeError:
        raise TypeError(f"{what}: expected def {name}{_SIGNATURES[arguments]}") from None


class Declared(Handlers):
    """Declarations that all actors have.

    Class attributes:
        outputs: topics it publishes; publishing another one raises.
        node_kind: the `kind` that its nodes must have, or "".
        tables: tables of a specification whose rows become its parameters, by `given`.
        is_page: whether it is an operator's page.
        Parameters: parameters in the specification, with type, range and default. A class with
            more parameters derives its own from its base class's.
    """

    class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        """No parameters."""

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = ()
    node_kind: ClassVar[str] = ""
    tables: ClassVar[tuple[str, ...]] = ()
    is_page: ClassVar[bool] = False

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:  # noqa: ARG003
        """Return the members of an input family that a node subscribes to, None for all.

        Args:
            topic: one of its inputs.
            name: name of the node.
            parameters: the node's `Parameters`.
        """
        return None

    @classmethod
    def output_names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:  # noqa: ARG003
        """Return the members of an output family that a node publishes, None for any."""
        return (name,)

    @classmethod
    def own_keys(cls, parameters: Any) -> tuple[str, ...]:  # noqa: ARG003
        """Return the keys below `rampart/` between the node and a program that it starts."""
        return ()

    @classmethod
    def own_topics(cls, parameters: Any) -> tuple[Topic[Any], ...]:  # noqa: ARG003
        """Return the topics that its parameters define, unless another class defines them.

        Raises:
            ValueError: a definition is wrong.
        """
        return ()

    @classmethod
    def given(cls, name: str, spec: SystemSpec, file: str) -> Mapping[str, Any]:  # noqa: ARG003
        """Return the parameters that a node gets from rows of the specification.

        Args:
            name: name of the node.
            spec: the system.
            file: name of the specification, for messages.

        Raises:
            ValueError: a row is wrong; one line with file and path.
        """
        return {}

    @classmethod
    def completed(cls, parameters: Any, topics: Iterable[Topic[Any]],
                  ordered: Iterable[str]) -> Any:
        """Return its parameters, completed by the whole system.

        Args:
            parameters: the node's `Parameters`.
            topics: topics that the system's other nodes publish, pages excepted.
            ordered: keys of topics on which the run orders faults.
        """
        del topics, ordered
        return parameters

    @classmethod
    def named(cls, parameters: Any) -> dict[str, list[Named]]:
        """Return the topics that its parameters name, by "heard" and "published"."""
        return topics_named(parameters)

    @classmethod
    def alone_on(cls, parameters: Any) -> Mapping[str, str]:  # noqa: ARG003
        """Return the keys on which no other node may publish; each with its cause, for messages."""
        return {}

    @classmethod
    def on_wall_clock(cls, parameters: Any) -> bool:  # noqa: ARG003
        """Whether it exchanges messages with a robot for which a simulated second is a real one."""
        return False

    @classmethod
    def check_topics(cls, parameters: Any, topics: Mapping[str, Topic[Any]]) -> None:
        """Check parameters against the topics that they name.

        Args:
            parameters: the node's `Parameters`.
            topics: topics of the system, by key.

        Raises:
            ValueError: a parameter does not fit its topic.
        """

    @classmethod
    def published(cls, key: str, name: str, parameters: Any) -> Topic[Any] | None:
        """Return the topic of a key below `rampart/`, if the node `name` publishes it."""
        for topic in (*cls.outputs, *BASE_OUTPUTS):
            member = topic.member(key)
            if member is not None:
                names = cls.output_names(topic, name, parameters) if member else None
                if names is None or member in names:
                    return topic
        return None
