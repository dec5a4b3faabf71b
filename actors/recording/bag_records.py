"""Single records of an MCAP file, and what is in a chunk of them, within bounds.

A chunk says how large it is unpacked, and need not tell the truth: 98 kB of a file can stand for
3 GB. So it is unpacked only as far as it may be long, and looked through record by record; and a
record that would be too long to hold is not read at all.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord, Message

MAX_RECORD_BYTES = (64 << 20) + (64 << 10)
"""Of a record: an attached file of 64 MB and what stands round it."""

MAX_CHUNK_BYTES = 64 << 20
"""Of a chunk, unpacked. Writers close one at 1 MB or 4 MB, ours ten times a second."""

TORN = (McapError, struct.error, EOFError, RuntimeError, MemoryError, OverflowError, ValueError,
        zstandard.ZstdError)
"""What reading raises that was cut off or overwritten; lz4 raises RuntimeError."""

COMPRESSIONS = ("", "lz4", "zstd")

HEAD = struct.Struct("<BQ")
"""Of a record: its kind, and the length of what follows."""

_MESSAGE = struct.Struct("<HIQQ")
_LARGEST_WINDOW = 128 << 20


class ExpansionError(ValueError):
    """A chunk that is larger than it may be, or than it says."""


class _Exact(ReadDataStream):
    """A stream that never gives less than was asked for."""

    def read(self, length: int) -> bytes:
        """Return so many bytes.

        Raises:
            EndOfFile: there are not so many.
        """
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


_READ: Mapping[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: records.Header.read, Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read, Opcode.CHUNK: Chunk.read,
    Opcode.ATTACHMENT: records.Attachment.read, Opcode.METADATA: records.Metadata.read,
    Opcode.DATA_END: records.DataEnd.read}
WANTED = frozenset({*_READ, Opcode.MESSAGE})
"""Kinds of records that are read; the others are an index, which says everything once more."""

_IN_CHUNKS = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})


def record_of(kind: int, data: bytes) -> McapRecord:
    """Return the record of a wanted kind that is written in bytes.

    Raises:
        TORN: it is none.
    """
    if kind == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data)
        return Message(channel, log_time, data[_MESSAGE.size:], publish_time, sequence)
    return _READ[kind](_Exact(BytesIO(data)))


def unpacked(chunk: Chunk) -> bytes:
    """Return what is in a chunk, decompressed and found to be what was written.

    Raises:
        ExpansionError: it is too large.
        TORN: it is damaged.
    """
    most, told = MAX_CHUNK_BYTES, chunk.uncompressed_size
    if told > most:
        raise ExpansionError(f"a chunk of {told} bytes, unpacked; at most {most} are read")
    if chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most + 1)
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW).stream_reader(
                chunk.data) as stream:
            data = stream.read(told + 1)
    else:
        data = chunk.data
    if len(data) > most:
        raise ExpansionError(f"a chunk that unpacks to more than {most} bytes, and says {told}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("not what was written, by its checksum")
    return bytes(data)


def records_in(data: bytes) -> Iterator[McapRecord]:
    """Yield schemas, channels and messages of an unpacked chunk, one by one, if it is whole.

    Raises:
        TORN: it is damaged; before the first one, if the lengths do not fit.
    """
    at = 0
    while at < len(data):
        at += HEAD.size + HEAD.unpack_from(data, at)[1]
    if at != len(data):
        raise EndOfFile
    at = 0
    while at < len(data):
        kind, length = HEAD.unpack_from(data, at)
        at += HEAD.size + length
        if kind in _IN_CHUNKS:
            yield record_of(kind, data[at - length:at])
