"""Writes what can be read of a torn MCAP file into a whole one."""

from __future__ import annotations

import contextlib
from itertools import chain
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
        for it in chain([first], records):
            if isinstance(it, Attachment):
                writer.add_attachment(
                    it.create_time, it.log_time, it.name, it.media_type, it.data)
            elif isinstance(it, Metadata):
                writer.add_metadata(it.name, it.metadata)
            elif isinstance(it, Message):
                if it.channel_id not in channels:
                    channels[it.channel_id] = _channel(writer, reader, it.channel_id, schemas)
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


def _channel(writer: Writer, reader: BagReader, number: int, schemas: dict[int, int]) -> int:
    channel = reader.channels[number]
    known = reader.schemas.get(channel.schema_id)
    if channel.schema_id not in schemas:
        schemas[channel.schema_id] = writer.register_schema(
            known.name, known.encoding, known.data) if known else 0
    return writer.register_channel(
        channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata)
