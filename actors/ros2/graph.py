"""The graph of ROS 2 as its tokens show it: who is there, and what cannot meet. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rampart.actors.ros2.wire import Endpoint, EndpointKind, ros_name

MOST = 20_000
"""Tokens that are kept; a robot has some hundred."""

_OF_TOPICS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)


class RosGraph:
    """Nodes and endpoints, by their tokens."""

    def __init__(self) -> None:
        self._endpoints: dict[str, Endpoint] = {}
        self._by_gid: dict[bytes, Endpoint] = {}

    def changed(self, token: str, alive: bool) -> Endpoint | None:
        """Note that a token has come or gone; return whose it is, None if that is no news.

        Raises:
            ValueError: it is none of ROS 2; one line.
        """
        if not alive:
            gone = self._endpoints.pop(token, None)
            if gone is not None:
                self._by_gid.pop(gone.gid, None)
            return gone
        if token in self._endpoints:
            return None
        if len(self._endpoints) >= MOST:
            raise ValueError(f"more than {MOST} tokens; this one is left out")
        found = Endpoint.parse(token)
        self._endpoints[token] = found
        self._by_gid[found.gid] = found
        return found

    def of(self, *kinds: EndpointKind) -> list[Endpoint]:
        """Return the endpoints of some kinds, in the order in which they came."""
        return [one for one in self._endpoints.values() if one.kind in kinds]

    def nodes(self) -> dict[str, int]:
        """Return the full names of all nodes, each with how many there are of it."""
        found: dict[str, int] = {}
        for one in self.of(EndpointKind.NODE):
            found[one.full_name] = found.get(one.full_name, 0) + 1
        return found

    def on(self, topic: str, *kinds: EndpointKind) -> list[Endpoint]:
        """Return the endpoints of a topic or service."""
        return [one for one in self.of(*kinds) if one.topic == topic]

    def who(self, gid: bytes) -> Endpoint | None:
        """Return whose gid it is; None if there is no such endpoint."""
        return self._by_gid.get(gid)

    def topics(self) -> dict[str, list[Endpoint]]:
        """Return the endpoints of each topic, by its name."""
        found: dict[str, list[Endpoint]] = {}
        for one in self.of(*_OF_TOPICS):
            found.setdefault(one.topic, []).append(one)
        return dict(sorted(found.items()))


def misfits(here: Iterable[Endpoint], there: Iterable[Endpoint]) -> Iterator[str]:
    """Yield why endpoints do not hear each other, or less than they ask.

    Args:
        here: what we declare.
        there: what others do.
    """
    for mine in here:
        for other in there:
            if mine.topic != other.topic or not _meet(mine.kind, other.kind):
                continue
            who = f"{mine.topic}: {other.full_name}"
            if mine.type != other.type:
                yield f"{who} has the type {ros_name(other.type)}, and not {ros_name(mine.type)}"
            elif mine.hash != other.hash:
                yield (f"{who} has another definition of {ros_name(mine.type)} ({other.hash}, here "
                       f"{mine.hash}): neither hears the other; another distribution?")
            elif mine.kind in _OF_TOPICS:
                said, heard = ((mine, other) if mine.kind is EndpointKind.PUBLISHER
                               else (other, mine))
                if heard.qos.transient_local and not said.qos.transient_local:
                    yield (f"{who}: {heard.full_name} asks for what was said before "
                           f"(transient local), and {said.full_name} does not keep it (volatile)")
                if heard.qos.reliable and not said.qos.reliable:
                    yield (f"{who}: {heard.full_name} asks for a reliable topic, and "
                           f"{said.full_name} offers best effort")


def _meet(one: EndpointKind, other: EndpointKind) -> bool:
    return {one, other} in (set(_OF_TOPICS), {EndpointKind.SERVICE, EndpointKind.CLIENT})
