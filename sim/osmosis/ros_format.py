"""The driver's own writing of ROS 2: CDR, keys and tokens, field by field. Pure.

It is written from the format (OMG DDSI-RTPS 10.2, CDR little-endian; rmw_zenoh's `docs/design.md`)
and not from the gateway, so that what one does wrong the other does not understand.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import xxhash

_STEPS = {"?": 1, "b": 1, "B": 1, "H": 2, "i": 4, "I": 4, "f": 4, "d": 8}


class Writer:
    """Writes fields one after the other, each where its size divides the place."""

    def __init__(self) -> None:
        self._data = bytearray()

    def put(self, kind: str, *values: float) -> Writer:
        """Write numbers or truth values of one kind, as `struct` calls it."""
        size = _STEPS[kind]
        self._data += bytes(-len(self._data) % size)
        self._data += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, text: str) -> Writer:
        """Write a text, with its length and a zero at its end."""
        data = text.encode() + b"\0"
        self.put("I", len(data))
        self._data += data
        return self

    def list(self, kind: str, values: Sequence[float]) -> Writer:
        """Write a list of any length."""
        self.put("I", len(values))
        return self.put(kind, *values) if len(values) else self

    def header(self, stamp_ns: int, frame: str) -> Writer:
        """Write a std_msgs/Header."""
        return self.put("i", stamp_ns // 10**9).put("I", stamp_ns % 10**9).text(frame)

    def zeros(self, count: int) -> Writer:
        """Write so many zeros of 8 bytes, as a covariance that nobody knows is."""
        return self.put("d", *[0.0] * count)

    def done(self) -> bytes:
        """Return all that was written, behind what says how."""
        return b"\0\1\0\0" + bytes(self._data)


class Reader:
    """Reads fields one after the other.

    Args:
        data: a message as it travels.

    Raises:
        ValueError: it is none that is written so.
    """

    def __init__(self, data: bytes) -> None:
        if data[:2] != b"\0\1" or len(data) < 4:
            raise ValueError("no CDR of little endian")
        self._data, self._at = data[4:], 0

    def get(self, kind: str) -> float:
        """Read a number or truth value.

        Raises:
            ValueError: the message ends before.
        """
        size = _STEPS[kind]
        self._at += -self._at % size
        try:
            value, = struct.unpack_from(f"<{kind}", self._data, self._at)
        except struct.error:
            raise ValueError("it ends too soon") from None
        self._at += size
        return float(value)

    def text(self) -> str:
        """Read a text.

        Raises:
            ValueError: the message ends before.
        """
        size = int(self.get("I"))
        data = self._data[self._at:self._at + size]
        if len(data) < size:
            raise ValueError("it ends too soon")
        self._at += size
        return data[:-1].decode("utf-8", "replace")


class Graph:
    """Keys and tokens of a node.

    Args:
        session: id of its session.
        node: name of the node.
        domain: of ROS.
    """

    def __init__(self, session: str, node: str, domain: int = 0) -> None:
        self._above = f"@ros2_lv/{domain}/{session}"
        self._node, self._domain, self._count = node, domain, 0
        self.token = f"{self._above}/0/0/NN/%/%/{node}"

    def endpoint(self, kind: str, topic: str, of: str, digest: str, *, depth: int = 10
                 ) -> tuple[str, str, bytes]:
        """Return key, token and gid of a publisher ("MP") or subscription ("MS")."""
        self._count += 1
        package, name = of.split("/")
        dds = f"{package}::msg::dds_::{name}_"
        token = (f"{self._above}/0/{self._count}/{kind}/%/%/{self._node}/"
                 f"{topic.replace('/', '%')}/{dds}/{digest}/::,{depth}:,:,:,,")
        gid = xxhash.xxh3_128_digest(token.encode())[::-1]
        return f"{self._domain}/{topic[1:]}/{dds}/{digest}", token, gid


def attachment(number: int, stamp_ns: int, gid: bytes) -> bytes:
    """Return what goes with a message."""
    return struct.pack("<qqB", number, stamp_ns, len(gid)) + gid
