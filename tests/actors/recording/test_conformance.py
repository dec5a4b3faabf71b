"""The reader of recordings, and `repair`, on files of other writers: of `mcap` and of rosbag2."""

from itertools import product
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import CompressionType, IndexType, Writer

from rampart.actors.recording.bag_reader import BagReader, repair
from rampart.actors.recording.bag_writer import BagError

BAGS = Path(__file__).with_name("rosbag2")
OPTIONS = ("use_chunking", "repeat_channels", "repeat_schemas", "use_statistics",
           "use_summary_offsets", "enable_crcs", "enable_data_crcs")


def found(path):
    """Return the messages by topic, then the other records, and the reader of both."""
    reader = BagReader(path)
    records = list(reader.records())
    return [(reader.channels[one.channel_id].topic, one.log_time, one.publish_time, one.sequence,
             one.data) for one in records if isinstance(one, Message)], [
                 one for one in records if not isinstance(one, Message)], reader


def test_a_file_with_any_features_is_read_whole_and_copied_by_repair(tmp_path):
    path, copy = tmp_path / "run.mcap", tmp_path / "copy.mcap"
    for index, *chosen in product((IndexType.NONE, IndexType.ALL),
                                  *[(False, True)] * len(OPTIONS)):
        with path.open("wb") as file:
            writer = Writer(file, compression=CompressionType.LZ4, index_types=index,
                            chunk_size=40, **dict(zip(OPTIONS, chosen, strict=True)))
            writer.start("others", "a library")
            writer.add_attachment(1, 2, "file", "text/plain", b"attached")
            writer.add_metadata("table", {"foo": "bar"})
            schema = writer.register_schema("Example", "c", b"define")
            for topic, schema_id in (("/a", schema), ("/b", 0)):
                channel = writer.register_channel(topic, "json", schema_id, {"key": topic})
                for number in range(3):
                    writer.add_message(channel, 9 - number, b"{}", number, number)
            writer.finish()
        messages, others, reader = found(path)
        assert (reader.closed, reader.damage, reader.profile) == (True, "", "others"), chosen
        assert messages == [(topic, 9 - number, number, number, b"{}")
                            for topic in ("/a", "/b") for number in range(3)], chosen
        assert (others[0].data, others[1].metadata) == (b"attached", {"foo": "bar"}), chosen
        assert repair(reader, copy, overwrite=True) == 6, chosen
        assert found(copy)[:2] == (messages, others), chosen


@pytest.mark.parametrize("path", sorted(BAGS.glob("*.mcap")), ids=lambda path: path.stem)
def test_a_bag_of_rosbag2_is_read_as_the_independent_reader_reads_it(tmp_path, path):
    messages, _, reader = found(path)
    with path.open("rb") as file:
        assert [(topic, at_ns, data) for topic, at_ns, _, _, data in messages] == [
            (channel.topic, message.log_time, message.data) for _, channel, message in
            make_reader(file).iter_messages(log_time_order=False)]
    assert (reader.closed, reader.damage) == (True, "")
    assert repair(reader, tmp_path / "copy.mcap") == len(messages)


def test_a_folder_or_a_file_compressed_as_a_whole_is_refused_with_the_remedy(tmp_path):
    (tmp_path / "run_0.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfd\0\0\0\0")
    for path, words in ((tmp_path, "it has run_0.mcap.zstd"),
                        (tmp_path / "run_0.mcap.zstd", "decompress it first")):
        with pytest.raises(BagError, match=words):
            BagReader(path)
