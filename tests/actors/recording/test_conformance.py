"""The reader of recordings on the files of MCAP's conformance suite, and a copy by `repair`."""

from __future__ import annotations

import hashlib
import struct

from mcap.opcode import Opcode
from mcap.records import Attachment, Message, Metadata

from rampart.actors.recording.bag_reader import BagReader, repair
from tests.actors.recording.mcap_conformance import DIGEST, variants

FILES = list(variants())


def found(path):
    """Return what the reader finds, message by message, and the reader."""
    reader = BagReader(path)
    records = list(reader.records())
    messages = [struct.pack("<HIQQ", one.channel_id, one.sequence, one.log_time, one.publish_time)
                + one.data for one in records if isinstance(one, Message)]
    return messages, [one for one in records if not isinstance(one, Message)], reader


def test_the_files_are_those_of_the_suite_to_the_byte():
    sums = sorted(f"{name} {hashlib.sha256(data).hexdigest()}\n" for name, _, data in FILES)
    assert len(sums) == 416
    assert hashlib.sha256("".join(sums).encode()).hexdigest() == DIGEST


def test_every_file_of_the_suite_is_read_whole_and_copied_by_repair(tmp_path):
    path, copy = tmp_path / "suite.mcap", tmp_path / "copy.mcap"
    for name, records, data in FILES:
        path.write_bytes(data)
        messages, others, reader = found(path)
        kinds = [kind for kind, _ in records]
        assert messages == [data for kind, data in records if kind == Opcode.MESSAGE], name
        assert (reader.closed, reader.damage, reader.gaps) == (True, "", []), name
        assert len(reader.channels) == kinds.count(Opcode.CHANNEL), name
        assert len(reader.schemas) == kinds.count(Opcode.SCHEMA), name
        assert [type(one) for one in others] == [
            *[Attachment] * kinds.count(Opcode.ATTACHMENT),
            *[Metadata] * kinds.count(Opcode.METADATA)], name
        assert repair(reader, copy, overwrite=True) == len(messages), name
        again, more, copied = found(copy)
        assert ([one[2:] for one in again], more) == ([one[2:] for one in messages], others), name
        assert copied.damage == "", name
