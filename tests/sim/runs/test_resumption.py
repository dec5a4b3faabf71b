"""What a run keeps so that it can be resumed: found again, or refused in one line."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from rampart.actors.runtime.run_plan import RunPlan
from rampart.sim.runs import resumption


@pytest.fixture
def system(tmp_path) -> Path:
    file = tmp_path / "system.toml"
    file.write_text("name = 'x'")
    return file


def begun(reports: Path, name: str, system: Path, **changes) -> resumption.RunFiles:
    """Keep what a run keeps when it starts, and let go of it as if it had been killed."""
    directory = reports / name
    directory.mkdir(parents=True)
    files = resumption.RunFiles(directory)
    plan = RunPlan(run_id=f"id-{name}", system_file=str(system), options={"mission": "AB"})
    kept = resumption.manifest_of(plan, ["--rate", "2"], [])
    files.save(msgspec.structs.replace(kept, **changes))
    return files


@pytest.mark.parametrize("which", ["", "reports/b", "b", "id-b"])
def test_a_run_is_found_by_directory_name_and_id_or_as_the_newest_that_did_not_end(
        tmp_path, system, monkeypatch, which):
    monkeypatch.chdir(tmp_path)
    for number, (name, ended) in enumerate((("a", ""), ("b", ""), ("c", "success, safe"))):
        files = begun(tmp_path / "reports", name, system, ended=ended)
        os.utime(files.directory / resumption.MANIFEST, (1000 + number, 1000 + number))
    files, manifest = resumption.find(Path("reports"), which)
    assert (manifest.run_id, manifest.arguments) == ("id-b", ("--rate", "2"))
    files.unlock()


def damaged(text: str):
    return lambda files: (files.directory / resumption.MANIFEST).write_text(text)


def kept(**changes):
    return lambda files: files.save(msgspec.structs.replace(files.manifest(), **changes))


@pytest.mark.parametrize(("change", "which", "why"), [
    (lambda files: (files.directory / resumption.MANIFEST).unlink(), "a", resumption.MANIFEST),
    (damaged("{"), "", resumption.MANIFEST), (damaged('{"format": 1, "run_id": 7}'), "a", "run_id"),
    (kept(format=99), "a", "99"), (kept(ended="fail, safe"), "a", "has ended (fail, safe)"),
    (kept(ended="fail, safe"), "", "no run that did not end"),
    (lambda _files: None, "b", "no such run")])
def test_a_run_that_cannot_be_resumed_is_refused_in_one_line(tmp_path, system, change, which, why):
    change(begun(tmp_path / "reports", "a", system))
    with pytest.raises(resumption.ResumptionError) as refused:
        resumption.find(tmp_path / "reports", which)
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_run_that_lives_is_not_resumed_and_one_that_is_just_ending_is_waited_for(
        tmp_path, system, monkeypatch):
    """Any process of the run keeps the lock, for it was forked with it."""
    files = begun(tmp_path / "reports", "a", system)
    assert files.lock()
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"],
                             pass_fds=[files._lock])
    files.unlock()
    monkeypatch.setattr(resumption, "_PATIENCE_S", 0.2)
    with pytest.raises(resumption.ResumptionError, match="still lives"):
        resumption.find(tmp_path / "reports", "a")
    child.kill()
    child.wait()
    assert files.lock()
    monkeypatch.setattr(time, "sleep", lambda _s: files.unlock())
    found, _ = resumption.find(tmp_path / "reports", "a")
    found.unlock()


def manifest(system: Path, **changes) -> resumption.Manifest:
    plan = RunPlan(run_id="r", system_file=str(system), options={"mission": "AB"})
    return resumption.manifest_of(msgspec.structs.replace(plan, **changes), [], [])


def test_another_system_seed_or_mission_is_named_and_another_rate_is_none_of_these(system):
    before = manifest(system)
    assert resumption.differences(before, manifest(system, rate=4.0, run_id="s")) == ""
    assert "seed is 2, expected 1" in resumption.differences(before, manifest(system, seed=2))
    assert "mission is 'A', expected 'AB'" in resumption.differences(
        before, manifest(system, options={"mission": "A"}))
    assert "ftm" in resumption.differences(before, manifest(system, ftm=False))
    system.write_text("name = 'y'")
    assert f"{system} has changed" in resumption.differences(before, manifest(system))


def test_the_newest_memory_is_recalled_unless_it_is_damaged_until_the_run_has_ended(
        tmp_path, system):
    files, recalled = resumption.RunFiles(tmp_path), list[bytes]()

    def recall(memory: bytes) -> float:
        if memory == b"\xc1":
            raise msgspec.ValidationError("Expected `object`")
        recalled.append(memory)
        return 7.0

    assert files.recall("r", recall) == (0.0, "")
    for memory in (b"first", b"second"):
        files.keep_memory("r", memory)
    assert files.recall("r", recall) == (7.0, "")
    assert recalled == [b"second"]
    (kept,) = tmp_path.glob("record-*")
    kept.write_bytes(kept.read_bytes()[:-1])
    assert "its checksum is wrong" in files.recall("r", recall)[1]
    files.keep_memory("r", b"\xc1")  # whole, but not a record of this run
    assert "Expected `object`" in files.recall("r", recall)[1]
    files.end(manifest(system))
    assert files.recall("r", recall) == (0.0, "")
    assert files.manifest() == manifest(system)


def test_a_run_that_did_not_start_leaves_the_one_before_it_as_it_was(tmp_path, system):
    files = begun(tmp_path, "a", system)
    for before in (files.manifest(), None):
        saved = files.saved()
        files.save(manifest(system))
        files.put_back(saved)
        if before is None:
            assert not (files.directory / resumption.MANIFEST).exists()
        else:
            assert files.manifest() == before
            (files.directory / resumption.MANIFEST).unlink()
