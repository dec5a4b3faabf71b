"""Writes what can be read of a torn MCAP file into a whole one."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mcap.records import Attachment, Message, Metadata
from mcap.writer import CompressionType, Writer

from rampart.actors.recording.bag_reader import BagReader
from rampart.actors.recording.bag_writer import BagError, open_target


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
        while first is not None:
            if isinstance(first, Attachment):
                writer.add_attachment(
                    first.create_time, first.log_time, first.name, first.media_type, first.data)
            elif isinstance(first, Metadata):
                writer.add_metadata(first.name, first.metadata)
            elif isinstance(first, Message):
                number = first.channel_id
                if number not in channels:
                    channels[number] = _channel(writer, reader, number, schemas)
                writer.add_message(channels[number], first.log_time, first.data,
                                   first.publish_time, first.sequence)
                copied += 1
            first = next(records, None)
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


def _channel(writer: Writer, reader: BagReader, number: int, schemas: dict[int, int]) -> int:
    channel = reader.channels[number]
    known = reader.schemas.get(channel.schema_id)
    if channel.schema_id not in schemas:
        schemas[channel.schema_id] = writer.register_schema(
            known.name, known.encoding, known.data) if known else 0
    return writer.register_channel(
        channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata)
