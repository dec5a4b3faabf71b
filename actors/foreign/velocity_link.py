"""`VelocityLink`: hands a velocity to `rampart-stop`, a program beside the driver of the base."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
import zlib
from typing import Annotated, Any

import msgspec

from rampart.actors.bus.fields import NUMBER, Field
from rampart.actors.runtime.actor import Actor, Context, Header
from rampart.actors.runtime.parameters import FieldName, OptionalFieldName

SocketPath = Annotated[str, msgspec.Meta(pattern=r"^/.{1,105}\Z")]

_BODY = struct.Struct("=QQQddd")


def frame(session: int, sequence: int, stamp_ns: int, velocity: tuple[float, float, float]
          ) -> bytes:
    """Return a frame as in `stop/rampart-stop.c`.

    Args:
        session: Start of the sender, ns of the monotonic clock.
        sequence: Number of the frame, from 1.
        stamp_ns: When the velocity was computed, ns of the monotonic clock.
        velocity: Forward and left, m/s, in the frame of the base, and turn rate, rad/s.
    """
    body = _BODY.pack(session, sequence, stamp_ns, *velocity)
    return b"RPV1" + struct.pack("=I", zlib.crc32(body)) + body


class VelocityLink(Actor):
    """Sends each velocity of a topic as a datagram, with the time of its message."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """A socket, and fields of one topic.

        Attributes:
            socket: absolute path of the socket of `rampart-stop`.
            linear: forward velocity, m/s, as "topic:field".
            angular: turn rate, rad/s.
            lateral: velocity to the left, m/s; "" for a base that has none.
        """

        socket: SocketPath
        linear: FieldName
        angular: FieldName
        lateral: OptionalFieldName = ""

        def __post_init__(self) -> None:
            """Refuse fields of several topics: they would be of different times."""
            topics = {name.partition(":")[0] for name in self.fields() if name}
            if len(topics) > 1:
                raise ValueError(f"linear: expected fields of one topic; given {sorted(topics)}")

        def fields(self) -> tuple[str, str, str]:
            """Return the names in the order of a frame."""
            return self.linear, self.lateral, self.angular

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        key = self.parameters.linear.partition(":")[0]
        kind = self.chosen_topic(key).type
        self._fields = [Field(kind, name.partition(":")[2]) if name else None
                        for name in self.parameters.fields()]
        if any(field.kind != NUMBER for field in self._fields if field):
            raise ValueError("linear, lateral, angular: expected numbers")
        self._session, self._sequence = time.monotonic_ns(), 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self.hear_topic(key, self._send)

    @classmethod
    def on_wall_clock(cls, _parameters: Parameters) -> bool:
        """Return True: `rampart-stop` counts real seconds."""
        return True

    def on_stop(self) -> None:
        """Close the socket; the program hands nothing on any more."""
        self._socket.close()

    def _send(self, message: Any, header: Header) -> None:
        if self.context.run.plan.virtual:
            return
        forward, left, turn = (field(message) if field else 0.0 for field in self._fields)
        if None in (forward, left, turn):
            return
        self._sequence += 1
        stamp_ns = int(self.clock.source_time(header.stamp) * 1e9)
        with contextlib.suppress(OSError):  # the program is not there, or its buffer is full
            self._socket.sendto(frame(self._session, self._sequence, stamp_ns,
                                      (forward, left, turn)),
                                self.parameters.socket)
