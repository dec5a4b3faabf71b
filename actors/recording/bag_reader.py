"""Reads and repairs recordings, and the MCAP files of other tools.

The `mcap` library parses records, index and chunks. Its readers stop at the first damaged byte;
this one goes on. A closed file has an index with its own checksum, and with the place and times of
every chunk. So damage in a chunk costs that chunk only. A file without an end, as a killed recorder
leaves it, is read record by record from its beginning. A chunk with a wrong checksum is dropped, so
damage never creates a message.
"""

from __future__ import annotations

import math
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec
import zstandard
from mcap import records as rec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from rampart.actors.recording.bag_writer import (
    END,
    KEY,
    PROFILE,
    RUN,
    BagError,
    complete,
    open_target,
)
from rampart.actors.recording.run_documents import MAX_FILE_BYTES
from rampart.files.plain_text import shown

MAX_RECORD_BYTES = (64 << 20) + (64 << 10)
"""Largest record: an attached file of 64 MB with its name and times."""

MAX_CHUNK_BYTES = 64 << 20
"""Largest chunk, uncompressed. Writers close a chunk at 1 MB or 4 MB."""

_MAGIC, _ZSTD = b"\x89MCAP0\r\n", b"\x28\xb5\x2f\xfd"
_HEAD = struct.Struct("<BQ")
_PRIVATE = 0x80
"""First opcode for applications."""

_COMPRESSIONS = ("", "lz4", "zstd")
_RECORDS: dict[int, Any] = {
    Opcode.HEADER: rec.Header, Opcode.SCHEMA: rec.Schema, Opcode.CHANNEL: rec.Channel,
    Opcode.MESSAGE: rec.Message, Opcode.CHUNK: rec.Chunk, Opcode.ATTACHMENT: rec.Attachment,
    Opcode.METADATA: rec.Metadata}
_TORN = (McapError, struct.error, EOFError, RuntimeError, MemoryError, OverflowError, ValueError,
         zstandard.ZstdError)
"""Raised for damaged records; lz4 raises RuntimeError."""


class Gap(msgspec.Struct, frozen=True):
    """Bytes of a file whose content is lost.

    Attributes:
        what: kind of the record, and the reason.
        from_byte: first byte.
        to_byte: first byte after it.
        from_ns: `log_time` of the first lost message; None if unknown.
        to_ns: `log_time` of the last one.
    """

    what: str
    from_byte: int
    to_byte: int
    from_ns: int | None = None
    to_ns: int | None = None


class BagReader:
    """One file. Iterate over `records` as often as needed; the attributes are of the latest time.

    Args:
        path: path of the file.

    Attributes:
        profile: kind of the file, as its writer names it.
        library: name of its writer.
        closed: whether the writer finished the file.
        gaps: parts that could not be read.
        faults: damage without loss.
        schemas: by number.
        channels: by number.
        metadata: by name.

    Raises:
        BagError: the file does not exist, or its format is not known.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reset()
        try:
            self.size_bytes = path.stat().st_size
            if not path.is_file():
                inside = ", ".join(sorted(file.name for file in path.glob("*.[md][cb]*")))
                raise BagError(f"{path}: not a file{inside and f'; it has {inside}'}")
            with path.open("rb") as file:
                start = file.read(8)
        except OSError as error:
            raise BagError(f"{path}: cannot be read: {error.strerror}") from None
        if not start:
            raise BagError(f"{path}: is empty; expected a recording")
        if start.startswith(_ZSTD):
            raise BagError(f"{path}: compressed as a whole; decompress it first (zstd -d)")
        if start != _MAGIC:
            raise BagError(f"{path}: not an MCAP file: it begins with {start!r}")

    def _reset(self) -> None:
        self.profile = ""
        self.library = ""
        self.closed = False
        self.gaps: list[Gap] = []
        self.faults: list[str] = []
        self.schemas: dict[int, rec.Schema] = {}
        self.channels: dict[int, rec.Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def records(self) -> Iterator[rec.McapRecord]:
        """Yield metadata, attachments and messages in the order of the file.

        Raises:
            BagError: the compression is not known, a chunk is too large, or reading fails.
        """
        self._reset()
        try:
            with self.path.open("rb") as file:
                for record in self._walk(file):
                    if isinstance(record, rec.Metadata):
                        self.metadata[record.name] = record.metadata
                    yield record
        except OSError as error:
            raise BagError(f"{self.path}: cannot be read: {error.strerror}") from None

    def messages(self) -> Iterator[tuple[rec.Channel, rec.Message]]:
        """Yield the messages with their channels in the order of the file."""
        for record in self.records():
            if isinstance(record, rec.Message):
                yield self.channels[record.channel_id], record

    @property
    def is_recording(self) -> bool:
        """Whether this program wrote the file; known once its beginning was read."""
        return RUN in self.metadata

    @property
    def damage(self) -> str:
        """Description of the damage; empty if there is none."""
        return ", ".join([*self.faults, *(f"{gap.what} (bytes {gap.from_byte} to {gap.to_byte})"
                                          for gap in self.gaps)])

    def _walk(self, file: BinaryIO) -> Iterator[rec.McapRecord]:
        """Yield the readable records; after damage go on at the next record of the index."""
        index = self._index(file)
        places, stop = index or ({}, self.size_bytes)
        starts = [*sorted(places), stop]
        self.closed = index is not None
        at = len(_MAGIC)
        while at < stop:
            until = starts[bisect_right(starts, at)]
            place = places.get(at) or _place_at(file, at)
            if place is None or place.next > until:
                self._lose("not a record" if until < self.size_bytes else "cut off", at, until)
                at = until
                continue
            yield from self._read(file, at, place)
            if place.kind == Opcode.DATA_END:
                self.closed = True
                break
            at = place.next
        if index is None:
            self.faults.append("the last bytes" if self.closed else f"no end after byte {at}")

    def _index(self, file: BinaryIO) -> tuple[dict[int, _Place], int] | None:
        """Return the records in the index by their first byte, and the first byte of the summary.

        None if the end of the file is damaged or missing. Schemas and channels are kept.

        Raises:
            BagError: a chunk has an unsupported compression or size.
        """
        places: dict[int, _Place] = {}
        footer_at = max(len(_MAGIC), self.size_bytes - FOOTER_SIZE - len(_MAGIC))
        try:
            file.seek(footer_at)
            tail = file.read()
            [footer] = StreamReader(BytesIO(tail), skip_magic=True).records
            if not isinstance(footer, rec.Footer) or footer.summary_start > footer_at:
                return None
            start = footer.summary_start or footer_at
            file.seek(start)
            summary = file.read(footer_at - start) + tail
            signed = summary[:-len(_MAGIC) - 4]
            if footer.summary_crc and zlib.crc32(signed) != footer.summary_crc:
                return None
            for record in StreamReader(BytesIO(summary), skip_magic=True).records:
                if isinstance(record, rec.Schema):
                    self.schemas[record.id] = record
                elif isinstance(record, rec.Channel):
                    self.channels[record.id] = record
                elif isinstance(record, rec.ChunkIndex | rec.AttachmentIndex | rec.MetadataIndex):
                    at, place = _indexed(record)
                    if len(_MAGIC) <= at < at + _HEAD.size <= place.end <= place.next <= start:
                        places[at] = place
                if isinstance(record, rec.ChunkIndex) and (problem := _unsupported(record)):
                    raise BagError(f"{self.path}: {problem}")
        except _TORN:
            return None
        return places, start

    def _read(self, file: BinaryIO, at: int, place: _Place) -> Iterator[rec.McapRecord]:
        if place.kind not in _RECORDS:
            return
        name = _RECORDS[place.kind].__name__.lower()
        orphans = 0
        try:
            if place.end - at > MAX_RECORD_BYTES:
                raise ValueError(f"a record of {place.end - at} bytes; at most {MAX_RECORD_BYTES} "
                                 "are read")
            file.seek(at + _HEAD.size)
            content = _parsed(place.kind, file.read(place.end - at - _HEAD.size))
            if place.kind in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE} and (
                    self.profile == PROFILE):
                raise ValueError("outside a chunk; recordings have none there")
        except _TORN as error:
            why = " ".join(str(error).split()) or type(error).__name__
            self._lose(f"{name} ({why})", at, place.end, *place.times)
            return
        for record in content:
            if isinstance(record, rec.Header):
                self.profile, self.library = record.profile, record.library
            elif isinstance(record, rec.Schema):
                self.schemas[record.id] = record
            elif isinstance(record, rec.Channel):
                self.channels[record.id] = record
            elif isinstance(record, rec.Message) and record.channel_id not in self.channels:
                orphans += 1
            else:
                yield record
        if orphans:
            self._lose(f"{orphans} messages of a lost channel", at, place.end, *place.times)

    def _lose(self, what: str, from_byte: int, to_byte: int, from_ns: int | None = None,
              to_ns: int | None = None) -> None:
        self.gaps.append(Gap(what, from_byte, to_byte, from_ns, to_ns))


class _Place(NamedTuple):
    """End of a record, beginning of the next one, and the times of its messages, ns."""

    kind: int
    end: int
    next: int
    times: tuple[int, int] | tuple[()] = ()


def _place_at(file: BinaryIO, at: int) -> _Place | None:
    """Return the place of the record that begins at a byte, None if none does."""
    file.seek(at)
    head = file.read(_HEAD.size)
    kind, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
    end = at + _HEAD.size + length
    is_record = Opcode.HEADER <= kind <= Opcode.DATA_END or kind >= _PRIVATE
    return _Place(kind, end, end) if is_record else None


def _indexed(record: rec.ChunkIndex | rec.AttachmentIndex | rec.MetadataIndex
             ) -> tuple[int, _Place]:
    """Return the first byte of a record in the index, and its place."""
    if isinstance(record, rec.ChunkIndex):
        end = record.chunk_start_offset + record.chunk_length
        has_messages = record.message_end_time or record.message_index_length
        return record.chunk_start_offset, _Place(
            Opcode.CHUNK, end, end + record.message_index_length,
            (record.message_start_time, record.message_end_time) if has_messages else ())
    end = record.offset + record.length
    kind = Opcode.METADATA if isinstance(record, rec.MetadataIndex) else Opcode.ATTACHMENT
    return record.offset, _Place(kind, end, end)


def _unsupported(chunk: rec.Chunk | rec.ChunkIndex) -> str:
    """Return why a chunk cannot be read; empty if it can."""
    if chunk.compression not in _COMPRESSIONS:
        return f"compressed by {shown(chunk.compression)}; expected lz4, zstd or none"
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        return (f"a chunk of {chunk.uncompressed_size} bytes uncompressed; at most "
                f"{MAX_CHUNK_BYTES} are read")
    return ""


def _parsed(kind: int, data: bytes) -> list[rec.McapRecord]:
    """Return a record, or those of a chunk; raises one of `_TORN` if it is damaged."""
    stream = ReadDataStream(BytesIO(data))
    if kind == Opcode.MESSAGE:
        return [rec.Message.read(stream, len(data))]
    record = _RECORDS[kind].read(stream)
    if isinstance(record, rec.Chunk):
        if problem := _unsupported(record):
            raise ValueError(problem)
        return breakup_chunk(record, validate_crc=True)
    if isinstance(record, rec.Attachment):  # the library leaves its checksum out
        end = stream.count - 4
        checksum = int.from_bytes(data[end:stream.count], "little")
        if checksum and zlib.crc32(data[:end]) != checksum:
            raise ValueError("wrong checksum")
    return [record]


def key_of(channel: rec.Channel) -> str | None:
    """Return the full key of a channel of the bus; None for views and files of other tools."""
    return channel.metadata.get(KEY)


def time_zero_s(reader: BagReader) -> float:
    """Return the simulated time at `log_time` 0 of a file that was read; 0 if it has none."""
    try:
        zero_s = float(reader.metadata.get(RUN, {}).get("time_zero_s", "0"))
    except ValueError:
        return 0.0
    return zero_s if math.isfinite(zero_s) else 0.0


class Summary:
    """Content of a file: counts, times and metadata.

    Args:
        reader: of the file, which is read once.

    Attributes:
        files: names, media types and content of the attachments; content beyond the size that a
            recording attaches is empty.
    """

    def __init__(self, reader: BagReader) -> None:
        self.reader = reader
        self.counts = Counter[int]()
        self.files: list[tuple[str, str, bytes]] = []
        first_ns, last_ns, left = math.inf, 0, MAX_FILE_BYTES
        for record in reader.records():
            if isinstance(record, rec.Message):
                self.counts[record.channel_id] += 1
                first_ns = min(first_ns, record.log_time)
                last_ns = max(last_ns, record.log_time)
            elif isinstance(record, rec.Attachment):
                data = record.data if len(record.data) <= left else b""
                left -= len(data)
                self.files.append((record.name, record.media_type, data))
        self.first_ns = None if math.isinf(first_ns) else int(first_ns)
        self.last_ns = last_ns
        self.run = reader.metadata.get(RUN, {})
        self.end = reader.metadata.get(END, {})
        self.time_zero_s = time_zero_s(reader)

    @property
    def messages(self) -> int:
        """Number of messages of all channels."""
        return self.counts.total()

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.last_ns - (self.first_ns or 0)) / 1e9

    @property
    def keys(self) -> dict[str, int]:
        """Full key → number of messages, of the channels of the bus."""
        return {key: self.counts[number] for number, channel in self.reader.channels.items()
                if (key := key_of(channel)) is not None}

    def table(self) -> list[dict[str, Any]]:
        """Return one row per channel, by name."""
        schemas, span_s = self.reader.schemas, self.duration_s
        return sorted(({
            "channel": channel.topic,
            "schema": schemas[channel.schema_id].name if channel.schema_id in schemas else "",
            "messages": self.counts[number], "bus": key_of(channel) is not None,
            "rate_hz": round(self.counts[number] / span_s, 2) if span_s > 0 else None}
            for number, channel in self.reader.channels.items()), key=lambda row: row["channel"])


def repair(reader: BagReader, target: Path, *, overwrite: bool = False) -> int:
    """Copy everything that can be read, and return the number of messages.

    An incomplete copy is deleted.

    Raises:
        BagError: the target exists, is the source, or cannot be written, or the source cannot be
            read.
    """
    if target.exists() and target.samefile(reader.path):
        raise BagError(f"{target}: is the file to repair; choose another name")
    records = reader.records()
    first = next(records, None)  # the header is read by now
    copied = 0
    file = open_target(target, overwrite=overwrite)
    with complete(target), file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start(reader.profile, reader.library)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for it in chain([first], records):
            if isinstance(it, rec.Attachment):
                writer.add_attachment(
                    it.create_time, it.log_time, it.name, it.media_type, it.data)
            elif isinstance(it, rec.Metadata):
                writer.add_metadata(it.name, it.metadata)
            elif isinstance(it, rec.Message):
                channel = reader.channels[it.channel_id]
                schema = reader.schemas.get(channel.schema_id)
                if schema and schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(
                        schema.name, schema.encoding, schema.data)
                if channel.id not in channels:
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding,
                        schemas[schema.id] if schema else 0, channel.metadata)
                writer.add_message(channels[channel.id], it.log_time, it.data, it.publish_time,
                                   it.sequence)
                copied += 1
        writer.finish()
    return copied
