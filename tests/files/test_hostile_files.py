"""Files that were made to do harm: each is refused in one line, before the work is done.

A file that a regression lets through takes minutes or all memory; the suite's time limit and the
kernel speak up then. No time is asserted here.
"""

from __future__ import annotations

import io
import json
import sqlite3
import struct
import zlib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from PIL import Image

from rampart.actors.osmosis.airport.formats import MAX_WARNINGS, load_airport
from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.cli.main import main as rampart
from rampart.files import toml
from rampart.files.reading import FileError
from rampart.sim.campaign.job import Job
from rampart.sim.campaign.store import Store
from tests import ROOT
from tests.actors.osmosis.airport.test_formats import GRAPH, TOML

SPEC = (ROOT / "systems" / "paper.toml").read_text("utf-8")


def edited(old: str, new: str) -> str:
    assert old in TOML
    return TOML.replace(old, new, 1)


NESTED = "x = " + "[" * 100_000 + "]" * 100_000
AIRPORTS = {
    "nested 100,000 deep": (TOML + NESTED, "nested too deep"),
    "longer than any airport": (TOML + "#" * (5 << 20), "longer than 4 MB"),
    "a coordinate beyond the earth": (edited("T = [30.0", "T = [3e7"), "nodes.T[0]: 30000000.0"),
    "a million lights": (edited("count = 3", "count = 1000000"),
                         "1000000 lights: expected at most 100000"),
    "a name that steers the terminal": (edited(
        'name = "R"', 'name = "\\u001b[2J\\nlaunch.py: all is well"'
        ).split("[world")[0].replace("10.0, 0.0", "10.0, 9.0"), "off the pavement"),
}


SPECS = {
    "nested": ("x = " + "[" * 100_000, "nested too deep"),
    "long": (SPEC + "#" * (1 << 20), "longer than 512 kB"),
    "many events": (SPEC + "".join(f'[[event]]\nname = "X{i}"\n' for i in range(6000)),
                    "expected a list, at most 5000 long"),
    "ways that no number holds": (
        SPEC.replace('recover = "RM2"',
                     f'recover = "{" and ".join(["(RM1 or RM2)"] * 20_000)}"', 1),
        "names, words and parentheses"),
}


@pytest.mark.parametrize(("text", "words"), SPECS.values(), ids=SPECS)
def test_a_system_made_to_do_harm_is_refused_in_one_line(tmp_path, refused, text, words):
    assert text != SPEC
    path = tmp_path / "system.toml"
    path.write_text(text)
    assert words in refused("run", "--virtual", "--system", path)
    assert words in refused("table", "--system", path)


def test_a_device_without_end_is_read_no_further_than_a_spec_is_long(refused):
    assert "longer than 512 kB" in refused("verify", "--system", "/dev/zero")


def test_a_table_to_be_replaced_is_read_within_the_same_bounds(tmp_path, refused):
    path = tmp_path / "table.toml"
    path.write_text(NESTED)
    assert "nested too deep" in refused("adapt", "replace", "FTM7", path)


# -- graphs and masks ------------------------------------------------------------------------------


def png(red: np.ndarray) -> bytes:
    """Return an image that is red where an array is true, and green elsewhere."""
    out = io.BytesIO()
    Image.fromarray(np.where(red[..., None], (255, 0, 0), (0, 255, 0)).astype(np.uint8)
                    ).save(out, "PNG")
    return out.getvalue()


def png_of(columns: int, rows: int) -> bytes:
    """Return an image whose head says another size than it has."""
    head = b"IHDR" + struct.pack(">II", columns, rows) + GOOD[24:29]
    return GOOD[:12] + head + struct.pack(">I", zlib.crc32(head)) + GOOD[33:]


GOOD = png(np.pad(np.zeros((40, 100), bool), ((40, 40), (10, 10)), constant_values=True))
NOISE = png(np.random.default_rng(1).random((1000, 1000)) < 0.5)


def foreign(folder: Path, image: bytes | None = None, graph: str = json.dumps(GRAPH),
            mission: str = "x=9.5,y=6,taxi=1\n") -> str:
    (folder / "field_area.png").write_bytes(image or GOOD)
    (folder / "field.graph").write_text(graph)
    (folder / "MISSION_A.miss").write_text(mission)
    return str(folder / "field.graph")


FOREIGN = {
    "50,000 x 50,000 pixels": ({"image": png_of(50_000, 50_000)}, "at most 16777216"),
    "no rows": ({"image": png_of(100, 0)}, "unreadable"),
    "noise": ({"image": NOISE}, "more than 100000 runs"),
    "a graph nested without end": ({"graph": '{"nodes":' + "[" * 100_000}, "expected a graph"),
    "a node far away": ({"graph": '{"nodes":[{"id":"N","x":1e9,"y":0}],"edges":[]}'},
                        "<= 1000000.0 - at `$.nodes[0].x`"),
    "a graph of a megabyte and more": ({"graph": " " * (2 << 20)}, "longer than 1 MB"),
    "a line of a megabyte": ({"mission": "x=" + "1" * 1_000_000}, "expected x=20"),
}


@pytest.mark.parametrize(("made", "words"), [*AIRPORTS.values(), *FOREIGN.values()],
                         ids=[*AIRPORTS, *FOREIGN])
def test_an_airport_made_to_do_harm_is_refused_in_one_line(tmp_path, refused, made, words):
    path, mission = tmp_path / "field.toml", ()
    if isinstance(made, str):
        path.write_text(made)
    else:
        path, mission = foreign(tmp_path, **made), ("--mission", "A")
    assert words in refused("run", "--virtual", "--airport", path, *mission)


def test_many_warnings_about_a_foreign_airport_are_cut_short(tmp_path):
    nodes = [{"id": f"N{i}", "x": -70 + i / 10, "y": 0} for i in range(300)]
    path = foreign(tmp_path, graph=json.dumps({"nodes": nodes, "edges": [
        [f"N{i}", f"N{i + 1}"] for i in range(299)]}), mission="x=-65,y=0,taxi=1")
    warnings = load_airport(path).warnings
    assert len(warnings) == MAX_WARNINGS + 2
    assert "more warnings" in warnings[MAX_WARNINGS]


# -- recordings ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_is_too_large_unpacked_is_refused(tmp_path, refused, kind):
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=kind, chunk_size=1 << 10)
        writer.start("", "others")
        writer.add_message(writer.register_channel("zeros", "json", 0), 0, bytes(80 << 20), 0)
        writer.finish()
    assert path.stat().st_size < 500_000
    for verb in (("bag", "info", path), ("bag", "repair", path, tmp_path / "out")):
        assert "bytes uncompressed; at most 67108864" in refused(*verb)
    assert not (tmp_path / "out").exists()


def test_an_attachment_beyond_what_is_held_is_stepped_over_and_the_rest_is_read(tmp_path):
    path = tmp_path / "large.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("", "others")
        writer.add_attachment(0, 0, "film", "video/mp4", bytes(70 << 20))
        writer.add_message(writer.register_channel("c", "json", 0), 1, b"{}", 1)
        writer.finish()
    summary = Summary(BagReader(path))
    assert (summary.messages, summary.files) == (1, [])
    assert "a record of 7" in summary.reader.damage


def test_words_of_a_recording_steer_no_terminal(tmp_path, capsys):
    path = tmp_path / "escape.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("\x1b]0;x\x07", "\x1b[2J\nrampart: all is well")
        writer.add_metadata("rampart.run", {"title": "\x1b[31m", "time_zero_s": "nan",
                                            "nodes": "[" * 5000})
        writer.add_metadata("rampart.end", {"lost": "[" * 5000})
        writer.add_message(writer.register_channel("\x1b[5m", "json", 0, {"key": "k"}), 1, b"{}", 1)
        writer.finish()
    assert rampart(["bag", "info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "\nrampart: all is well" not in out
    assert "lost       unknown" in out
    assert Summary(BagReader(path)).time_zero_s == 0.0


# -- the rest --------------------------------------------------------------------------------------


def test_an_open_psa_file_is_bounded_in_bytes_and_may_be_nested_deeply(tmp_path, refused):
    tree = '<opsa-mef><define-fault-tree name="t">{}</define-fault-tree></opsa-mef>'
    deep = '<define-gate name="g">' + "<not>" * 20_000 + "<event/>" + "</not>" * 20_000
    for text, words in (
            ("<a>" * 100_000, "not well-formed XML"), (" " * (17 << 20), "longer than 16 MB"),
            (tree.format(deep + "</define-gate>"), "there is no event ''")):
        path = tmp_path / "tree.xml"
        path.write_text(text)
        assert words in refused("cut-sets", path)


@pytest.mark.parametrize("damage", [
    "update runs set job = x'c1'", "drop table runs"])
def test_a_damaged_store_of_results_is_refused_in_one_line(tmp_path, refused, damage):
    store = Store(tmp_path)
    job = msgspec.msgpack.encode(Job(row="r"))
    store.close()
    with sqlite3.connect(tmp_path / "runs.sqlite") as database:
        database.execute("insert into runs (key, job, result) values ('abc', ?, ?)", (job, b""))
        database.execute(damage)
    database.close()
    refused("campaign", "--replay", "abc", "--out", tmp_path)


def test_a_document_of_a_recording_is_bounded_like_a_file():
    with pytest.raises(FileError, match="longer than 512 kB"):
        toml.parse("#" * (1 << 20))
