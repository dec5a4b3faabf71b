"""The wire format of `rmw_zenoh`: keys, liveliness tokens, QoS, attachments; and the graph. Pure.

Source: `docs/design.md`, `liveliness_utils.cpp` and `attachment_helpers.cpp` of
github.com/ros2/rmw_zenoh.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from enum import StrEnum

import msgspec
import xxhash

ADMIN = "@ros2_lv"
"""First chunk of every liveliness token."""

DEFAULT_DEPTH = 42
"""Depth of a queue, unless a token has another one."""

UNKNOWN_GID = bytes(16)
"""In place of a gid: one of several publishers, which a relay could not tell apart."""

UNKNOWN_HASH = "unknown"
"""In place of a type's hash, in the graph of a relay."""

_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16
_RELAYED = re.compile(r"[0-9a-f]{32}")


class EndpointKind(StrEnum):
    """Kinds of endpoints."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class Qos(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Quality of service of an endpoint, as far as `rmw_zenoh` uses it.

    Attributes:
        reliable: reliable, or best effort.
        transient_local: a late subscriber receives earlier messages, or only new ones.
        keep_all: all samples are queued, or the last `depth`.
        depth: length of the queue.
    """

    reliable: bool = True
    transient_local: bool = False
    keep_all: bool = False
    depth: int = DEFAULT_DEPTH

    def token(self) -> str:
        """Return its form in a token, where defaults are empty."""
        depth = "" if self.depth == DEFAULT_DEPTH else self.depth
        return (f"{'' if self.reliable else 2}:{1 if self.transient_local else ''}:"
                f"{2 if self.keep_all else ''},{depth}:,:,:,,")

    @classmethod
    def parse(cls, text: str) -> Qos:
        """Return the QoS in a token; unknown values count as the defaults.

        Raises:
            ValueError: the text is not a QoS.
        """
        parts = text.split(":")
        if len(parts) < 3:
            raise ValueError(f"QoS {text[:60]!r}: expected reliability:durability:history,depth:…")
        history, _, depth = parts[2].partition(",")
        if depth and not (depth.isascii() and depth.isdecimal() and len(depth) < 20):
            raise ValueError(f"QoS {text[:60]!r}: depth {depth[:20]!r}: expected a number")
        return cls(parts[0] != "2", parts[1] == "1", history == "2",
                   int(depth) if depth else DEFAULT_DEPTH)


class Endpoint(msgspec.Struct, frozen=True):
    """A node, publisher, subscription, service or client; it has one token in the graph.

    Attributes:
        domain: ROS domain.
        session: id of the Zenoh session, hexadecimal.
        node_id: id of the node in its session.
        id: id of the endpoint in its session; the `node_id` of a node.
        kind: kind of the endpoint.
        enclave: security enclave, "/" for none.
        namespace: namespace of the node, "/" for none.
        node: name of the node.
        topic: full name of the topic or service; empty for a node, as are the next three.
        type: DDS name of the type, e.g. "std_msgs::msg::dds_::String_".
        hash: hash of the type.
        qos: QoS of the endpoint.
    """

    domain: int
    session: str
    node_id: str
    id: str
    kind: EndpointKind
    node: str
    namespace: str = "/"
    topic: str = ""
    type: str = ""
    hash: str = ""
    qos: Qos = Qos()
    enclave: str = "/"

    @property
    def full_name(self) -> str:
        """Name of the node with its namespace, e.g. "/robot/controller_server"."""
        return f"{self.namespace.rstrip('/')}/{self.node}"

    @property
    def token(self) -> str:
        """Key of its liveliness token."""
        parts = [ADMIN, str(self.domain), self.session, self.node_id, self.id, self.kind.value,
                 _mangled(self.enclave), _mangled(self.namespace), _mangled(self.node)]
        if self.kind is not EndpointKind.NODE:
            parts += [_mangled(self.topic), self.type, self.hash, self.qos.token()]
        return "/".join(parts)

    @property
    def key(self) -> str:
        """Key of its topic or service."""
        return data_key(self.domain, self.topic, self.type, self.hash)

    @property
    def gid(self) -> bytes:
        """Id of the endpoint in its messages, 16 bytes."""
        return gid_of(self.token)

    @classmethod
    def parse(cls, token: str) -> Endpoint:
        """Return the endpoint of a token; parts that newer versions append are ignored.

        Raises:
            ValueError: it is not a token of ROS 2; one line.
        """
        parts = token.split("/")
        if len(parts) < 9 or parts[0] != ADMIN or not all(parts):
            raise ValueError(f"{token[:200]!r}: not a liveliness token of ROS 2")
        _, domain, session, node_id, own_id, kind_name, enclave, namespace, node = parts[:9]
        if not (domain.isascii() and domain.isdecimal() and len(domain) < 10):
            raise ValueError(f"token: domain {domain[:20]!r}: expected a number")
        try:
            kind = EndpointKind(kind_name)
        except ValueError:
            raise ValueError(f"token: unknown kind of endpoint {kind_name[:20]!r}") from None
        found = cls(int(domain), session, node_id, own_id, kind, _demangled(node),
                    _demangled(namespace), enclave=_demangled(enclave))
        if kind is EndpointKind.NODE:
            return found
        if len(parts) < 13:
            raise ValueError(f"{token[:200]!r}: topic, type, hash and QoS are missing")
        topic, type_name, digest, qos = parts[9:13]
        return msgspec.structs.replace(
            found, topic=_demangled(topic), type=_demangled(type_name), hash=_demangled(digest),
            qos=Qos.parse(qos))


class Attachment(msgspec.Struct, frozen=True):
    """Attachment of each message, request and answer.

    Attributes:
        sequence: number of the message among those of its sender, from 1.
        stamp_ns: wall time of sending, nanoseconds since 1970.
        gid: id of the sender's endpoint; in an answer that of the client.
    """

    sequence: int
    stamp_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """Return its 33 bytes."""
        return _ATTACHMENT.pack(self.sequence, self.stamp_ns, _GID_BYTES, self.gid)

    @classmethod
    def unpack(cls, data: bytes | None) -> Attachment:
        """Return the attachment of a message.

        Raises:
            ValueError: there is none, or it is not an attachment of ROS 2.
        """
        if data is None:
            raise ValueError("no attachment; rmw_zenoh sends one with each message")
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise ValueError(f"attachment of {len(data)} bytes; expected {_ATTACHMENT.size} bytes "
                             f"with a gid of {_GID_BYTES}")
        sequence, stamp_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(sequence, stamp_ns, gid)


def gid_of(token: str) -> bytes:
    """Return the id in messages of the endpoint that has declared a token.

    That of an endpoint in the graph of a relay is its id in the token.
    """
    own_id = token.split("/")[4]
    if _RELAYED.fullmatch(own_id):
        return bytes.fromhex(own_id)
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(_GID_BYTES, "little")


def data_key(domain: int, topic: str, dds_type: str, digest: str) -> str:
    """Return the key of a topic or service."""
    return f"{domain}/{topic.strip('/')}/{dds_type}/{digest}"


def dds_name(ros_type: str) -> str:
    """Return the DDS name of a type, e.g. of "std_msgs/msg/String"."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds_type: str) -> str:
    """Return the ROS name of a DDS type; the name itself if it is not a type of ROS 2."""
    parts = dds_type.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return dds_type
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _demangled(name: str) -> str:
    return name.replace("%", "/")


# -- the graph -------------------------------------------------------------------------------------

MOST_TOKENS = 20_000
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
        if len(self._endpoints) >= MOST_TOKENS:
            raise ValueError(f"more than {MOST_TOKENS} tokens; the others are ignored")
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
