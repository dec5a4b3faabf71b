"""The graph of ROS 2 from its liveliness tokens, and endpoints that do not match. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rampart.actors.ros2.wire import UNKNOWN_HASH, Endpoint, EndpointKind, gid_of, ros_name

MOST = 20_000
"""Most tokens that are kept; a robot has some hundred."""

_OF_TOPICS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)
_PAIRS = ({*_OF_TOPICS}, {EndpointKind.SERVICE, EndpointKind.CLIENT})


class RosGraph:
    """Nodes and endpoints by their tokens."""

    def __init__(self) -> None:
        self._endpoints: dict[str, Endpoint] = {}
        self._by_gid: dict[bytes, Endpoint] = {}

    def changed(self, token: str, alive: bool) -> Endpoint | None:
        """Add or remove a token; return its endpoint, None if nothing has changed.

        Raises:
            ValueError: it is not a token of ROS 2, or there are too many; one line.
        """
        if not alive:
            gone = self._endpoints.pop(token, None)
            if gone is not None:
                self._by_gid.pop(gid_of(token), None)
            return gone
        if token in self._endpoints:
            return None
        if len(self._endpoints) >= MOST:
            raise ValueError(f"more than {MOST} tokens; the others are ignored")
        found = Endpoint.parse(token)
        self._endpoints[token] = found
        self._by_gid[gid_of(token)] = found  # of all of it: `Endpoint` leaves some parts out
        return found

    def of(self, *kinds: EndpointKind) -> list[Endpoint]:
        """Return the endpoints of some kinds, the oldest first."""
        return [one for one in self._endpoints.values() if one.kind in kinds]

    def nodes(self) -> dict[str, int]:
        """Return the full names of all nodes, each with the number of its nodes."""
        found: dict[str, int] = {}
        for one in self.of(EndpointKind.NODE):
            found[one.full_name] = found.get(one.full_name, 0) + 1
        return found

    def on(self, topic: str, *kinds: EndpointKind) -> list[Endpoint]:
        """Return the endpoints of a topic or service."""
        return [one for one in self.of(*kinds) if one.topic == topic]

    def endpoint(self, gid: bytes) -> Endpoint | None:
        """Return the endpoint with a gid, None if the graph has none."""
        return self._by_gid.get(gid)


def misfits(here: Iterable[Endpoint], there: Iterable[Endpoint]) -> Iterator[str]:
    """Yield why endpoints exchange nothing, or less than they request.

    Args:
        here: our endpoints.
        there: those of others.
    """
    for mine in here:
        for other in there:
            if mine.topic != other.topic or {mine.kind, other.kind} not in _PAIRS:
                continue
            who = f"{mine.topic}: {other.full_name}"
            if mine.type != other.type:
                yield f"{who} has the type {ros_name(other.type)}; expected {ros_name(mine.type)}"
            elif other.hash not in {mine.hash, UNKNOWN_HASH}:
                yield (f"{who} has another definition of {ros_name(mine.type)} ({other.hash}, here "
                       f"{mine.hash}): they exchange nothing; another distribution?")
            elif mine.kind in _OF_TOPICS:
                source, reader = ((mine, other) if mine.kind is EndpointKind.PUBLISHER
                                  else (other, mine))
                if reader.qos.transient_local and not source.qos.transient_local:
                    yield (f"{who}: {reader.full_name} requests earlier messages (transient "
                           f"local), but {source.full_name} keeps none (volatile)")
                if reader.qos.reliable and not source.qos.reliable:
                    yield (f"{who}: {reader.full_name} requests a reliable topic, but "
                           f"{source.full_name} offers best effort")
