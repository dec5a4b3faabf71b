"""Exports a recording as a bag of ROS 2: MCAP with `cdr` channels, `ros2msg` schemas and metadata.

It has three kinds of topics: messages that passed the gateway, byte for byte under their names in
ROS 2; each key of the bus below `/rampart` with a generated type (`ros_structs`); and the views
(`ros_views`). `rosbags` writes the file as `ros2 bag record` would.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from rampart.actors.bus.envelope import UNREADABLE, Header, decode
from rampart.actors.bus.topic import ROOT, ROS_SIDE, Topic
from rampart.actors.bus.topic import Qos as BusQos
from rampart.actors.recording.bag_reader import BagReader, key_of
from rampart.actors.recording.bag_writer import BagError, complete
from rampart.actors.recording.message_form import Forms
from rampart.actors.recording.ros_structs import StructTypes
from rampart.actors.recording.ros_views import RosViews
from rampart.actors.ros2.translation.types import NO_HASH, Types
from rampart.actors.ros2.wire import ros_name

_OLDER = ("humble", "iron")
"""Distributions with an older version of the metadata."""

_NO_NAME = re.compile(r"[^A-Za-z0-9_/]")
_FOREVER = QosTime(9_223_372_036, 854_775_807)

_PASSED = f"{ROS_SIDE}/data/"
_LEAST_PARTS = 4  # domain, topic, type and hash
_packed = msgspec.msgpack.Decoder(tuple[bytes, bytes | None])

Encoder = tuple[str, str, Callable[[Header, Any, int], bytes]]
"""Topic of ROS 2, its type, and a function that encodes header, body and stamp in nanoseconds."""


class RosBag:
    """Writes a recording as a bag of ROS 2. Call `write` once.

    Args:
        types: of ROS 2.
        topics: known topics of the system.

    Attributes:
        counts: messages by topic of ROS 2.
        left_out: channel that is not in the bag → number of its messages, and the first reason.
    """

    def __init__(self, types: Types, topics: Sequence[Topic[Any]]) -> None:
        self.counts = Counter[str]()
        self.left_out: dict[str, tuple[int, str]] = {}
        self._types = types
        self._structs = StructTypes(types)
        self._views = RosViews(types)
        self._forms = Forms(topics)
        self._encoders: dict[str, Encoder] = {}
        self._connections: dict[str, Any] = {}

    def write(self, reader: BagReader, folder: Path) -> None:
        """Write the bag into a new folder; an incomplete one is deleted.

        Raises:
            BagError: the folder exists or cannot be written, or the recording cannot be read.
        """
        version: Any = 8 if self._types.distribution in _OLDER else 9
        if folder.exists():
            raise BagError(f"{folder}: exists already; choose another name")
        with complete(folder), Writer(
                folder, version=version, storage_plugin=StoragePlugin.MCAP) as writer:
            self._copy(reader, writer)

    def _copy(self, reader: BagReader, writer: Writer) -> None:
        for channel, message in reader.messages():
            key = key_of(channel)
            try:
                if key is not None and key.startswith(f"{ROS_SIDE}/"):
                    self._passed(writer, key, message)
                elif key is not None:
                    self._bus(writer, key, message)
                elif (schema := reader.schemas.get(channel.schema_id)) is not None:
                    for shown in self._views.of(schema.name, channel.topic, message.data):
                        self._write(writer, *shown, message.log_time)
            except (*UNREADABLE, ValueError, TypeError, RecursionError) as error:
                self._leave_out(channel.topic, " ".join(str(error).split()))

    def _bus(self, writer: Writer, key: str, message: Any) -> None:
        form = self._forms.of(key)
        if form.topic is None:
            self._leave_out(key.removeprefix(f"{ROOT}/"), "no known actor declares it")
            return
        header, body = decode(form.topic, form.payload(message.data))
        if key not in self._encoders:
            self._encoders[key] = f"/{_NO_NAME.sub('_', key)}", *self._structs.encoder(form.topic)
        topic, kind, encode = self._encoders[key]
        self._write(writer, topic, kind, encode(header, body, message.publish_time),
                    message.log_time, stays=form.topic.qos is BusQos.STATE)

    def _passed(self, writer: Writer, key: str, message: Any) -> None:
        """Write a message that passed the gateway; those of services belong to no topic."""
        parts = key.removeprefix(_PASSED).split("|")
        if not key.startswith(_PASSED) or len(parts) < _LEAST_PARTS:
            return
        kind, digest = ros_name(parts[-2]), parts[-1]
        if digest not in {NO_HASH, self._types.hash(kind)}:
            raise ValueError(f"{kind}: not the definition of {self._types.distribution}; choose "
                             "another one with --distribution")
        data, _attachment = _packed.decode(self._forms.of(key).payload(message.data))
        self._write(writer, "/" + "/".join(parts[1:-2]), kind, data, message.log_time)

    def _leave_out(self, what: str, why: str) -> None:
        count, first = self.left_out.get(what, (0, why))
        self.left_out[what] = count + 1, first

    def _write(self, writer: Writer, topic: str, kind: str, data: bytes, at_ns: int, *,
               stays: bool = False) -> None:
        connection = self._connections.get(topic)
        if connection is None:
            text, digest = self._types.definition(kind)
            connection = self._connections[topic] = writer.add_connection(
                topic, kind, msgdef=text, rihs01=digest, offered_qos_profiles=[_qos(stays=stays)])
        writer.write(connection, at_ns, data)
        self.counts[topic] += 1


def _qos(*, stays: bool) -> Qos:
    return Qos(QosHistory.KEEP_LAST, 1 if stays else 10, QosReliability.RELIABLE,
               QosDurability.TRANSIENT_LOCAL if stays else QosDurability.VOLATILE,
               _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER,
               avoid_ros_namespace_conventions=False)
