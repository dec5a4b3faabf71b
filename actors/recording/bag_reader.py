"""Reads recordings, whole and torn ones, and MCAP files of others as far as they can be read.

The file is read from its beginning and nothing in it is believed before it was read whole: a
recorder that was killed leaves no summary, and often half a chunk. What is damaged is left out and
said so; the rest counts.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import InvalidMagic, McapError
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from actors.recording.bag_writer import END, KEY, RUN, BagError

_TORN = (McapError, CRCValidationError, struct.error, UnicodeDecodeError, EOFError, RuntimeError,
         MemoryError, OverflowError, ValueError)
"""What reading a record raises that was cut off or overwritten; lz4 raises RuntimeError."""

_COMPRESSIONS = ("", "lz4", "zstd")


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

    def records(self) -> Iterator[McapRecord]:
        """Return metadata, attachments and messages in the order of the file.

        Raises:
            BagError: it is compressed in a way that is not known here, or cannot be read any more.
        """
        self._reset()
        try:
            with self.path.open("rb") as file:
                for record in self._raw(file):
                    if isinstance(record, Chunk):
                        yield from self._messages(record)
                    elif isinstance(record, Metadata):
                        self.metadata[record.name] = record.metadata
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
        reader = StreamReader(file, emit_chunks=True, record_size_limit=self.size_bytes)
        records = reader.records
        whole = 0
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except InvalidMagic:
                self._damaged("the last bytes")
                return
            except _TORN:
                self._damaged(f"cut off after byte {whole}")
                return
            whole = file.tell()
            if isinstance(record, DataEnd):
                self.closed = True
            elif not self.closed:  # after it comes the index, which says everything once more
                yield record

    def _messages(self, chunk: Chunk) -> Iterator[McapRecord]:
        if chunk.compression not in _COMPRESSIONS:  # the library would take it for not compressed
            raise BagError(f"{self.path}: compressed by {chunk.compression!r}; known are lz4, "
                           "zstd and none")
        try:
            parts = breakup_chunk(chunk, validate_crc=True)
        except (*_TORN, Exception) as error:  # zstandard has errors of its own
            self._damaged(f"a chunk ({type(error).__name__})")
            return
        for record in parts:
            yield from self._content(record)

    def _content(self, record: Any) -> Iterator[Message]:
        """Note schemas and channels, return messages: what stands in a chunk, or without one."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Message):
            if record.channel_id in self.channels:
                yield record
            else:
                self._damaged("messages of a channel that was lost")

    def _damaged(self, what: str) -> None:
        if what not in self.damage:
            self.damage = f"{self.damage}, {what}" if self.damage else what


_MAGIC = b"\x89MCAP0\r\n"


def key_of(channel: Channel) -> str | None:
    """Return the full key of a channel of the bus; None for views and channels of others."""
    return channel.metadata.get(KEY)


class Summary:
    """What is in a file: counts, times, and what its metadata tells.

    Args:
        reader: of the file, which is read once.
    """

    def __init__(self, reader: BagReader) -> None:
        self.reader = reader
        self.counts: dict[int, int] = {}
        self.files: list[tuple[str, str, bytes]] = []
        self.first_ns: int | None = None
        self.last_ns = 0
        for record in reader.records():
            if isinstance(record, Message):
                self.counts[record.channel_id] = self.counts.get(record.channel_id, 0) + 1
                if self.first_ns is None or record.log_time < self.first_ns:
                    self.first_ns = record.log_time
                self.last_ns = max(self.last_ns, record.log_time)
            elif isinstance(record, Attachment):
                self.files.append((record.name, record.media_type, record.data))
        self.run = reader.metadata.get(RUN, {})
        self.end = reader.metadata.get(END, {})

    @property
    def messages(self) -> int:
        """How many, of all channels."""
        return sum(self.counts.values())

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        return (self.last_ns - (self.first_ns or 0)) / 1e9

    @property
    def time_zero_s(self) -> float:
        """Simulated time at `log_time` 0; 0 in files of others."""
        try:
            return float(self.run.get("time_zero_s", "0"))
        except ValueError:
            return 0.0

    @property
    def keys(self) -> dict[str, int]:
        """Full key → messages, of the channels of the bus."""
        return {key: self.counts.get(number, 0)
                for number, channel in self.reader.channels.items()
                if (key := key_of(channel)) is not None}

    def table(self) -> list[dict[str, Any]]:
        """Return one row per channel, by name."""
        rows = []
        for number, channel in self.reader.channels.items():
            schema = self.reader.schemas.get(channel.schema_id)
            count = self.counts.get(number, 0)
            rows.append({
                "channel": channel.topic, "schema": schema.name if schema else "",
                "messages": count,
                "rate_hz": round(count / self.duration_s, 2) if self.duration_s > 0 else None,
                "bus": key_of(channel) is not None})
        return sorted(rows, key=lambda row: str(row["channel"]))
