"""A node of ROS 2 that is made here: its name in the graph, and what it says, hears, asks, serves.

Everything is bytes here: what they mean is the business of `types` and `mapping`.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

from rampart.actors.ros2.side import Answered, Side
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Attachment, Endpoint, EndpointKind, Qos, dds_name

Publish = Callable[[bytes], None]

Heard = Callable[[bytes, Attachment], None]

SERVICE_QOS = Qos(depth=10)
"""Of services, as `rmw_qos_profile_services_default` has it."""

_NODE_ID = "0"


class RosNode:
    """A node in the graph of ROS 2.

    Args:
        side: the network.
        types: of messages and services.
        name: of the node.
        namespace: of the node, "/" for none.
        domain: of ROS.
        wall_ns: returns what time it is to ROS 2, nanoseconds since 1970.
        refuse: is told topic and reason when something came that is no message of ROS 2.
    """

    def __init__(self, side: Side, types: Types, name: str, *, wall_ns: Callable[[], int],
                 refuse: Callable[[str, str], None], namespace: str = "/", domain: int = 0
                 ) -> None:
        self._side, self.types, self._wall_ns, self._refuse = side, types, wall_ns, refuse
        self.domain = domain
        self._node = Endpoint(domain, side.id, _NODE_ID, _NODE_ID, EndpointKind.NODE, name,
                              namespace)
        self._ids = count(1)
        side.token(self._node.token)

    @property
    def full_name(self) -> str:
        """Name with its namespace."""
        return self._node.full_name

    def endpoint(self, kind: EndpointKind, topic: str, ros_type: str, qos: Qos) -> Endpoint:
        """Return what is known of a topic or service of this node under a new number."""
        node = self._node
        return Endpoint(node.domain, node.session, node.node_id, str(next(self._ids)), kind,
                        node.node, node.namespace, topic, dds_name(ros_type),
                        self.types.hash(ros_type), qos)

    def publisher(self, topic: str, ros_type: str, qos: Qos) -> Publish:
        """Return what publishes a message on a topic.

        Raises:
            ValueError: the type is not known.
        """
        mine = self.endpoint(EndpointKind.PUBLISHER, topic, ros_type, qos)
        put, gid, numbers = self._side.publisher(mine.key, qos), mine.gid, count(1)
        self._side.token(mine.token)

        def publish(payload: bytes) -> None:
            put(payload, Attachment(next(numbers), self._wall_ns(), gid).pack())

        return publish

    def subscribe(self, topic: str, ros_type: str, qos: Qos, heard: Heard) -> Endpoint:
        """Hear a topic; what has no proper attachment is refused.

        Returns:
            What is declared.

        Raises:
            ValueError: the type is not known.
        """
        mine = self.endpoint(EndpointKind.SUBSCRIPTION, topic, ros_type, qos)

        def deliver(payload: bytes, attached: bytes | None) -> None:
            try:
                attachment = Attachment.unpack(attached)
            except ValueError as error:
                self._refuse(topic, str(error))
                return
            heard(payload, attachment)

        self._side.subscribe(mine.key, qos, deliver)
        self._side.token(mine.token)
        return mine

    def client(self, service: str, ros_type: str) -> Client:
        """Return what asks a service.

        Raises:
            ValueError: the type is not known.
        """
        mine = self.endpoint(EndpointKind.CLIENT, service, ros_type, SERVICE_QOS)
        self._side.token(mine.token)
        return Client(self._side, mine, self._wall_ns)

    def serve(self, service: str, ros_type: str, answer: Callable[[bytes], bytes]) -> None:
        """Serve: `answer` makes the response of a request; a ValueError of it is no response.

        Raises:
            ValueError: the type is not known.
        """
        mine = self.endpoint(EndpointKind.SERVICE, service, ros_type, SERVICE_QOS)

        def asked(payload: bytes, attached: bytes | None,
                  reply: Callable[[bytes, bytes], None]) -> None:
            try:
                who = Attachment.unpack(attached)
                response = answer(payload)
            except ValueError as error:
                self._refuse(service, str(error))
                return
            reply(response, Attachment(who.sequence, self._wall_ns(), who.gid).pack())

        self._side.serve(mine.key, asked)
        self._side.token(mine.token)


class Client:
    """Asks one service.

    Args:
        side: the network.
        mine: the client in the graph.
        wall_ns: returns what time it is to ROS 2.
    """

    def __init__(self, side: Side, mine: Endpoint, wall_ns: Callable[[], int]) -> None:
        self._side, self._mine, self._wall_ns = side, mine, wall_ns
        self._numbers = count(1)

    def ask(self, request: bytes, timeout_s: float,
            answered: Callable[[bytes | None, str], None]) -> None:
        """Send a request.

        Args:
            request: as it travels.
            timeout_s: how long an answer is waited for, real seconds.
            answered: called once, with the response, or with None and why there is none.
        """
        number, gid = next(self._numbers), self._mine.gid
        is_over = False

        def take(payload: bytes | None, attached: bytes | None, why: str) -> None:
            nonlocal is_over
            if is_over:
                return
            if payload is not None:
                try:
                    whose = Attachment.unpack(attached)
                except ValueError:
                    return  # of somebody who is no server of ROS 2
                if (whose.sequence, whose.gid) != (number, gid):
                    return
            is_over = True
            answered(payload, why)

        told: Answered = take
        self._side.ask(self._mine.key, request, Attachment(number, self._wall_ns(), gid).pack(),
                       timeout_s, told)
