"""Recordings as tables, read back by other readers."""

import csv
import json
import sys

import pytest
from pyarrow import parquet

from rampart.cli.main import main
from tests.actors.recording.samples import foreign


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
