"""Recordings as files: read back by the independent `mcap` library, torn, foreign and damaged."""

import csv
import inspect
import json
import math
import re
import struct
import sys

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from pyarrow import parquet

from rampart.actors.bus.envelope import Header, encode
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.views import OsmosisViews
from rampart.actors.recording import foxglove as fg
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of, repair
from rampart.actors.recording.bag_writer import BagError, BagWriter, SequenceGaps, check_target
from rampart.actors.recording.message_form import Forms, plain_schema
from rampart.actors.recording.recorder import VirtualRecording
from rampart.actors.recording.run_documents import collect, restore
from rampart.cli.main import main
from rampart.systems import SHIPPED
from tests.actors.recording.samples import PLAN, documents, foreign, pose, sample, small_disk, write
from tests.porter_actors import LOAD, Load, write_porter_system

form_of = Forms(topics.ALL).of


def played(reader):
    """What is on the bus's channels: time, key, payload."""
    zero_s = float(reader.metadata.get("rampart.run", {}).get("time_zero_s", 0))
    return [(round(message.log_time / 1e9 + zero_s, 6), key, form_of(key).payload(message.data))
            for channel, message in reader.messages() if (key := key_of(channel))]


def damage(path):
    reader = BagReader(path)
    list(reader.records())
    return reader.damage


# ---- whole ----------------------------------------------------------------------------------


def test_the_independent_reader_finds_every_message_channel_schema_and_document(tmp_path):
    path = tmp_path / "run.mcap"
    sent = sample()
    write(path, sent)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "rampart"
        summary = reader.get_summary()
        by_key = {c.topic: c for c in summary.channels.values()}
        assert by_key["localization/pose"].metadata["key"] == "rampart/localization/pose"
        assert {s.name for s in summary.schemas.values()} >= {
            "rampart.Pose", "rampart.DetectionReport", "foxglove.PoseInFrame",
            "foxglove.FrameTransforms", "foxglove.SceneUpdate", "foxglove.Log"}
        assert {s.encoding for s in summary.schemas.values()} == {"jsonschema"}
        found = [(message.log_time / 1e9, channel.topic, message.sequence)
                 for _, channel, message in reader.iter_messages(topics=["localization/pose"])]
        assert [f[2] for f in found if f[2]] == list(range(1, 21))
        told = {record.name: record.metadata for record in reader.iter_metadata()}
        assert told["rampart.run"]["airport"] == "vallombre"
        assert told["rampart.end"]["messages"] == str(len(sent))
        assert {a.name for a in reader.iter_attachments()} == {
            "system.toml", "airport/vallombre.toml"}
        shown = [json.loads(message.data) for _, _, message in
                 reader.iter_messages(topics=["localization/pose"])]
        assert shown[0]["body"] == {"x_m": 1.0, "y_m": 0.0, "yaw_rad": 0.1}
        assert any(message["body"]["yaw_rad"] is None for message in shown if "body" in message)


def test_time_is_simulated_and_begins_before_zero_where_the_run_does(tmp_path):
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = BagWriter(file, documents(), time_zero_s=-3.0)
        for number, at_s in enumerate((-2.5, 0.0, 1.25)):
            writer.take(*pose(number + 1, at_s))
        for at_s, stamp in ((-1e30, -1e12), (1e300, -1e12), (float("inf"), 1e12)):
            writer.take(at_s, topics.POSE.at(),
                        encode(Header("x", 1, 1, stamp), m.Pose(0.0, 0.0, 0.0)))
        writer.close()
    reader = BagReader(tmp_path / "run.mcap")
    times = [(message.log_time, message.publish_time) for _, message in reader.messages()]
    assert times == [(500_000_000,) * 2, (3_000_000_000,) * 2, (4_250_000_000,) * 2, (0, 0),
                     (2**64 - 1, 0), (0, 2**64 - 1)]
    assert Summary(reader).time_zero_s == -3.0


def test_files_of_a_recording_cannot_be_written_elsewhere(tmp_path):
    evil = [("airport/../out.toml", "", b"x"), ("/etc/out.toml", "", b"x"),
            ("airport/..", "", b"x"), ("airport/a/b.toml", "", b"x")]
    restore(evil, tmp_path)
    assert list(tmp_path.parent.rglob("out.toml")) == list(tmp_path.iterdir()) == []


def virtual_recording(path):
    return VirtualRecording(path, PLAN, "a run", nodes=("localization", "DM1"), lead_s=1.0,
                            overwrite=False)


def test_the_same_run_in_virtual_time_gives_the_same_file(tmp_path):
    for name in ("a", "b"):
        recording = virtual_recording(tmp_path / name)
        for one in sample():
            recording.take(*one)
        assert recording.close().startswith("recorded 24 messages")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    summary = Summary(BagReader(tmp_path / "a"))
    assert json.loads(summary.run["nodes"]) == ["localization", "DM1"]
    assert summary.time_zero_s == -1.0


# ---- views ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [
    fg.PoseInFrame, fg.FrameTransforms, fg.FrameTransform, fg.LaserScan, fg.SceneUpdate,
    fg.SceneEntity, fg.SceneEntityDeletion, fg.LinePrimitive, fg.TriangleListPrimitive,
    fg.CubePrimitive, fg.CylinderPrimitive, fg.ArrowPrimitive,
    fg.TextPrimitive, fg.Log, fg.Pose, fg.Color, fg.Quaternion, fg.Vector3])
def test_fields_are_those_of_the_viewers_own_library(kind):
    library = pytest.importorskip("foxglove.messages")
    published = re.findall(r":param (\w+):", inspect.getdoc(getattr(library, kind.__name__)) or "")
    own = list(json.loads(plain_schema(kind))["properties"])
    missing = {"models", "spheres", "metadata"} if kind is fg.SceneEntity else set()
    assert set(own) == set(published) - missing


def test_odometry_and_pose_make_a_chain_of_frames_from_map_to_base_link():
    views = OsmosisViews()
    odometry = m.Odometry(m.Pose(2.0, 1.0, 0.5), m.Twist(0.0, 0.0))
    header = Header("localization", 1, 1, 0.0)
    assert views.of(topics.ODOMETRY, "", header, odometry, 0) == []
    shown = dict(views.of(topics.POSE, "", header, m.Pose(10.0, 5.0, 2.0707963), 10**9))
    first, second = shown["view/tf"].transforms
    assert [(t.parent_frame_id, t.child_frame_id) for t in (first, second)] == [
        ("map", "odom"), ("odom", "base_link")]
    # odom is turned by 1.5707963: its x axis is the map's y axis
    assert (first.translation.x, first.translation.y) == pytest.approx((11.0, 3.0), abs=1e-6)
    assert shown["view/pose"].pose.position == fg.Vector3(10.0, 5.0, 0.0)
    assert shown["view/pose"].timestamp == fg.Time(1, 0)


def test_what_is_no_number_is_not_shown():
    header = Header("x", 1, 1, 0.0)
    assert OsmosisViews().of(topics.POSE, "", header, m.Pose(math.nan, 0.0, 0.0), 0) == []
    sweep = m.LaserScan(-1.0, 0.5, 30.0, struct.pack("<5f", 1.0, 30.0, 2.5, math.inf, math.nan))
    [(channel, scan)] = OsmosisViews().of(topics.SCAN, "", header, sweep, 0)
    assert channel == "view/scan"
    assert (scan.start_angle, scan.end_angle, scan.ranges) == (-1.0, 1.0, [1.0, 0.0, 2.5, 0.0, 0.0])


def test_the_scene_shows_map_lights_by_verdict_and_obstacles_while_they_are_there():
    views = OsmosisViews(Osmosis.on_map(load_airport("vallombre")))
    shown = dict(views.start(0))
    assert set(shown) == {"view/robot", "view/map", "view/lights"}
    assert [e.id for e in shown["view/map"].entities] == [
        "ground", "prohibited", "graph", "buildings"]
    header = Header("osmosis_control", 1, 1, 0.0)
    dim = m.LightMeasurement("A03", 20.0, 0.4, m.LightVerdict.DIM)
    [(channel, update)] = views.of(topics.LIGHT_MEASURED, "k", header, dim, 0)
    assert channel == "view/lights"
    assert "A03 dim 40%" in {text.text for text in update.entities[0].texts}
    assert views.of(topics.LIGHT_MEASURED, "k", header, dim, 1) == []
    crate = m.ObstacleCommand("crate", True, 1.0, 2.0, 0.4)
    for present, count in (((crate,), 1), ((), 0)):
        [(_, update)] = views.of(topics.OBSTACLES, "k", header, m.ObstacleList(present), 0)
        assert len(update.entities[0].cylinders) == count


@pytest.mark.parametrize(("text", "size"), [
    (b"\xff", (0.72, 0.614)),
    ((SHIPPED / "paper.toml").read_bytes().replace(b"length_m = 0.72", b"length_m = 0.8"),
     (0.8, 0.614))])
def test_the_robot_is_as_large_as_the_system_says(tmp_path, text, size):
    (tmp_path / "system.toml").write_bytes(text)
    system = collect({"system_file": str(tmp_path / "system.toml")}, run_id="", title="", rate=1.0,
                     nodes=(), started="").known.system
    shown = dict(OsmosisViews(None, system).start(0))["view/robot"].entities[0].cubes[0].size
    assert (shown.x, shown.y) == size


def test_the_log_tells_decisions_detections_and_processes_once_each():
    views, header = OsmosisViews(), Header("ftm_manager", 1, 4, 0.0)
    decision = fm.DecisionRecord(3, "safety-first", ("FTM1",), 1, ("RM1",), (), (), 0.0)
    reports = [fm.DetectionReport(state, "fence", (), 0.0) for state in (
        fm.DetectionState.IDLE, *[fm.DetectionState.ACTIVE] * 2, fm.DetectionState.IDLE)]
    died = fm.ProcessEvent("hmi", "crashed", 1, 1, "", "killed by SIGKILL")
    told = [line for topic, body in (
        *[(ftm_topics.DECISION, decision)] * 2, *((ftm_topics.DETECTION, one) for one in reports),
        (ftm_topics.PROCESS_EVENT, died))
        for _, line in views.of(topic, topic.key, header, body, 0)]
    assert [line.message for line in told] == [
        "decision 3: RM1: FTM1, because it is the only active mechanism (block 1).",
        "ftm_manager: fence", "ftm_manager: clear",
        "hmi crashed, incarnation 1: killed by SIGKILL"]
    assert told[-1].level == fg.LogLevel.WARNING


# ---- gaps -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("from_start", "heard", "lost"), [
    (True, [("a", 1, 1), ("a", 1, 2), ("a", 1, 2), ("a", 1, 3)], {}),
    (True, [("a", 1, 3)], {"a": 2}),
    (False, [("a", 4, 300), ("a", 4, 301)], {}),  # joined in mid-run
    (False, [("a", 4, 300), ("a", 4, 305)], {"a": 4}),
    (False, [("a", 4, 300), ("a", 5, 2)], {"a": 1}),  # a life that began while it recorded
    (True, [("a", 1, 1), ("b", 1, 1), ("a", 2, 1), ("a", 1, 2)], {}),  # last words of a dead node
    # what another one has overtaken on its way is not lost
    *((True, [("a", 1, number) for number in numbers], lost) for numbers, lost in (
        ([1, 2, 4, 3], {}), ([1, 5, 2, 4], {"a": 1}), ([1, 5, 2, 2, 2], {"a": 2}),
        ([3, 3, 1], {"a": 1}), ([1, 900_000, 899_999], {"a": 899_997}))),
])
def test_what_is_missing_shows_in_the_numbers(from_start, heard, lost):
    gaps = SequenceGaps(from_start=from_start)
    for source, incarnation, sequence in heard:
        gaps.add(Header(source, incarnation, sequence, 0.0))
    assert gaps.lost() == lost


# ---- torn, damaged, foreign -----------------------------------------------------------------


def test_a_topic_that_only_the_robot_s_actors_declare_has_schema_and_description(
        tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "beside_it.py").write_text("from tests.porter_actors import Display, Platform\n")
    system = write_porter_system(tmp_path)
    system.write_text(system.read_text().replace('"tests.porter_actors:', '"beside_it:'))
    told = collect({"system_file": str(system)}, run_id="", title="", rate=1.0,
                   nodes=("platform",), started="")
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = BagWriter(file, told)
        writer.take(0.1, LOAD.at(), encode(Header("platform", 1, 1, 0.1), Load(20.0)))
        writer.close()
    with (tmp_path / "run.mcap").open("rb") as file:
        [(schema, channel, message)] = make_reader(file).iter_messages()
    body = json.loads(schema.data)["properties"]["body"]
    assert body["description"] == "What it carries."
    assert body["properties"]["mass_kg"] == {"type": "number", "unit": "kg"}
    assert (channel.metadata["about"], channel.metadata["frame"]) == (LOAD.doc, LOAD.frame)
    assert json.loads(message.data)["body"] == {"mass_kg": 20.0}


def test_a_file_cut_off_anywhere_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "run.mcap"
    sent = sample()
    write(path, sent)
    whole = path.read_bytes()
    everything = played(BagReader(path))
    assert everything == [(round(at_s, 6), key, payload) for at_s, key, payload in sent]
    counts = []
    path.write_bytes(whole[:-8] + b"overgone")
    assert (played(BagReader(path)), damage(path)) == (everything, "the last bytes")
    ends = [len(whole) - cut for cut in (8, 4, 1)]  # of the bytes that end every file
    for length in [*range(8, len(whole), max(1, len(whole) // 150)), *ends]:
        path.write_bytes(whole[:length])
        reader = BagReader(path)
        found = played(reader)
        assert found == everything[:len(found)], length
        assert reader.damage, length
        counts.append(len(found))
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, len(everything))


def test_a_repair_that_fails_leaves_nothing_behind_and_names_the_file_that_failed(tmp_path):
    path, whole = tmp_path / "torn.mcap", tmp_path / "whole.mcap"
    write(path, sample(4000), flush_every=500)
    with small_disk(20_000), pytest.raises(BagError, match=f"^{whole}: File too large"):
        repair(BagReader(path), whole)
    assert not whole.exists()


def of_ros_2(path, **settings):
    return foreign(path, [("/chatter", "cdr", 10**18 + number * 10**9, b"....")
                          for number in range(5)], "ros2",
                   compression=CompressionType.ZSTD, **settings)


def test_mcap_files_of_others_can_be_looked_at_and_not_replayed(tmp_path, capsys):
    path = of_ros_2(tmp_path / "other.mcap")
    assert main(["bag", "info", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["recording"], told["messages"], told["duration_s"], told["profile"]) == (
        False, 5, 4.0, "ros2")
    assert main(["bag", "info", str(path)]) == 0
    assert "not a recording of a run, profile 'ros2'" in capsys.readouterr().out
    assert main(["replay", str(path)]) == 2
    assert "expected a recording of a run" in capsys.readouterr().err


def test_a_file_compressed_in_a_way_that_nobody_here_knows_is_refused(tmp_path, capsys):
    path = of_ros_2(tmp_path / "other.mcap", enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b"zstd", b"zpaq"))
    assert main(["bag", "info", str(path)]) == 2
    assert "compressed by 'zpaq'; expected lz4, zstd or none" in capsys.readouterr().err


@pytest.mark.parametrize(("content", "words"), [
    (None, "No such file"), (b"", "is empty"), (b"just a text file, and no more", "not an MCAP"),
    (b"\x89MC", "not an MCAP")])
@pytest.mark.parametrize("verb", [["bag", "info"], ["replay"]])
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, refused, verb, content, words):
    path = tmp_path / "it.mcap"
    if content is not None:
        path.write_bytes(content)
    error = refused(*verb, path)
    assert words in error
    assert str(path) in error


def test_bag_info_tells_run_channels_and_closing(recording, capsys):
    assert main(["bag", "info", str(recording), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["recording"] is told["closed"] is True
    assert (told["damage"], told["lost"], told["run"]["title"]) == ("", {}, "a sample")
    row = next(r for r in told["channels"] if r["channel"] == "localization/pose")
    assert (row["schema"], row["messages"], row["bus"]) == ("rampart.Pose", 21, True)
    assert row["rate_hz"] == pytest.approx(21 / told["duration_s"], rel=0.01)
    assert main(["bag", "info", str(recording)]) == 0
    assert "closed     properly" in capsys.readouterr().out


# ---- places -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("place", "words"), [
    ("no/such/place/run.mcap", "no such directory"), ("", "Is a directory"),
    ("/proc/run.mcap", "/proc/run.mcap: cannot be written"),
    ("file.txt/run.mcap", "Not a directory")])
def test_a_place_that_cannot_be_written_is_refused_before_anything_starts(tmp_path, place, words):
    (tmp_path / "file.txt").touch()
    with pytest.raises(BagError, match=words):
        check_target(tmp_path / place, overwrite=place == "")
    path = tmp_path / "file.txt"
    path.write_text("precious")
    with pytest.raises(BagError, match="exists already"):
        check_target(path, overwrite=False)
    check_target(path, overwrite=True)  # a probe changes nothing, and leaves nothing behind
    check_target(tmp_path / "new.mcap", overwrite=False)
    assert (path.read_text(), list(tmp_path.iterdir())) == ("precious", [path])


def test_a_disk_that_fills_up_ends_the_recording_and_not_the_run(tmp_path):
    recording = virtual_recording(tmp_path / "run.mcap")
    with small_disk(200_000):
        for number in range(8000):
            recording.take(*pose(number + 1, number * 0.1))
        told = recording.close()
    assert re.search(r"File too large: the recording ends after \d+ messages", told)
    assert len(played(BagReader(tmp_path / "run.mcap"))) > 100


# -- As tables, read back by other readers --


def table(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def of_others(path, *values):
    """An MCAP file of another tool with a JSON channel, and one that is not JSON."""
    return foreign(path, [("a-b", "cdr", 0, b"\0"), *(
        ("/a/b", "json", number * 10**9, json.dumps(value).encode())
        for number, value in enumerate(values))])


def test_each_topic_is_a_table_with_one_row_per_message(recording, capsys):
    assert main(["bag", "export", str(recording), "--json"]) == 0
    folder = recording.with_suffix("")
    told = json.loads(capsys.readouterr().out)
    assert told["folder"] == str(folder)
    assert told["messages"] == {"localization/pose": 21, "detection/DM1": 2, "no/such/topic": 1}
    assert sorted(path.name for path in folder.iterdir()) == [
        "detection-DM1.csv", "localization-pose.csv", "no-such-topic.csv"]
    rows = table(folder / "localization-pose.csv")
    assert [float(row["time_s"]) for row in rows] == sorted(float(row["time_s"]) for row in rows)
    assert (rows[2]["time_s"], rows[2]["source"], rows[2]["body.x_m"]) == (
        "0.1", "localization", "3.0")
    assert rows[3]["body.yaw_rad"] == "", "NaN"
    assert [row["error"] != "" for row in rows].count(True) == 1, "the message that is garbage"


def test_parquet_has_the_rows_of_csv_as_numbers(recording, tmp_path):
    for kind in ("csv", "parquet"):
        assert main(["bag", "export", str(recording), str(tmp_path / kind), "--to", kind]) == 0
    for path in (tmp_path / "csv").iterdir():
        rows = parquet.read_table(tmp_path / "parquet" / f"{path.stem}.parquet").to_pylist()
        assert [float(row["time_s"]) for row in table(path)] == [row["time_s"] for row in rows]
    assert not list((tmp_path / "parquet").glob("*.csv"))
    poses = parquet.read_table(tmp_path / "parquet" / "localization-pose.parquet").to_pylist()
    assert poses[2]["body.x_m"] == pytest.approx(3.0)


def test_what_cannot_be_in_a_table_is_left_out_and_named(tmp_path, capsys):
    path = of_others(tmp_path / "other.mcap", {"x": 1, "list": [1, 2]}, {"x": "text"}, 7)
    assert main(["bag", "export", str(path), str(tmp_path / "csv")]) == 0
    assert [list(row.values()) for row in table(tmp_path / "csv" / "a-b.csv")] == [
        ["0.0", "1", "[1,2]", ""], ["1.0", "text", "", ""], ["2.0", "", "", "7"]]
    assert "left out: a-b: encoding 'cdr', not JSON (1 times)" in capsys.readouterr().out
    path = of_others(tmp_path / "other.mcap")
    assert main(["bag", "export", str(path), str(tmp_path / "out")]) == 1
    assert "no message that could be written" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_two_topics_with_the_same_file_name_are_two_files(tmp_path):
    path = foreign(tmp_path / "other.mcap", [
        (topic, "json", 0, b"{}") for topic in ("/a/b", "a-b", "/../../a/b")])
    assert main(["bag", "export", str(path), str(tmp_path / "out")]) == 0
    assert len(list((tmp_path / "out").iterdir())) == 3


def test_topics_are_chosen_and_a_damaged_recording_is_exported_as_far_as_it_goes(
        recording, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert main(["bag", "export", str(recording), out, "--topics", "detection/*"]) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["detection-DM1.csv"]
    whole = recording.read_bytes()
    recording.write_bytes(whole[:len(whole) * 2 // 3])
    assert main(["bag", "export", str(recording), str(tmp_path / "torn")]) == 1
    assert "gone: bytes " in capsys.readouterr().out


@pytest.mark.parametrize(("words", "told"), [
    (["there"], "there: exists already"), (["no/such/place"], "No such file or directory"),
    (["new", "--topics", "nothing"], "--topics nothing: matches no topic"),
    (["new", "--to", "parquet"], "pip install 'rampart-robot[export]'")])
def test_an_export_that_cannot_be_is_refused_in_one_line(
        recording, monkeypatch, refused, words, told):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    monkeypatch.chdir(recording.parent)
    (recording.parent / "there").mkdir()
    assert told in refused("bag", "export", recording, *words)
    assert not (recording.parent / "new").exists()
