"""The files of MCAP's conformance suite: 416 combinations of features.

The suite (https://github.com/foxglove/mcap, `tests/conformance`, MIT licence, Foxglove Technologies
Inc.) keeps them in Git LFS. This module writes what its generator writes, so that
each file is the same to the byte: `DIGEST` is of the checksums that the suite's
repository has of its own files.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from itertools import product

from mcap.opcode import Opcode

DIGEST = "eabcfbf8e6525dd4022cb979a3d1793443a31f427cc163be4ddb98e295cd8d01"
"""SHA-256 of "NAME SHA-256\\n" of all files, by name."""

_PADDING = b"\x01\xff\xff"
MAGIC = b"\x89MCAP0\r\n"
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
"""Chunks, message index, statistics, repeated schemas and channels, indexes of attachments,
metadata and chunks, summary offsets, and more bytes in a record than its fields take."""

Record = tuple[int, bytes]
"""Opcode and content."""


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _pairs(pairs: dict[str, str]) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return struct.pack("<I", len(data)) + data


def _message(sequence: int, log_time: int, publish_time: int) -> Record:
    return Opcode.MESSAGE, struct.pack("<HIQQ", 1, sequence, log_time, publish_time) + b"\1\2\3"


_SCHEMA: Record = (Opcode.SCHEMA, struct.pack("<H", 1) + _text("Example") + _text("c")
                   + struct.pack("<I", 3) + b"\4\5\6")
_CHANNEL: Record = (Opcode.CHANNEL, struct.pack("<HH", 1, 1) + _text("example") + _text("a")
                    + _pairs({"foo": "bar"}))
_ATTACHED = (struct.pack("<QQ", 2, 1) + _text("myFile") + _text("application/octet-stream")
             + struct.pack("<Q", 3) + b"\1\2\3")
INPUTS: dict[str, list[Record]] = {
    "NoData": [],
    "OneSchemalessMessage": [
        (Opcode.CHANNEL, struct.pack("<HH", 1, 0) + _text("example") + _text("text") + _pairs({})),
        _message(10, 2, 1)],
    "OneMessage": [_SCHEMA, _CHANNEL, _message(10, 2, 1)],
    "OneAttachment": [(Opcode.ATTACHMENT, _ATTACHED + struct.pack("<I", zlib.crc32(_ATTACHED)))],
    "OneMetadata": [(Opcode.METADATA, _text("myMetadata") + _pairs({"foo": "bar"}))],
    "TenMessages": [_SCHEMA, _CHANNEL, *(
        _message(number, at, at) for number, at in enumerate((0, 2, 1, 3, 3, 5, 4, 7, 8, 9)))],
}


def variants() -> Iterator[tuple[str, list[Record], bytes]]:
    """Yield name, records and bytes of each file."""
    for base, records in INPUTS.items():
        kinds = {kind for kind, _ in records}
        for chosen in product((False, True), repeat=len(FEATURES)):
            has = {name for name, is_chosen in zip(FEATURES, chosen, strict=True) if is_chosen}
            if (("ax" in has and Opcode.ATTACHMENT not in kinds)
                    or ("mdx" in has and Opcode.METADATA not in kinds)
                    or ("rsh" in has and Opcode.SCHEMA not in kinds)
                    or ("rch" in has and Opcode.CHANNEL not in kinds)
                    or (has & {"ch", "chx", "mx"} and Opcode.CHANNEL not in kinds)
                    or ("sum" in has and not has & {"chx", "rsh", "rch", "mdx", "ax", "st"})
                    or (has & {"chx", "mx"} and "ch" not in has)):
                continue
            yield "-".join([base, *sorted(has)]), records, _file(records, has)


def _file(records: list[Record], has: set[str]) -> bytes:
    padding = _PADDING if "pad" in has else b""
    out = bytearray(MAGIC)

    def put(kind: int, content: bytes, pad: bytes = padding) -> int:
        out.extend(struct.pack("<BQ", kind, len(content + pad)) + content + pad)
        return len(content + pad) + 9

    put(Opcode.HEADER, _text("") + _text(""))
    chunk, entries, times, indexes = bytearray(), [], [], {key: [] for key in ("ax", "mdx", "chx")}
    for kind, content in records:
        if kind == Opcode.MESSAGE:
            times.append(struct.unpack_from("<HIQ", content)[2])
            entries.append((times[-1], len(chunk)))
        if kind in {Opcode.ATTACHMENT, Opcode.METADATA}:
            at = len(out)
            size = put(kind, content)
            if kind == Opcode.METADATA:
                indexes["mdx"].append(struct.pack("<QQ", at, size) + _text("myMetadata"))
            else:
                indexes["ax"].append(struct.pack("<QQQQQ", at, size, 2, 1, 3) + _text("myFile")
                                     + _text("application/octet-stream"))
        elif "ch" in has:
            chunk += struct.pack("<BQ", kind, len(content)) + content
        else:
            put(kind, content, b"" if kind == Opcode.MESSAGE else padding)
    if "ch" in has:
        span, at = struct.pack("<QQ", min(times), max(times)), len(out)
        size = put(Opcode.CHUNK, span + struct.pack("<QI", len(chunk), zlib.crc32(chunk))
                   + _text("") + struct.pack("<Q", len(chunk)) + chunk, b"")
        offsets, index_size = b"", 0
        if "mx" in has:
            offsets = struct.pack("<HQ", 1, len(out))
            index_size = put(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, 16 * len(entries))
                             + b"".join(struct.pack("<QQ", *entry) for entry in entries))
        indexes["chx"].append(
            span + struct.pack("<QQI", at, size, len(offsets)) + offsets
            + struct.pack("<Q", index_size) + _text("") + struct.pack("<QQ", *[len(chunk)] * 2))
    put(Opcode.DATA_END, struct.pack("<I", zlib.crc32(out)), b"")
    return bytes(out) + _summary(records, has, len(out), times, indexes) + MAGIC


def _summary(records: list[Record], has: set[str], start: int, times: list[int],
             indexes: dict[str, list[bytes]]) -> bytes:
    padding = _PADDING if "pad" in has else b""
    count = [sum(kind == wanted for kind, _ in records) for wanted in (
        Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA)]
    counts = struct.pack("<HQ", 1, count[0]) if count[0] else b""
    statistics = (struct.pack("<QHIIII", *count, int("ch" in has))
                  + struct.pack("<QQ", min(times, default=0), max(times, default=0))
                  + struct.pack("<I", len(counts)) + counts)
    groups: list[tuple[str, int, list[bytes]]] = [
        ("rsh", Opcode.SCHEMA, [data for kind, data in records if kind == Opcode.SCHEMA]),
        ("rch", Opcode.CHANNEL, [data for kind, data in records if kind == Opcode.CHANNEL]),
        ("st", Opcode.STATISTICS, [statistics]),
        ("mdx", Opcode.METADATA_INDEX, indexes["mdx"]),
        ("ax", Opcode.ATTACHMENT_INDEX, indexes["ax"]),
        ("chx", Opcode.CHUNK_INDEX, indexes["chx"])]
    out, offsets = b"", b""
    for feature, kind, contents in groups:
        if feature not in has or not contents:
            continue
        data = b"".join(struct.pack("<BQ", kind, len(one + padding)) + one + padding
                        for one in contents)
        offset = struct.pack("<BQQ", kind, start + len(out), len(data)) + padding
        offsets += struct.pack("<BQ", Opcode.SUMMARY_OFFSET, len(offset)) + offset
        out += data
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start if out else 0,
                         start + len(out) if "sum" in has else 0)
    out += (offsets if "sum" in has else b"") + footer
    return out + struct.pack("<I", zlib.crc32(out))
