"""ROS 2 on Zenoh as `rmw_zenoh` has it: keys, liveliness tokens, QoS, attachments. Pure.

Source: `docs/design.md`, `liveliness_utils.cpp` and `attachment_helpers.cpp` of
github.com/ros2/rmw_zenoh.
"""

from __future__ import annotations

import struct
from enum import StrEnum

import msgspec
import xxhash

ADMIN = "@ros2_lv"
"""First chunk of every liveliness token."""

DEFAULT_DEPTH = 42
"""Of a queue, as far as a token does not say another."""

_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


class EndpointKind(StrEnum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class Qos(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Quality of service of an endpoint, as far as `rmw_zenoh` heeds it.

    Attributes:
        reliable: reliable, or best effort.
        transient_local: who joins late gets what was published before, or only what comes.
        keep_all: all samples wait, or the last `depth`.
        depth: how many wait.
    """

    reliable: bool = True
    transient_local: bool = False
    keep_all: bool = False
    depth: int = DEFAULT_DEPTH

    def token(self) -> str:
        """Return it as a token says it: empty where it is as by default."""
        depth = "" if self.depth == DEFAULT_DEPTH else self.depth
        return (f"{'' if self.reliable else 2}:{1 if self.transient_local else ''}:"
                f"{2 if self.keep_all else ''},{depth}:,:,:,,")

    @classmethod
    def parse(cls, text: str) -> Qos:
        """Return what a token says; what is not known counts as the default.

        Raises:
            ValueError: it is no such text.
        """
        parts = text.split(":")
        if len(parts) < 3:
            raise ValueError(f"QoS {text[:60]!r}: reliability:durability:history,depth:… is right")
        history, _, depth = parts[2].partition(",")
        if depth and not (depth.isascii() and depth.isdecimal() and len(depth) < 20):
            raise ValueError(f"QoS {text[:60]!r}: depth {depth[:20]!r} is no number")
        return cls(parts[0] != "2", parts[1] == "1", history == "2",
                   int(depth) if depth else DEFAULT_DEPTH)


class Endpoint(msgspec.Struct, frozen=True):
    """A node, or what a node publishes, hears, serves or calls; one token of the graph.

    Attributes:
        domain: ROS domain.
        session: id of the Zenoh session, hexadecimal.
        node_id: of the node in its session.
        id: of the endpoint there; of a node its `node_id`.
        kind: what it is.
        enclave: of its security, "/" for none.
        namespace: of the node, "/" for none.
        node: its name.
        topic: name of the topic or service with all namespaces; "" of a node, as all that follows.
        type: of its messages as DDS has it, e.g. "std_msgs::msg::dds_::String_".
        hash: of the type.
        qos: of the endpoint.
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
        """Key of what it publishes, hears, serves or calls."""
        return data_key(self.domain, self.topic, self.type, self.hash)

    @property
    def gid(self) -> bytes:
        """By what its messages name it, 16 bytes."""
        return xxhash.xxh3_128_intdigest(self.token.encode()).to_bytes(_GID_BYTES, "little")

    @classmethod
    def parse(cls, token: str) -> Endpoint:
        """Return what a token stands for; what newer versions add at its end is left out.

        Raises:
            ValueError: it is no token of ROS 2; one line.
        """
        parts = token.split("/")
        if len(parts) < 9 or parts[0] != ADMIN or not all(parts):
            raise ValueError(f"{token[:200]!r} is no liveliness token of ROS 2")
        _, domain, session, node_id, own_id, kind, enclave, namespace, node = parts[:9]
        if not (domain.isascii() and domain.isdecimal() and len(domain) < 10):
            raise ValueError(f"token: domain {domain[:20]!r} is no number")
        try:
            is_what = EndpointKind(kind)
        except ValueError:
            raise ValueError(f"token: {kind[:20]!r} is no kind of an endpoint") from None
        found = cls(int(domain), session, node_id, own_id, is_what, _demangled(node),
                    _demangled(namespace), enclave=_demangled(enclave))
        if is_what is EndpointKind.NODE:
            return found
        if len(parts) < 13:
            raise ValueError(f"{token[:200]!r}: topic, type, hash and QoS are missing")
        topic, kind_of, digest, qos = parts[9:13]
        return msgspec.structs.replace(
            found, topic=_demangled(topic), type=_demangled(kind_of), hash=_demangled(digest),
            qos=Qos.parse(qos))


class Attachment(msgspec.Struct, frozen=True):
    """What goes with each message, request and answer.

    Attributes:
        sequence: number of the message among those of its sender, from 1.
        stamp_ns: wall time at which it was sent, nanoseconds since 1970.
        gid: of the sender's endpoint; of an answer, that of who asked.
    """

    sequence: int
    stamp_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """Return it as it travels, 33 bytes."""
        return _ATTACHMENT.pack(self.sequence, self.stamp_ns, _GID_BYTES, self.gid)

    @classmethod
    def unpack(cls, data: bytes | None) -> Attachment:
        """Return what came with a message.

        Raises:
            ValueError: nothing did, or it is no attachment of ROS 2.
        """
        if data is None:
            raise ValueError("no attachment; rmw_zenoh sends one with each message")
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise ValueError(f"an attachment of {len(data)} bytes; {_ATTACHMENT.size} are right")
        sequence, stamp_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(sequence, stamp_ns, gid)


def data_key(domain: int, topic: str, dds_type: str, digest: str) -> str:
    """Return the key on which a topic's messages travel, or a service is asked."""
    return f"{domain}/{topic.strip('/')}/{dds_type}/{digest}"


def dds_name(ros_type: str) -> str:
    """Return the name in keys of a type, e.g. of "std_msgs/msg/String"."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds_type: str) -> str:
    """Return the name of a type that keys call so; as it is, if it is none of ROS 2."""
    parts = dds_type.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return dds_type
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _demangled(name: str) -> str:
    return name.replace("%", "/")
