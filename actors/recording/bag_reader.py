"""Reads and repairs recordings, and MCAP files of others as far as they can be read.

A file is read from its beginning, with the records of the `mcap` library. A recorder that was
killed leaves no index and often half a chunk. A file that was closed has an index, under a checksum
of its own, that gives the place, the length and the times of every chunk: with it, damage in one
chunk costs that chunk alone, whatever its bytes have become. Chunks are held to their checksums, so
that no damage makes a message.
"""

from __future__ import annotations

import bisect
import contextlib
import math
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from rampart.actors.recording.bag_writer import (
    END,
    KEY,
    PROFILE,
    RUN,
    UNHEARD,
    BagError,
    open_target,
)
from rampart.actors.recording.run_documents import MAX_FILE_BYTES
from rampart.files.plain_text import shown

MAX_RECORD_BYTES = (64 << 20) + (64 << 10)
"""Of a record: an attached file of 64 MB and what stands around it."""

MAX_CHUNK_BYTES = 64 << 20
"""Of a chunk, unpacked, as it is declared. Writers close one at 1 MB or 4 MB."""

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_COMPRESSIONS = ("", "lz4", "zstd")
_TORN = (McapError, struct.error, EOFError, RuntimeError, MemoryError, OverflowError, ValueError,
         zstandard.ZstdError)
"""What reading a damaged record raises; lz4 raises RuntimeError."""


class Gap(msgspec.Struct, frozen=True):
    """Bytes of a file whose content is gone.

    Attributes:
        what: the kind of the record, and why it cannot be read.
        from_byte: first byte.
        to_byte: first byte after it.
        from_ns: `log_time` of the first message that is gone; None if it is not known.
        to_ns: of the last one.
    """

    what: str
    from_byte: int
    to_byte: int
    from_ns: int | None = None
    to_ns: int | None = None


class BagReader:
    """One file. Use: iterate over `records`, as often as needed; the rest is true of the last time.

    Args:
        path: of the file.

    Attributes:
        profile: the kind of file, as its writer says.
        library: its writer.
        closed: whether its writer came to the end.
        gaps: what could not be read.
        faults: what is damaged without a loss.
        schemas: by number.
        channels: by number.
        metadata: by name.

    Raises:
        BagError: there is no such file, or it is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
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
        self.profile = ""
        self.library = ""
        self.closed = False
        self.gaps: list[Gap] = []
        self.faults: list[str] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def records(self) -> Iterator[McapRecord]:
        """Return metadata, attachments and messages in the order of the file.

        Raises:
            BagError: it is compressed in a way that is not known here, a chunk is too large, or the
                file cannot be read any more.
        """
        self._reset()
        try:
            with self.path.open("rb") as file:
                for record in self._walk(file, self._index(file)):
                    if isinstance(record, Metadata):
                        self.metadata[record.name] = record.metadata
                    yield record
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

    @property
    def damage(self) -> str:
        """What is damaged, in words; empty if nothing is."""
        return ", ".join([*self.faults, *(f"{gap.what} (bytes {gap.from_byte} to {gap.to_byte})"
                                          for gap in self.gaps)])

    def _index(self, file: BinaryIO) -> _Index:
        """Return the index at the end of a file if it is whole, and keep the channels in it."""
        at = max(len(_MAGIC), self.size_bytes - _FOOTER.size - len(_MAGIC))
        file.seek(at)
        tail = file.read()
        if len(tail) != _FOOTER.size + len(_MAGIC) or not tail.endswith(_MAGIC):
            return _Index(is_whole=False)
        kind, length, start, _offsets, checksum = _FOOTER.unpack_from(tail)
        if (kind, length) != (Opcode.FOOTER, _FOOTER.size - _HEAD.size) or (
                start and not at - MAX_RECORD_BYTES < start <= at):
            return _Index(is_whole=False)
        file.seek(start or at)
        summary = file.read(at - (start or at))
        if checksum and zlib.crc32(tail[:_FOOTER.size - 4], zlib.crc32(summary)) != checksum:
            return _Index(is_whole=False)
        index = _Index(start)
        try:
            for record in StreamReader(BytesIO(summary + tail), skip_magic=True).records:
                if isinstance(record, Schema):
                    self.schemas[record.id] = record
                elif isinstance(record, Channel):
                    self.channels[record.id] = record
                else:
                    index.add(record)
        except _TORN:
            return _Index(is_whole=False)
        return index

    def _walk(self, file: BinaryIO, index: _Index) -> Iterator[McapRecord]:
        """Return what can be read, record by record, and from place to place of the index."""
        at, stop = len(_MAGIC), index.start or self.size_bytes
        self.closed = bool(index.start)
        while at < stop:
            entry, until = index.at.get(at), index.following(at) or stop
            if entry is None and index.at and self.profile == PROFILE:
                at = until  # all that a recording has is in its index
                continue
            file.seek(at)
            head = file.read(_HEAD.size)
            kind, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            if entry is not None and (kind, length) != (entry.kind, entry.end - at - _HEAD.size):
                self.faults.append(f"the head of a record at byte {at}")
                kind, length = entry.kind, entry.end - at - _HEAD.size
            end = at + _HEAD.size + length
            if end > until or not (Opcode.HEADER <= kind <= Opcode.DATA_END or kind >= _PRIVATE):
                self._gone("not a record" if until < self.size_bytes else "cut off", at, until)
                at = until
                continue
            if kind in _WANTED:
                yield from self._read(file, kind, (at, end), entry)
            if kind == Opcode.DATA_END:
                self.closed = True
                break
            at = entry.next if entry else end
        if not index.is_whole:
            self.faults.append("the last bytes" if self.closed else f"no end after byte {at}")

    def _read(self, file: BinaryIO, kind: int, span: tuple[int, int], entry: _Entry | None
              ) -> Iterator[McapRecord]:
        """Return what is in one record."""
        size = span[1] - span[0]
        if size > MAX_RECORD_BYTES:
            self._gone(f"a record of {size} bytes, at most {MAX_RECORD_BYTES} are read", *span,
                       entry)
            return
        file.seek(span[0] + _HEAD.size)
        data = _HEAD.pack(kind, size - _HEAD.size) + file.read(size - _HEAD.size)
        try:
            record = next(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records)
            content = self._in_chunk(record, entry) if isinstance(record, Chunk) else [record]
            if isinstance(record, Attachment):
                _check_attachment(record, data)
        except _TORN as error:
            name = _WANTED[kind]
            self._gone(f"{name} ({' '.join(str(error).split()) or type(error).__name__})", *span,
                       entry)
            return
        if isinstance(record, Header):
            self.profile, self.library = record.profile, record.library
            return
        if isinstance(record, Schema | Channel | Message) and self.profile == PROFILE:
            self._gone(f"{_WANTED[kind]} outside a chunk, where a recording has none", *span)
            return
        orphans = 0
        for it in content:
            if isinstance(it, Schema):
                self.schemas[it.id] = it
            elif isinstance(it, Channel):
                self.channels[it.id] = it
            elif isinstance(it, Message) and it.channel_id not in self.channels:
                orphans += 1
            else:
                yield it
        if orphans:
            self._gone(f"{orphans} messages of a channel that is lost", *span, entry)

    def _in_chunk(self, chunk: Chunk, entry: _Entry | None) -> list[McapRecord]:
        """Return the records of a chunk.

        Raises:
            BagError: no chunk like this one is read, by the index.
            ValueError: the chunk is damaged; like the other errors of `_TORN`.
        """
        compression, size = ((entry.compression, entry.unpacked_bytes) if entry else
                             (chunk.compression, chunk.uncompressed_size))
        problem = ""
        if compression not in _COMPRESSIONS:
            problem = f"compressed by {shown(compression)}; known are lz4, zstd and none"
        elif size > MAX_CHUNK_BYTES:
            problem = f"a chunk of {size} bytes, unpacked; at most {MAX_CHUNK_BYTES} are read"
        if problem and entry:
            raise BagError(f"{self.path}: {problem}")
        if problem:
            raise ValueError(problem)
        chunk.compression, chunk.uncompressed_size = compression, size
        return breakup_chunk(chunk, validate_crc=True)

    def _gone(self, what: str, from_byte: int, to_byte: int, entry: _Entry | None = None) -> None:
        times = (entry.from_ns, entry.to_ns) if entry else (None, None)
        self.gaps.append(Gap(what, from_byte, to_byte, *times))


_PRIVATE = 0x80
"""Kinds of records from here on are an application's own."""

_WANTED: dict[int, str] = {
    Opcode.HEADER: "the header", Opcode.SCHEMA: "a schema", Opcode.CHANNEL: "a channel",
    Opcode.MESSAGE: "a message", Opcode.CHUNK: "a chunk", Opcode.ATTACHMENT: "an attachment",
    Opcode.METADATA: "metadata"}


class _Entry(msgspec.Struct):
    """What the index has of one record; times are those of a chunk with messages."""

    kind: int
    end: int
    next: int
    compression: str = ""
    unpacked_bytes: int = 0
    from_ns: int | None = None
    to_ns: int | None = None


class _Index:
    """Where the chunks, attachments and metadata of a file are.

    Args:
        start: first byte of the summary, behind all of them; 0 if there is none.
        is_whole: whether the file has an undamaged end.
    """

    def __init__(self, start: int = 0, *, is_whole: bool = True) -> None:
        self.start = start
        self.is_whole = is_whole
        self.at: dict[int, _Entry] = {}
        self._places: list[int] = []

    def add(self, record: McapRecord) -> None:
        """Note a record of the index; others do not count."""
        match record:
            case ChunkIndex():
                at, end = record.chunk_start_offset, record.chunk_start_offset + record.chunk_length
                has_messages = bool(record.message_end_time or record.message_index_length)
                entry = _Entry(
                    Opcode.CHUNK, end, end + record.message_index_length, record.compression,
                    record.uncompressed_size,
                    record.message_start_time if has_messages else None,
                    record.message_end_time if has_messages else None)
            case AttachmentIndex() | MetadataIndex():
                at, end = record.offset, record.offset + record.length
                kind = (Opcode.METADATA if isinstance(record, MetadataIndex)
                        else Opcode.ATTACHMENT)
                entry = _Entry(kind, end, end)
            case _:
                return
        if len(_MAGIC) <= at < at + _HEAD.size <= end <= entry.next <= self.start:
            self.at[at] = entry
            bisect.insort(self._places, at)

    def following(self, at: int) -> int | None:
        """Return the first place of the index after a byte."""
        found = bisect.bisect_right(self._places, at)
        return self._places[found] if found < len(self._places) else None


def _check_attachment(record: Attachment, data: bytes) -> None:
    """Hold an attachment to its checksum, which `mcap` does not.

    Raises:
        ValueError: it is not what was written.
    """
    fixed = 8 + 8 + 4 + 4 + 8  # two times, and the lengths of name, media type and data
    end = _HEAD.size + fixed + sum(map(len, (
        record.name.encode(), record.media_type.encode(), record.data)))
    checksum = int.from_bytes(data[end:end + 4], "little")
    if checksum and zlib.crc32(data[_HEAD.size:end]) != checksum:
        raise ValueError("its checksum is another")


def key_of(channel: Channel) -> str | None:
    """Return the full key of a channel of the bus; None for views and channels of others."""
    return channel.metadata.get(KEY)


def time_zero_s(reader: BagReader) -> float:
    """Return the simulated time at `log_time` 0 of a file that was read; 0 in files of others."""
    try:
        zero_s = float(reader.metadata.get(RUN, {}).get("time_zero_s", "0"))
    except ValueError:
        return 0.0
    return zero_s if math.isfinite(zero_s) else 0.0


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
        """Simulated time at `log_time` 0."""
        return time_zero_s(self.reader)

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
