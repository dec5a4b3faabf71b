"""What the class of an actor declares: the topics it hears and publishes, its timers, its peers.

`rampart.actors.system.members` computes from it who talks with whom, before any actor is made.
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
"""What every actor publishes besides its own outputs."""

BASE_INPUTS: tuple[Topic[Any], ...] = (INJECT,)
"""What every actor hears besides its own inputs: injections from tools."""


def on(topic: Topic[Any]) -> Callable[[F], F]:
    """Declare a method as the handler of a topic: `handler(self, message, header)`.

    Raises:
        TypeError: what it is given is no topic.
    """
    if not isinstance(topic, Topic):
        raise TypeError(f"@on({getattr(topic, '__name__', topic)}): a Topic is right")

    def mark(function: F) -> F:
        function.__dict__.setdefault("_rampart_topics", []).append(topic)
        return function

    return mark


def every(period_s: float, *, with_heartbeat: bool = False) -> Callable[[F], F]:
    """Declare a method to be called each `period_s` simulated seconds, first after one period.

    Args:
        period_s: simulated seconds.
        with_heartbeat: it may be called more often: with each heartbeat, if these come as often as
            `period_s`. That wakes the process once instead of twice.

    Raises:
        ValueError: the period is no time that can pass.
    """
    if not isinstance(period_s, int | float) or not 0 < period_s < math.inf:
        raise ValueError(f"@every({getattr(period_s, '__name__', period_s)}): a period above 0, in "
                         "simulated seconds, is right")

    def mark(function: F) -> F:
        function.__dict__["_rampart_period_s"] = period_s
        function.__dict__["_rampart_with_heartbeat"] = with_heartbeat
        return function

    return mark


def _is_marked(member: object) -> bool:
    return hasattr(member, "_rampart_topics") or hasattr(member, "_rampart_period_s")


def _has_unmarked(base: type, name: str) -> bool:
    """Whether a class has something of a name, or promises it, that is no handler."""
    found = vars(base)
    return (name in found and not _is_marked(found[name])) or name in found.get(
        "__annotations__", {})


class Handlers:
    """Base of what hears topics by methods that are marked with `on`, or acts by `every`.

    Class attributes:
        optional_inputs: topics that it hears where somebody publishes them, and does without where
            nobody does. Of all others that is refused before a run: it is a typo.
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
                raise TypeError(f"{cls.__name__}.{name}: {base.__name__} has something of this "
                                "name already; call the handler something else")
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
        """Topics it has handlers for, of an actor those that every actor hears included."""
        return tuple(dict.fromkeys(topic for topic, _ in cls._handlers))


_OF_HANDLER = {1: "(self)", 3: "(self, message, header)"}


def _check_call(cls: type, name: str, arguments: int) -> None:
    """Refuse a handler that does nothing when it is called, or cannot be called.

    Raises:
        TypeError: it is one.
    """
    function = getattr(cls, name)
    what = f"{cls.__name__}.{name}"
    if inspect.iscoroutinefunction(function):
        raise TypeError(f"{what} is an async def, which would never run; a handler is a plain def")
    if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
        raise TypeError(f"{what} has a yield, and would never run; a handler is a plain def")
    try:
        inspect.signature(function).bind(*range(arguments))
    except TypeError:
        raise TypeError(f"{what}: def {name}{_OF_HANDLER[arguments]} is right") from None


class Declared(Handlers):
    """Base of all actors, as far as their classes alone tell.

    Class attributes:
        outputs: topics it publishes; publishing another one raises.
        node_kind: what a node of this class has to be, "" for anything.
        tables: those of a specification whose rows it is given.
        is_page: whether an operator works with it.
        Parameters: what the system spec may say of it, by field: type, range and default. A class
            that takes more derives its own from that of its base class.
    """

    class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        """None, unless a subclass declares some."""

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = ()
    node_kind: ClassVar[str] = ""
    tables: ClassVar[tuple[str, ...]] = ()
    is_page: ClassVar[bool] = False

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:  # noqa: ARG003
        """Which members of an input family a node hears, None for all.

        Args:
            topic: one of its inputs.
            name: of the node.
            parameters: of the node, as its class's `Parameters`.
        """
        return None

    @classmethod
    def output_names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:  # noqa: ARG003
        """Which members of an output family a node publishes, likewise; None for any."""
        return (name,)

    @classmethod
    def own_keys(cls, parameters: Any) -> tuple[str, ...]:  # noqa: ARG003
        """Keys below `rampart/` that are no topics, between the node and what it has started."""
        return ()

    @classmethod
    def own_topics(cls, parameters: Any) -> tuple[Topic[Any], ...]:  # noqa: ARG003
        """Topics that there are because its parameters say so, unless another class has them.

        Raises:
            ValueError: they make no sense.
        """
        return ()

    @classmethod
    def given(cls, name: str, spec: SystemSpec, file: str) -> Mapping[str, Any]:  # noqa: ARG003
        """Parameters of the node `name` that are made of rows of the specification.

        Args:
            name: of the node.
            spec: the system.
            file: name of the specification, for messages.

        Raises:
            ValueError: a row makes no sense; one line with file and path.
        """
        return {}

    @classmethod
    def completed(cls, parameters: Any, topics: Iterable[Topic[Any]],
                  ordered: Iterable[str]) -> Any:
        """Return its parameters as they are in the whole system.

        Args:
            parameters: of the node.
            topics: what the nodes of the system publish that are no pages.
            ordered: keys of topics on which faults of the run are ordered.
        """
        del topics, ordered
        return parameters

    @classmethod
    def named(cls, parameters: Any) -> dict[str, list[Named]]:
        """Topics that its parameters have it hear and publish, by "heard", "published"."""
        return topics_named(parameters)

    @classmethod
    def alone_on(cls, parameters: Any) -> Mapping[str, str]:  # noqa: ARG003
        """Keys on which no other node may publish, each with what says so, for messages."""
        return {}

    @classmethod
    def check_topics(cls, parameters: Any, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse parameters that do not fit the topics that they name, which are given by key.

        Raises:
            ValueError: they do not.
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
