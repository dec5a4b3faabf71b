"""The reader of recordings on damaged files and on those of other writers."""

import json
import random
from itertools import product
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import CompressionType, IndexType, Writer

from rampart.actors.recording.bag_reader import BagReader, repair
from rampart.actors.recording.bag_writer import BagError
from rampart.cli.main import main
from tests.actors.recording.samples import foreign, sample, write


def contents(path):
    """Return the messages by topic, time and bytes, and the reader that found them."""
    reader = BagReader(path)
    return [(channel.topic, message.log_time, message.data)
            for channel, message in reader.messages()], reader


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A closed recording of eight chunks: its bytes, its messages, and the index of its chunks."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    write(path, sample(200), flush_every=25)
    found, reader = contents(path)
    assert (reader.damage, reader.gaps) == ("", [])
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    assert len(chunks) >= 8
    return path.read_bytes(), found, chunks


def spoiled(path, data, at, mask):
    changed = bytearray(data)
    changed[at] ^= mask
    path.write_bytes(changed)
    return contents(path)


@pytest.mark.parametrize("positions", [
    200, pytest.param(5000, marks=[pytest.mark.nightly, pytest.mark.timeout(1800)])])
def test_one_damaged_byte_costs_at_most_the_chunk_that_it_is_in_and_is_reported(
        tmp_path, recording, positions):
    data, everything, chunks = recording
    rng, path = random.Random(37), tmp_path / "run.mcap"
    spans = [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length, c.message_start_time,
              c.message_end_time) for c in chunks]
    heads = {start + byte for start, *_ in spans for byte in range(9)}
    tried = sorted({*range(8, len(data), max(1, len(data) // positions)), *heads})
    lossy = 0
    for at in tried:
        found, reader = spoiled(path, data, at, rng.randrange(1, 256))
        hit = next((span for span in spans if span[0] <= at < span[1]), None)
        outside = [one for one in everything if not (hit and hit[2] <= one[1] <= hit[3])]
        assert [one for one in found if not (hit and hit[2] <= one[1] <= hit[3])] == outside, at
        assert set(found) <= set(everything), at
        if len(found) < len(everything):
            lossy += 1
            [gap] = reader.gaps
            assert (gap.from_byte, gap.to_byte, gap.from_ns, gap.to_ns) == hit, at
    assert lossy > 50


def test_one_damaged_byte_of_a_recording_without_an_end_makes_no_message(tmp_path):
    path = tmp_path / "run.mcap"
    write(path, sample(200), flush_every=25, close=False).abandon()
    everything, reader = contents(path)
    data, rng = path.read_bytes(), random.Random(38)
    assert not reader.closed
    for at in range(8, len(data), max(1, len(data) // 150)):
        found, reader = spoiled(path, data, at, rng.randrange(1, 256))
        assert set(found) <= set(everything), at
        assert len(found) == len(everything) or reader.gaps, at


def test_an_index_of_messages_that_has_become_a_message_is_not_taken_for_one(tmp_path, recording):
    data, everything, chunks = recording
    after = chunks[2].chunk_start_offset + chunks[2].chunk_length
    assert data[after] == 7
    for index in (data, data[:-1]):  # the second one has no usable end
        changed = index[:after] + bytes([5]) + index[after + 1:]
        (tmp_path / "run.mcap").write_bytes(changed)
        assert contents(tmp_path / "run.mcap")[0] == everything


def test_a_damaged_attachment_is_left_out_and_reported(tmp_path, recording):
    data, everything, _ = recording
    at = data.index(b"[[node]]")
    found, reader = spoiled(tmp_path / "run.mcap", data, at, 1)
    assert found == everything
    assert [gap.what.split(" (")[0] for gap in reader.gaps] == ["attachment"]


def test_verbs_report_bytes_and_seconds_that_are_gone_and_exit_with_1(
        tmp_path, recording, capsys):
    data, everything, chunks = recording
    hit, path = chunks[2], tmp_path / "torn.mcap"
    spoiled(path, data, hit.chunk_start_offset + hit.chunk_length // 2, 0xff)
    assert main(["bag", "info", str(path), "--json"]) == 1
    [gone] = json.loads(capsys.readouterr().out)["gone"]
    assert (gone["from_byte"], gone["to_byte"]) == (
        hit.chunk_start_offset, hit.chunk_start_offset + hit.chunk_length)
    assert (gone["from_s"], gone["to_s"]) == (
        round(hit.message_start_time / 1e9, 3), round(hit.message_end_time / 1e9, 3))
    seconds = f"{gone['from_s']:.2f} to {gone['to_s']:.2f} s"
    for verb in (["info", str(path)], ["repair", str(path), str(tmp_path / "whole.mcap")]):
        assert main(["bag", *verb]) == 1
        assert seconds in capsys.readouterr().out
    found, reader = contents(tmp_path / "whole.mcap")
    assert (0 < len(found) < len(everything), reader.gaps) == (True, [])
    with (tmp_path / "whole.mcap").open("rb") as file:  # the independent reader
        assert make_reader(file, validate_crcs=True).get_summary().statistics.message_count == len(
            found)
    assert main(["bag", "info", str(tmp_path / "whole.mcap")]) == 0
    with pytest.raises(BagError, match="is the file to repair"):
        repair(reader, tmp_path / "whole.mcap", overwrite=True)


@pytest.mark.parametrize("chunked", [True, False])
def test_a_file_of_others_without_checksums_and_index_is_read_whole(tmp_path, chunked):
    path = foreign(tmp_path / "other.mcap", [("c", "json", number, b"{}") for number in range(10)],
                   use_chunking=chunked, compression=CompressionType.ZSTD, enable_crcs=False,
                   use_statistics=False)
    found, reader = contents(path)
    assert (len(found), reader.damage, reader.closed) == (10, "", True)


# -- Files of other writers: of mcap and of rosbag2 --


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
