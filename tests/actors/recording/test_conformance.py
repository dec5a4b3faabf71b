"""The reader of recordings, and `repair`, on MCAP's conformance suite and on bags of rosbag2."""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Message, Metadata

from rampart.actors.recording.bag_reader import BagReader, repair
from rampart.actors.recording.bag_writer import BagError
from tests.actors.recording.mcap_conformance import DIGEST, variants

FILES = list(variants())
BAGS = Path(__file__).with_name("rosbag2")


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


@pytest.mark.parametrize("path", sorted(BAGS.glob("*.mcap")), ids=lambda path: path.stem)
def test_a_bag_of_rosbag2_is_read_as_the_independent_reader_reads_it(tmp_path, path):
    messages, _, reader = found(path)
    with path.open("rb") as file:
        expected = [(channel.topic, message.log_time, message.data) for _, channel, message in
                    make_reader(file).iter_messages(log_time_order=False)]
    assert [(reader.channels[one.channel_id].topic, one.log_time, one.data)
            for one in reader.records() if isinstance(one, Message)] == expected
    assert (reader.closed, reader.damage, len(messages)) == (True, "", len(expected))
    assert repair(reader, tmp_path / "copy.mcap") == len(expected)


def test_a_bag_of_rosbag2_in_sqlite_is_read_and_copied_into_mcap(tmp_path):
    path, copy = tmp_path / "talker_0.db3", tmp_path / "talker.mcap"
    with contextlib.closing(sqlite3.connect(path)) as bag, bag:
        bag.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
            "serialization_format TEXT, offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB);"
            "INSERT INTO topics VALUES(7, '/talker', 'std_msgs/msg/String', 'cdr', '');")
        bag.executemany("INSERT INTO messages VALUES(NULL, 7, ?, ?)",
                        [(20, b"b"), (10, b"a" * 9000)])
    messages, _, reader = found(path)
    assert [one[14:22] for one in messages] == [struct.pack("<Q", at) for at in (10, 20)]
    assert (reader.channels[7].topic, reader.schemas[7].name, reader.damage) == (
        "/talker", "std_msgs/msg/String", "")
    assert repair(reader, copy) == 2
    with copy.open("rb") as file:
        assert [(schema.name, channel.message_encoding, message.data) for schema, channel, message
                in make_reader(file).iter_messages()] == [
            ("std_msgs/msg/String", "cdr", data) for data in (b"a" * 9000, b"b")]
    path.write_bytes(path.read_bytes()[:4096])  # its first page, without the messages
    assert found(path)[2].gaps


def test_a_folder_or_a_file_compressed_as_a_whole_is_refused_with_the_remedy(tmp_path):
    (tmp_path / "run_0.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfd\0\0\0\0")
    for path, words in ((tmp_path, "it has run_0.mcap.zstd"),
                        (tmp_path / "run_0.mcap.zstd", "decompress it first")):
        with pytest.raises(BagError, match=words):
            BagReader(path)
