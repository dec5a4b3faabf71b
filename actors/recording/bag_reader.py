"""Reads and repairs recordings, and MCAP files of others as far as they can be read.

The file is read from its beginning and nothing in it is believed before it was read whole: a
recorder that was killed leaves no summary, and often half a chunk. What is damaged is left out and
said so; the rest counts.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from rampart.actors.recording import bag_records as br
from rampart.actors.recording.bag_writer import END, KEY, RUN, UNHEARD, BagError, open_target
from rampart.actors.recording.run_documents import MAX_FILE_BYTES
from rampart.files.reading import shown

MAX_EXPANSION = 16 << 20, 64
"""What a file may be unpacked: so many bytes, and so many times its own size on top. Ours are a
tenth unpacked; one of nothing but equal messages in lz4 would be 255 times as large."""

MAX_KEPT_BYTES = 64 << 20
"""Of schemas, channels and metadata, which are kept while a file is read."""


class BagReader:
    """One file. Use: iterate over `records`, as often as needed; the rest is true of the last time.

    Args:
        path: of the file.

    Attributes:
        profile: the kind of file, as its writer says.
        library: its writer.
        closed: whether its writer came to the end.
        damage: what could not be read; empty if nothing was.
        schemas: by number.
        channels: by number.
        metadata: by name.

    Raises:
        BagError: there is no such file, or it is no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.profile = ""
        self.library = ""
        self._reset()
        try:
            self.size_bytes = path.stat().st_size
            if not path.is_file():
                raise BagError(f"{path}: not a file")
            with path.open("rb") as file:
                start = file.read(8)
        except OSError as error:
            raise BagError(f"{path}: cannot be read: {error.strerror}") from None
        if not start:
            raise BagError(f"{path}: is empty: no recording")
        if start != _MAGIC:
            raise BagError(f"{path}: not an MCAP file: it begins with {start[:8]!r}")

    def _reset(self) -> None:
        self.closed = False
        self.damage = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self._unpacked_bytes = 0
        self._kept_bytes = 0

    def records(self) -> Iterator[McapRecord]:
        """Return metadata, attachments and messages in the order of the file.

        Raises:
            BagError: it is compressed in a way that is not known here, is far larger than it
                looks, or cannot be read any more.
        """
        self._reset()
        try:
            with self.path.open("rb") as file:
                for record in self._raw(file):
                    if isinstance(record, Chunk):
                        yield from self._messages(record)
                    elif isinstance(record, Metadata):
                        self._keep(self.metadata, record.name, record.metadata)
                        yield record
                    elif isinstance(record, Attachment):
                        yield record
                    elif isinstance(record, Header):
                        self.profile, self.library = record.profile, record.library
                    else:
                        yield from self._content(record)
        except OSError as error:
            raise BagError(f"{self.path}: cannot be read: {error.strerror}") from None

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Return the messages with their channels, in the order of the file."""
        for record in self.records():
            if isinstance(record, Message):
                yield self.channels[record.channel_id], record

    @property
    def is_recording(self) -> bool:
        """Whether it was written by this program, as far as was read."""
        return RUN in self.metadata

    def _raw(self, file: BinaryIO) -> Iterator[McapRecord]:
        """Return the records as far as they can be read."""
        whole = file.seek(len(_MAGIC))
        while True:
            head = file.read(br.HEAD.size)
            kind, length = (
                br.HEAD.unpack(head) if len(head) == br.HEAD.size else (0, self.size_bytes))
            if length > self.size_bytes - file.tell():
                self._damaged(f"cut off after byte {whole}")
                return
            if kind == Opcode.FOOTER:
                file.seek(length, 1)
                if file.read(len(_MAGIC)) != _MAGIC:
                    self._damaged("the last bytes")
                return
            if kind not in br.WANTED or length > br.MAX_RECORD_BYTES:
                if kind in br.WANTED:
                    self._damaged(f"a record of {length} bytes, at most {br.MAX_RECORD_BYTES} are "
                                  "read")
                whole = file.seek(length, 1)
                continue
            try:
                record = br.record_of(kind, file.read(length))
            except br.TORN:
                self._damaged(f"cut off after byte {whole}")
                return
            whole = file.tell()
            self.closed = self.closed or kind == Opcode.DATA_END
            if not self.closed:  # after it comes the index, which says everything once more
                yield record

    def _messages(self, chunk: Chunk) -> Iterator[McapRecord]:
        if chunk.compression not in br.COMPRESSIONS:
            raise BagError(f"{self.path}: compressed by {shown(chunk.compression)}; known are lz4, "
                           "zstd and none")
        try:
            data = br.unpacked(chunk)
            self._unpacked_bytes += len(data)
            at_least, times = MAX_EXPANSION
            if self._unpacked_bytes > at_least + times * self.size_bytes:
                raise BagError(f"{self.path}: unpacks to more than {times} times its size; no "
                               "recording does")
            for record in br.records_in(data):
                yield from self._content(record)
        except br.ExpansionError as error:
            raise BagError(f"{self.path}: {error}") from None
        except br.TORN as error:
            self._damaged(f"a chunk ({type(error).__name__})")

    def _content(self, record: Any) -> Iterator[Message]:
        """Note schemas and channels, return messages: what stands in a chunk, or without one."""
        if isinstance(record, Schema):
            self._keep(self.schemas, record.id, record)
        elif isinstance(record, Channel):
            self._keep(self.channels, record.id, record)
        elif isinstance(record, Message) and record.channel_id in self.channels:
            yield record
        elif isinstance(record, Message):
            self._damaged("messages of a channel that was lost")

    def _keep(self, kept: dict[Any, Any], name: int | str, what: Any) -> None:
        self._kept_bytes += _bytes_of(what) - _bytes_of(kept.get(name))
        if self._kept_bytes > MAX_KEPT_BYTES:
            raise BagError(f"{self.path}: more than {MAX_KEPT_BYTES >> 20} MB of schemas, channels "
                           "and metadata")
        kept[name] = what

    def _damaged(self, what: str) -> None:
        if what not in self.damage:
            self.damage = f"{self.damage}, {what}" if self.damage else what


_MAGIC = b"\x89MCAP0\r\n"


_ENTRY_BYTES = 200
"""That an entry of a dictionary takes besides its text."""


def _bytes_of(what: Any) -> int:
    match what:
        case Schema():
            return len(what.data) + len(what.name) + len(what.encoding)
        case Channel():
            return len(what.topic) + len(what.message_encoding) + _bytes_of(what.metadata)
        case dict():
            return sum(len(key) + len(value) + _ENTRY_BYTES for key, value in what.items())
    return 0


def key_of(channel: Channel) -> str | None:
    """Return the full key of a channel of the bus; None for views and channels of others."""
    return channel.metadata.get(KEY)


class Summary:
    """What is in a file: counts, times, and what its metadata tells.

    Args:
        reader: of the file, which is read once.

    Attributes:
        files: names, media types and content of what is attached; the content of those that go
            beyond what a recording attaches is left out.
    """

    def __init__(self, reader: BagReader) -> None:
        self.reader = reader
        self.counts = Counter[int]()
        self.files: list[tuple[str, str, bytes]] = []
        self.first_ns: int | None = None
        self.last_ns = 0
        left = MAX_FILE_BYTES
        for record in reader.records():
            if isinstance(record, Message):
                self.counts[record.channel_id] += 1
                at_ns = record.log_time
                self.first_ns = at_ns if self.first_ns is None else min(self.first_ns, at_ns)
                self.last_ns = max(self.last_ns, at_ns)
            elif isinstance(record, Attachment):
                data = record.data if len(record.data) <= left else b""
                left -= len(data)
                self.files.append((record.name, record.media_type, data))
        self.run = reader.metadata.get(RUN, {})
        self.end = reader.metadata.get(END, {})

    @property
    def messages(self) -> int:
        """How many, of all channels."""
        return self.counts.total()

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        return (self.last_ns - (self.first_ns or 0)) / 1e9

    @property
    def time_zero_s(self) -> float:
        """Simulated time at `log_time` 0; 0 in files of others."""
        try:
            zero_s = float(self.run.get("time_zero_s", "0"))
        except ValueError:
            return 0.0
        return zero_s if math.isfinite(zero_s) else 0.0

    @property
    def unheard(self) -> dict[str, list[tuple[float, float | None]]]:
        """Host → from when to when it was not heard, simulated seconds; None is to the end.

        Of the hosts on which it was not made. What makes no sense is left out.
        """
        found = {}
        for host, text in self.reader.metadata.get(UNHEARD, {}).items():
            with contextlib.suppress(ValueError, RecursionError):
                found[host] = msgspec.json.decode(text, type=list[tuple[float, float | None]])
        return found

    @property
    def keys(self) -> dict[str, int]:
        """Full key → messages, of the channels of the bus."""
        return {key: self.counts[number] for number, channel in self.reader.channels.items()
                if (key := key_of(channel)) is not None}

    def table(self) -> list[dict[str, Any]]:
        """Return one row per channel, by name."""
        rows = []
        for number, channel in self.reader.channels.items():
            schema, count = self.reader.schemas.get(channel.schema_id), self.counts[number]
            rows.append({
                "channel": channel.topic, "schema": schema.name if schema else "",
                "messages": count, "bus": key_of(channel) is not None,
                "rate_hz": round(count / self.duration_s, 2) if self.duration_s > 0 else None})
        return sorted(rows, key=lambda row: str(row["channel"]))


def repair(reader: BagReader, target: Path, *, overwrite: bool = False) -> int:
    """Copy everything that can be read, and return how many messages that were.

    A copy that does not come to its end is not left behind.

    Raises:
        BagError: the target exists, is the source, or cannot be written; or the source cannot be
            read.
    """
    if target.exists() and target.samefile(reader.path):
        raise BagError(f"{target}: is the file to be repaired; give another name")
    records = reader.records()
    first = next(records, None)  # now the header was read
    copied = 0
    file = open_target(target, overwrite=overwrite)
    try:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start(reader.profile, reader.library)
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        for it in chain([first], records):
            if isinstance(it, Attachment):
                writer.add_attachment(
                    it.create_time, it.log_time, it.name, it.media_type, it.data)
            elif isinstance(it, Metadata):
                writer.add_metadata(it.name, it.metadata)
            elif isinstance(it, Message):
                if it.channel_id not in channels:
                    channels[it.channel_id] = _registered(writer, reader, it.channel_id, schemas)
                writer.add_message(channels[it.channel_id], it.log_time, it.data, it.publish_time,
                                   it.sequence)
                copied += 1
        writer.finish()
        file.close()
    except BaseException as error:
        with contextlib.suppress(OSError):
            file.close()
        if target.is_file():  # and no device
            target.unlink()
        if isinstance(error, OSError):
            raise BagError(f"{target}: {error.strerror or error}") from None
        raise
    return copied


def _registered(writer: Writer, reader: BagReader, number: int, schemas: dict[int, int]) -> int:
    channel = reader.channels[number]
    known = reader.schemas.get(channel.schema_id)
    if channel.schema_id not in schemas:
        schemas[channel.schema_id] = writer.register_schema(
            known.name, known.encoding, known.data) if known else 0
    return writer.register_channel(
        channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata)
