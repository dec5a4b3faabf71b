"""A node of ROS 2 that this process provides: its name in the graph, and its endpoints.

Messages are bytes here; `translation.types` and `translation.mapping` interpret them.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

from rampart.actors.ros2.side import Side, packed, recorded_key
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Attachment, Endpoint, EndpointKind, Qos, dds_name

Ask = Callable[[bytes, float, Callable[[bytes | None, str], None]], None]
"""Sends a request, waits for so many real seconds, and calls back once: with the response, or with
None and the reason."""

SERVICE_QOS = Qos(depth=10)
"""`rmw_qos_profile_services_default`."""

_NODE_ID = "0"


class RosNode:
    """A node in the graph of ROS 2.

    Args:
        side: the network.
        types: of messages and services.
        name: of the node.
        namespace: of the node, "/" for none.
        domain: of ROS.
        wall_ns: returns the time of ROS 2, nanoseconds since 1970.
        refuse: called with topic and reason for each message that is not one of ROS 2.
        record: takes key and payload of each message for the recording, if given; the virtual bus
            is recorded anyway.
    """

    def __init__(self, side: Side, types: Types, name: str, *, wall_ns: Callable[[], int],
                 refuse: Callable[[str, str], None], namespace: str = "/", domain: int = 0,
                 record: Callable[[str, bytes], None] | None = None) -> None:
        self._side, self.types, self._wall_ns, self._refuse = side, types, wall_ns, refuse
        self.domain, self._record = domain, record
        self._node = Endpoint(domain, side.id, _NODE_ID, _NODE_ID, EndpointKind.NODE, name,
                              namespace)
        self._ids = count(1)
        self._published: set[bytes] = set()
        side.token(self._node.token)

    @property
    def full_name(self) -> str:
        """Name with its namespace."""
        return self._node.full_name

    def _endpoint(self, kind: EndpointKind, topic: str, ros_type: str, qos: Qos) -> Endpoint:
        """Return a new endpoint of this node."""
        node = self._node
        return Endpoint(node.domain, node.session, node.node_id, str(next(self._ids)), kind,
                        node.node, node.namespace, topic, dds_name(ros_type),
                        self.types.hash(ros_type), qos)

    def _keeper(self, key: str) -> Callable[[bytes, bytes | None], None]:
        """Return a function that records a message on a key."""
        record, where = self._record, recorded_key(key)
        if record is None:
            return lambda _payload, _attachment: None
        return lambda payload, attachment: record(where, packed(payload, attachment))

    def publisher(self, topic: str, ros_type: str, qos: Qos) -> Callable[[bytes], None]:
        """Return a function that publishes a message on a topic.

        Raises:
            ValueError: the type is not known.
        """
        mine = self._endpoint(EndpointKind.PUBLISHER, topic, ros_type, qos)
        put, gid, numbers = self._side.publisher(mine.key, qos), mine.gid, count(1)
        keep = self._keeper(mine.key)
        self._published.add(gid)
        self._side.token(mine.token)

        def publish(payload: bytes) -> None:
            attachment = Attachment(next(numbers), self._wall_ns(), gid).pack()
            put(payload, attachment)
            keep(payload, attachment)

        return publish

    def subscribe(self, topic: str, ros_type: str, qos: Qos,
                  handle: Callable[[bytes, Attachment], None]) -> None:
        """Call `handle` with each message of a topic that other nodes publish.

        A message without an attachment is refused. Messages of this node are left out, or a
        detection on `/diagnostics` would be active because of its own report.

        Raises:
            ValueError: the type is not known.
        """
        mine = self._endpoint(EndpointKind.SUBSCRIPTION, topic, ros_type, qos)
        keep = self._keeper(mine.key)

        def deliver(payload: bytes, attached: bytes | None) -> None:
            keep(payload, attached)
            try:
                attachment = Attachment.unpack(attached)
            except ValueError as error:
                self._refuse(topic, str(error))
                return
            if attachment.gid not in self._published:
                handle(payload, attachment)

        self._side.subscribe(mine.key, qos, deliver)
        self._side.token(mine.token)

    def client(self, service: str, ros_type: str) -> Ask:
        """Return a function that sends a request to a service.

        Raises:
            ValueError: the type is not known.
        """
        mine = self._endpoint(EndpointKind.CLIENT, service, ros_type, SERVICE_QOS)
        numbers = count(1)
        self._side.token(mine.token)

        def ask(request: bytes, timeout_s: float,
                answered: Callable[[bytes | None, str], None]) -> None:
            number, gid = next(numbers), mine.gid
            is_over = False

            def take(payload: bytes | None, attached: bytes | None, why: str) -> None:
                nonlocal is_over
                if is_over:
                    return
                if payload is not None:
                    try:
                        request_of = Attachment.unpack(attached)
                    except ValueError:
                        return  # not from a server of ROS 2
                    if (request_of.sequence, request_of.gid) != (number, gid):
                        return
                is_over = True
                answered(payload, why)

            self._side.ask(mine.key, request, Attachment(number, self._wall_ns(), gid).pack(),
                           timeout_s, take)

        return ask

    def serve(self, service: str, ros_type: str, answer: Callable[[bytes], bytes]) -> None:
        """Offer a service: `answer` returns the response, or raises ValueError to send none.

        Raises:
            ValueError: the type is not known.
        """
        mine = self._endpoint(EndpointKind.SERVICE, service, ros_type, SERVICE_QOS)

        def asked(payload: bytes, attached: bytes | None,
                  reply: Callable[[bytes, bytes], None]) -> None:
            try:
                request = Attachment.unpack(attached)
                response = answer(payload)
            except ValueError as error:
                self._refuse(service, str(error))
                return
            reply(response, Attachment(request.sequence, self._wall_ns(), request.gid).pack())

        self._side.serve(mine.key, asked)
        self._side.token(mine.token)
