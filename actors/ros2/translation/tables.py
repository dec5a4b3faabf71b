"""Rows `[[ros2]]` of a specification: what passes between ROS 2 and the system. Pure."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Annotated, Literal

import msgspec

from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import read_rows
from rampart.manager.spec.tables import (
    Finding,
    OptionalName,
    Positive,
    SpecificationError,
    Table,
    unknown,
)

_A_ROS_NAME = "a name of ROS 2, e.g. '/scan'"
RosName = Annotated[str, msgspec.Meta(
    pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+\Z", max_length=200, description=_A_ROS_NAME)]
OptionalRosName = Annotated[str, msgspec.Meta(
    pattern=r"^((/[A-Za-z_][A-Za-z0-9_]*)+)?\Z", max_length=200,
    description=_A_ROS_NAME)]
RosType = Annotated[str, msgspec.Meta(
    pattern=r"^[a-z][a-z0-9_]*/(msg|srv|action)/[A-Z][A-Za-z0-9_]*\Z", max_length=200,
    description="a type of ROS 2, e.g. 'sensor_msgs/msg/LaserScan'")]
Written = dict[str, str | float | bool]

GATEWAY = "rampart.actors.ros2.gateway:Gateway"
ROUTER = "tcp/localhost:7447"
"""Where the router of `rmw_zenoh` listens by default."""

WAYS = {"subscribe": ("to",), "publish": ("from",), "call": ("from", "to"),
        "goal": ("from", "to")}
"""The four kinds of links, each with the keys of its topics of the system."""


class Ros2Link(Table, frozen=True, kw_only=True):
    """A topic, service or action of ROS 2, and the topics of the system that it is linked to.

    One of `subscribe`, `publish`, `call` and `goal` names it.

    Attributes:
        subscribe: Topic of ROS 2 whose messages are published on `to`.
        publish: Topic of ROS 2 on which the messages of `from` are published.
        call: Service of ROS 2 that is called with each message of `from`; the answer is on `to`.
        goal: Action of ROS 2 that receives each message of `from` as its goal; the goal's state is
            on `to`.
        type: Type of the messages in ROS 2, or of the service or action.
        to: Key of the topic of the system; if no class declares it, it gets the fields of `type`.
        from_: `from` in the file, in the same way; with `publish` a class has to declare it.
        fields: Field that is written → how it is read: a field of the other side, a number, a truth
            value, or a function of fields (`rampart.actors.ros2.translation.expressions`). Other
            fields follow the ready form of `type`.
        answer: The same for the answer of a call, on `to`.
        frame: Frame of messages to ROS 2, and required of messages from there; "" for any.
        child: Child frame of the transform that is meant, in a message of `tf`.
        beside: Key of a topic of the system whose newest message can be read too, as
            `beside.FIELD`, if it is not older than `max_age_s`.
        datum: Latitude and longitude, degrees, of the origin of `map`: for `east` and `north`.
        rate_hz: Greatest number of messages per second; None for all.
        max_age_s: Older messages are not published to ROS 2, nor read as `beside`.
        stop_after_s: After so much silence of the system, zeros are published to ROS 2; None for
            never. Nothing stops the robot if the gateway is lost: a driver has to stop by itself
            when commands cease.
        within_s: How long the answer of a call may take, real seconds.
        stamp: Time of messages from ROS 2: of their header, or of their arrival.
        publishers: Whether a second publisher is refused.
        publisher: Full name of the node whose messages are taken; "" for any node. It guards
            against misconfiguration: a client that forges the node's id passes.
        reliable: Whether messages are requested, or offered, reliably.
        transient_local: Whether a late subscriber receives earlier messages.
        depth: Length of the queue.
        gateway: Node that passes it on; "" for the only one.
    """

    type: RosType
    subscribe: OptionalRosName = ""
    publish: OptionalRosName = ""
    call: OptionalRosName = ""
    goal: OptionalRosName = ""
    to: str = ""
    from_: str = msgspec.field(name="from", default="")
    fields: Written = {}
    answer: Written = {}
    frame: str = ""
    child: str = ""
    beside: str = ""
    datum: tuple[float, float] | None = None
    rate_hz: Positive | None = None
    max_age_s: Positive = 0.5
    stop_after_s: Positive | None = None
    within_s: Positive = 1.0
    stamp: Literal["header", "arrival"] = "header"
    publishers: Literal["one", "any"] = "one"
    publisher: OptionalRosName = ""
    reliable: bool = True
    transient_local: bool = False
    depth: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 10
    gateway: OptionalName = ""

    @property
    def way(self) -> str:
        """Kind of the link, a key of `WAYS`."""
        return next(way for way in WAYS if getattr(self, way))

    @property
    def name(self) -> str:
        """Name of the topic, service or action of ROS 2."""
        return str(getattr(self, self.way))


def read_links(spec: SystemSpec, gateways: Collection[str], file: str) -> tuple[Ros2Link, ...]:
    """Return the links of a specification.

    Args:
        spec: the system.
        gateways: names of the gateways.
        file: name of the specification, for messages.

    Raises:
        SpecificationError: a row is incomplete, contradictory, or repeats another one.
    """
    links = read_rows(spec.ros2, Ros2Link, "ros2", file)
    for number in range(len(links)):
        for path, problem, value in _find_wrong(number, links, gateways):
            raise SpecificationError(file, f"$.ros2[{number}]{path}", problem, *value)
    return links


def _find_wrong(number: int, links: Sequence[Ros2Link],
                gateways: Collection[str]) -> Iterator[Finding]:
    """Yield the errors of a link, each with its path in the row."""
    link = links[number]
    ways = [way for way in WAYS if getattr(link, way)]
    if len(ways) != 1:
        yield Finding("", f"expected one of {', '.join(WAYS)}; found "
                          f"{' and '.join(ways) or 'none'}")
        return
    way, = ways
    yield from _wrong_keys(way, link)
    kind = {"call": "srv", "goal": "action"}.get(way)
    if kind is not None and link.type.split("/")[1] not in {kind, "action"}:
        yield Finding(".type", f"with {way}, expected package/{kind}/Name", (link.type,))
    if link.stop_after_s and way != "publish":
        yield Finding(".stop_after_s", "is for publish", (link.stop_after_s,))
    if link.publisher and way != "subscribe":
        yield Finding(".publisher", "is for subscribe", (link.publisher,))
    if link.answer and way != "call":
        yield Finding(".answer", "is for call", (link.answer,))
    subscribed = {one.to for one in links if one.subscribe}
    if link.beside and (way != "subscribe" or link.beside not in subscribed):
        yield Finding(".beside", "expected the `to` of another subscription", (link.beside,))
    if link.gateway and link.gateway not in gateways:
        yield unknown(".gateway", link.gateway, "gateway", gateways)
    for place, other in enumerate(links[:number]):
        if getattr(other, way) == link.name:
            yield Finding(f".{way}", f"is in ros2[{place}] already", (link.name,))
        if link.to and other.to == link.to:
            yield Finding(".to", f"is in ros2[{place}] already", (link.to,))


def _wrong_keys(way: str, link: Ros2Link) -> Iterator[Finding]:
    for field, key in (("to", link.to), ("from", link.from_)):
        if (field in WAYS[way]) != bool(key):
            wanted = " and ".join(f"{one} = 'key'" for one in WAYS[way])
            yield Finding(f".{field}", f"with {way}, expected {wanted} of a topic of the system",
                          (key,))
