"""An actor that stands in for a node of ROS 2.

Derive a class from `StandIn`. Name it as the `stand_in` of the node whose `command` starts the real
one, or as its `actor` if there is no program to start. It exchanges messages of ROS 2 on topics of
ROS 2, over Zenoh or, in virtual time, over the virtual bus.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, cast

import msgspec

from rampart.actors.bus.bus import Bus
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.ros_clock import EPOCH_NS, NS
from rampart.actors.ros2.side import BusSide, Mode, Side, Tls, WatchedBus, ZenohSide
from rampart.actors.ros2.translation.tables import ROUTER
from rampart.actors.ros2.translation.types import Distribution, Types
from rampart.actors.ros2.wire import Attachment, Qos
from rampart.actors.runtime.actor import Actor, Context


def side_of(actor: Actor, bus: Bus, connect: Sequence[str], mode: Mode, *,
            tls: Tls | None = None) -> Side:
    """Return the network of ROS 2 for an actor: over Zenoh, or in virtual time over its bus.

    Args:
        actor: that uses it.
        bus: of the actor.
        connect: endpoints of the routers of ROS 2.
        mode: of the session of Zenoh.
        tls: files for endpoints "tls/…".
    """
    context = actor.context
    if context.run.plan.virtual:
        return BusSide(cast("WatchedBus", bus), actor.name, context.incarnation)
    return ZenohSide(connect, asyncio.get_running_loop(), mode=mode, tls=tls)


def wall_ns(actor: Actor) -> int:
    """Return the time of nodes without use_sim_time, nanoseconds since 1970."""
    if actor.context.run.plan.virtual:
        return EPOCH_NS + int(actor.clock.now() * NS)
    return time.time_ns()


class StandIn(Actor):
    """Base of the stand-ins for nodes of ROS 2.

    Class attributes:
        node_name: name of the node in ROS 2.
        namespace: namespace of the node.
        interfaces: folder with the robot's definitions; None for none.
    """

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Address of ROS 2.

        Attributes:
            domain: ROS_DOMAIN_ID.
            distribution: name of the distribution.
            connect: endpoints of the routers of ROS 2.
        """

        connect: tuple[str, ...] = (ROUTER,)
        domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
        distribution: Distribution = "jazzy"

    parameters: Parameters
    node_name: ClassVar[str] = ""
    namespace: ClassVar[str] = "/"
    interfaces: ClassVar[Path | None] = None
    ros: RosNode

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        folder = self.interfaces
        self.types = Types(self.parameters.distribution, [folder] if folder else [])

    def on_start(self) -> None:
        """Join the graph; a subclass declares its endpoints in `declare`."""
        self._side = side = side_of(self, self._bus, self.parameters.connect, "peer")
        self.ros = RosNode(
            side, self.types, self.node_name or self.name, wall_ns=self.wall_ns,
            refuse=lambda where, why: self.report_diagnostic("ros2", why, where),
            namespace=self.namespace, domain=self.parameters.domain)
        self.declare()

    def on_stop(self) -> None:
        """Leave the graph."""
        self._side.close()

    def declare(self) -> None:
        """Declare publishers, subscriptions and services, by the three methods below."""

    def wall_ns(self) -> int:
        """Return the time of ROS 2, nanoseconds since 1970."""
        return wall_ns(self)

    def publisher(self, topic: str, ros_type: str, qos: Qos = Qos(depth=10)  # noqa: B008 frozen
                  ) -> Callable[[Any], None]:
        """Return a function that publishes messages of a type; a header is stamped now."""
        publish, types = self.ros.publisher(topic, ros_type, qos), self.types

        def stamped(message: Any) -> None:
            header = getattr(message, "header", None)
            if header is not None:
                header.stamp.sec, header.stamp.nanosec = divmod(self.wall_ns(), NS)
            publish(types.encode(ros_type, message))

        return stamped

    def subscribe(self, topic: str, ros_type: str, handle: Callable[[Any], None],
                  qos: Qos = Qos(depth=10)) -> None:  # noqa: B008 frozen
        """Call `handle` with each message of a topic."""
        decode = self.types.decoder(ros_type)

        def arrived(payload: bytes, _attachment: Attachment) -> None:
            self._dispatcher.put_message(f"ros2 {topic}", lambda: handle(decode(payload)))

        self.ros.subscribe(topic, ros_type, qos, arrived)

    def serve(self, service: str, ros_type: str, answer: Callable[[Any, Any], None]) -> None:
        """Offer a service: `answer` takes the request, and a blank response to fill in."""
        types = self.types
        decode = types.decoder(f"{ros_type}_Request")

        def asked(payload: bytes) -> bytes:
            response = types.blank(f"{ros_type}_Response")
            answer(decode(payload), response)
            return types.encode(f"{ros_type}_Response", response)

        self.ros.serve(service, ros_type, asked)
