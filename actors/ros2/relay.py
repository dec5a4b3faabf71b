"""The relay: a node of `rclpy` that passes the gateway's messages on over any middleware.

    python3 relay.py DESCRIPTOR NAME NAMESPACE WHOLE

`relay_side.py` starts it with the Python of an installation of ROS 2, of any version from 3.8 on.
So it imports nothing of Rampart, and knows nothing of keys and tokens. The descriptor is a stream
socket. A frame on it is the lengths of header and payload, the header as JSON, a list that begins
with a word, and the payload: a message in CDR, which the relay does not decode.

One thread reads the socket and publishes; the main thread spins the node. It answers a `ping` only
if both work. At the end of the socket the relay leaves the graph. Any error ends the process.

Endpoints are named by kind ("MP", "MS", "SS", "SC" as in `wire.EndpointKind`) and topic. WHOLE is 1
to report the endpoints of all topics, 0 for those of topics with an endpoint of the relay.
"""

from __future__ import annotations

import collections
import functools
import importlib
import json
import os
import socket
import struct
import sys
import threading
import time
import traceback
from typing import Any

sys.path.pop(0)  # the folder of this file, whose modules are not the ones that rclpy imports

import rclpy
import rclpy.duration
import rclpy.executors
import rclpy.qos
import rclpy.serialization
import rclpy.subscription

LENGTHS = struct.Struct(">II")
LOOK_S = 0.1
"""Period of a look at the graph; an answer to a ping comes with it."""

LATE_S = 0.5
"""A message that has waited for longer is not published: its command is out of date."""

ALONE_S = 1.0
"""Another publisher of the same node that is silent for so long is gone, if messages lack gids."""

ACKNOWLEDGED_S = 0.1
"""Time that subscribers have to acknowledge the last messages."""

UNNAMED, UNNAMED_LOOKS = "_NODE_NAME_UNKNOWN_", 5
"""Name of an endpoint whose node is not known yet; after so many looks it is not of ROS 2."""

SENT = 100
"""Last own messages that are recognized, since over DDS a node receives its own ones too."""

GID_BYTES = 16
HASHED = "RIHS"
"""Begin of a type's hash; Humble has none."""

PUBLISHER, SUBSCRIPTION, SERVICE, CLIENT = "MP", "MS", "SS", "SC"
PARTS = {"_SendGoal": "SendGoalService", "_GetResult": "GetResultService",
         "_FeedbackMessage": "FeedbackMessage"}
"""End of the name of an action's part → name of its class in `Impl`."""


def class_of(ros_type: str) -> Any:
    """Return the Python class of a type; raises ImportError or AttributeError."""
    package, kind, name = ros_type.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    for suffix, part in PARTS.items():
        if kind == "action" and name.endswith(suffix):
            return getattr(getattr(module, name[:-len(suffix)]).Impl, part)
    return getattr(module, name)


class Channel:
    """The socket to the gateway.

    Args:
        descriptor: of the socket.
    """

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._file = self._socket.makefile("rb")
        self._lock = threading.Lock()

    def send(self, *header: Any, payload: bytes = b"") -> None:
        """Send a frame; wait for a gateway that does not read."""
        head = json.dumps(header).encode()
        with self._lock:
            self._socket.sendall(LENGTHS.pack(len(head), len(payload)) + head + payload)

    def receive(self) -> tuple[list[Any], bytes] | None:
        """Return the next header and payload, None at the end."""
        lengths = self._file.read(LENGTHS.size)
        if len(lengths) < LENGTHS.size:
            return None
        head, payload = LENGTHS.unpack(lengths)
        return json.loads(self._file.read(head)), self._file.read(payload)


class Relay:
    """The node of the relay.

    Args:
        channel: to the gateway.
        name: of the node.
        namespace: of the node.
        whole: whether the endpoints of all topics are reported.
    """

    def __init__(self, channel: Channel, name: str, namespace: str, whole: bool) -> None:
        self._channel, self._whole = channel, whole
        self._node = rclpy.create_node(
            name, namespace=namespace, start_parameter_services=False, enable_rosout=False)
        self._endpoints: dict[tuple[str, str], Any] = {}
        self._lock = threading.Lock()  # of `_own`, while an endpoint is new in it, and `_sent`
        self._kept: set[str] = set()  # topics whose messages are never too old
        self._own: set[str] = set()  # gids
        self._sent: collections.deque[tuple[str, bytes]] = collections.deque(maxlen=SENT)
        self._calls: dict[int, tuple[Any, Any]] = {}
        self._ping = self._pong = 0
        self._graph: Any = None
        self._unnamed: dict[str, int] = {}  # gid → looks that have found it without a node
        self._node.create_timer(LOOK_S, self._look)
        channel.send("ready", os.environ.get("ROS_DISTRO", ""))

    def spin(self) -> None:
        """Run the node until the gateway has closed the socket; then leave the graph."""
        reader = threading.Thread(target=self._read, daemon=True)
        reader.start()
        executor = rclpy.executors.SingleThreadedExecutor()
        executor.add_node(self._node)
        while reader.is_alive():
            executor.spin_once()
        self._node.destroy_node()
        rclpy.shutdown()

    def _read(self) -> None:
        try:
            while frame := self._channel.receive():
                (word, *header), payload = frame
                getattr(self, f"_on_{word}")(*header, payload)
            for (kind, _), endpoint in self._endpoints.items():
                if kind == PUBLISHER and hasattr(endpoint, "wait_for_all_acked"):
                    endpoint.wait_for_all_acked(rclpy.duration.Duration(seconds=ACKNOWLEDGED_S))
        except BaseException:  # a half of the relay is no use
            traceback.print_exc()
            os._exit(1)

    # -- from the gateway ------------------------------------------------------------------------

    def _on_ping(self, number: int, _payload: bytes) -> None:
        self._ping = number

    def _on_declare(self, kind: str, topic: str, ros_type: str, digest: str, qos: dict[str, Any],
                    _payload: bytes) -> None:
        """Create an endpoint; with an empty kind only look for the type."""
        try:
            made = class_of(ros_type)
        except (ImportError, AttributeError) as error:
            self._channel.send("problem", f"this ROS 2 has no {ros_type} ({error}); source the "
                                          "workspace that has it")
            return
        if not kind:
            return
        with self._lock:
            before = self._infos(kind, topic)
            endpoint = self._created(kind, topic, made, qos)
            own = {gid: info for gid, info in self._infos(kind, topic).items()
                   if gid not in before and info.node_name == self._node.get_name()}
            self._own.update(own)
            theirs = next(map(hash_of, own.values()), "")
            if theirs and digest.startswith(HASHED) and theirs != digest:
                (self._node.destroy_publisher if kind == PUBLISHER
                 else self._node.destroy_subscription)(endpoint)
                self._channel.send("problem", f"{topic}: this ROS 2 has another definition of "
                                              f"{ros_type} ({theirs}, the gateway {digest}); "
                                              "nothing passes")
            else:
                self._endpoints[kind, topic] = endpoint

    def _created(self, kind: str, topic: str, made: Any, qos: dict[str, Any]) -> Any:
        if kind == PUBLISHER:
            if qos["transient_local"]:
                self._kept.add(topic)
            return self._node.create_publisher(made, topic, profile(**qos))
        if kind == SUBSCRIPTION:
            return self._node.create_subscription(
                made, topic, self._receiver(topic), profile(**qos), raw=True)
        return self._node.create_client(made, topic)

    def _on_put(self, topic: str, at_s: float, payload: bytes) -> None:
        endpoint = self._endpoints.get((PUBLISHER, topic))
        if endpoint is not None and (
                time.monotonic() - at_s <= LATE_S or topic in self._kept):
            if (SUBSCRIPTION, topic) in self._endpoints:
                with self._lock:
                    self._sent.append((topic, payload))
            endpoint.publish(payload)

    def _on_ask(self, number: int, service: str, payload: bytes) -> None:
        client = self._endpoints.get((CLIENT, service))
        if client is None or not client.service_is_ready():
            self._channel.send("answer", number, False)
            return
        future = client.call_async(
            rclpy.serialization.deserialize_message(payload, client.srv_type.Request))
        self._calls[number] = client, future
        future.add_done_callback(functools.partial(self._answered, number))

    def _answered(self, number: int, future: Any) -> None:
        if self._calls.pop(number, None) is not None and future.result() is not None:
            self._channel.send("answer", number, True,
                               payload=rclpy.serialization.serialize_message(future.result()))

    def _on_forget(self, number: int, _payload: bytes) -> None:
        if call := self._calls.pop(number, None):
            client, future = call
            client.remove_pending_request(future)

    # -- to the gateway --------------------------------------------------------------------------

    def _receiver(self, topic: str) -> Any:
        last, jumped_s = 0, -ALONE_S

        def take(payload: bytes, info: dict[str, Any]) -> None:
            nonlocal last, jumped_s
            with self._lock:
                if (topic, payload) in self._sent:
                    return
            sequence = info.get("publication_sequence_number") or 0
            if info.get("publisher_gid"):
                gid = info["publisher_gid"]["data"][:GID_BYTES].hex()
            else:  # before Kilted. Publishers count each for itself: two never count upwards only
                now_s = time.monotonic()
                if sequence <= last:
                    jumped_s = now_s
                infos = {gid: info for gid, info in self._infos(PUBLISHER, topic).items()
                         if gid not in self._own}
                gid, *others = infos or [""]
                last = sequence
                if others:
                    nodes = {(info.node_name, info.node_namespace) for info in infos.values()}
                    is_alone = len(nodes) == 1 and now_s - jumped_s >= ALONE_S
                    gid, sequence = gid if is_alone else "", 0
            self._channel.send("message", topic, gid, sequence,
                               info.get("source_timestamp") or time.time_ns(), payload=payload)

        if hasattr(rclpy.subscription.Subscription, "CallbackType"):
            return take
        return lambda payload: take(payload, {})  # before Iron

    def _look(self) -> None:
        if self._ping != self._pong:
            self._pong = self._ping
            self._channel.send("pong")
        with self._lock:
            graph = self._look_at_graph()
        if graph != self._graph:
            self._graph = graph
            self._channel.send("graph", *graph)

    def _look_at_graph(self) -> tuple[list[Any], list[Any]]:
        """Return the other nodes, each with its namespace, and their endpoints."""
        node = self._node
        nodes = sorted(node.get_node_names_and_namespaces())
        own = node.get_name(), node.get_namespace()
        if own in nodes:
            nodes.remove(own)
        topics = {topic for _, topic in list(self._endpoints)}
        if self._whole:
            topics |= {topic for topic, _ in node.get_topic_names_and_types()}
        infos = [(kind, topic, gid, info) for topic in topics for kind in (PUBLISHER, SUBSCRIPTION)
                 for gid, info in self._infos(kind, topic).items() if gid not in self._own]
        self._unnamed = {gid: self._unnamed.get(gid, 0) + 1 for _, _, gid, info in infos
                         if info.node_name == UNNAMED}
        found = [
            [kind, info.node_name, info.node_namespace, topic, info.topic_type, hash_of(info),
             info.qos_profile.reliability != rclpy.qos.ReliabilityPolicy.BEST_EFFORT,
             info.qos_profile.durability == rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL, gid]
            for kind, topic, gid, info in infos
            if self._unnamed.get(gid, UNNAMED_LOOKS) >= UNNAMED_LOOKS]
        for name, namespace in nodes:
            for kind, get in ((SERVICE, node.get_service_names_and_types_by_node),
                              (CLIENT, node.get_client_names_and_types_by_node)):
                try:
                    services = get(name, namespace)
                except Exception:  # noqa: S112 the node has gone; its class differs by version
                    continue
                found += [[kind, name, namespace, service, types[0], "", True, False, "0"]
                          for service, types in services if self._whole or service in topics]
        return [list(one) for one in nodes], sorted(found)

    def _infos(self, kind: str, topic: str) -> dict[str, Any]:
        if kind not in (PUBLISHER, SUBSCRIPTION):
            return {}
        get = (self._node.get_publishers_info_by_topic if kind == PUBLISHER
               else self._node.get_subscriptions_info_by_topic)
        return {bytes(info.endpoint_gid[:GID_BYTES]).hex(): info for info in get(topic)}


def hash_of(info: Any) -> str:
    """Return the hash of an endpoint's type, "" before Iron and from a node of before Iron."""
    text = str(getattr(info, "topic_type_hash", ""))
    return text if text.startswith(HASHED) else ""


def profile(reliable: bool, transient_local: bool, keep_all: bool, depth: int) -> Any:
    """Return a quality of service; the arguments are the fields of `wire.Qos`."""
    qos = rclpy.qos
    return qos.QoSProfile(
        depth=depth,
        history=qos.HistoryPolicy.KEEP_ALL if keep_all else qos.HistoryPolicy.KEEP_LAST,
        reliability=(qos.ReliabilityPolicy.RELIABLE if reliable
                     else qos.ReliabilityPolicy.BEST_EFFORT),
        durability=(qos.DurabilityPolicy.TRANSIENT_LOCAL if transient_local
                    else qos.DurabilityPolicy.VOLATILE))


def main() -> None:
    """Run the relay."""
    descriptor, name, namespace, whole = sys.argv[1:]
    rclpy.init(args=[])
    Relay(Channel(int(descriptor)), name, namespace, whole == "1").spin()
    os._exit(0)  # tearing the interpreter down takes longer than leaving the graph


if __name__ == "__main__":
    main()
