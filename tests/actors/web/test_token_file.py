"""The token of the operator's page: where it may come from, and where it must not turn up."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.actors.web.token_file import MAX_BYTES, SecretError, read_secret
from tests import ROOT
from tests.other_user import NOBODY, needs_root

TOKEN = "secret-of-the-hangar-7"


@pytest.fixture
def file(tmp_path) -> Path:
    made = tmp_path / "token"
    made.touch(0o600)
    made.write_text(f"{TOKEN}\n")
    return made


def refused(file: Path) -> str:
    with pytest.raises(SecretError) as error:
        read_secret(file)
    assert TOKEN not in str(error.value)
    return str(error.value)


def test_a_file_that_only_its_owner_can_read_is_taken(file, tmp_path):
    assert read_secret(file) == TOKEN
    link = tmp_path / "link"
    link.symlink_to(file)
    assert read_secret(link) == TOKEN


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o610, 0o601, 0o777])
def test_a_file_that_others_can_get_at_is_refused(file, mode):
    file.chmod(mode)
    assert refused(file) == f"mode {mode:04o}: others can access it; chmod 600"


@needs_root
def test_a_file_of_somebody_else_is_refused(file):
    os.chown(file, NOBODY, NOBODY)
    assert refused(file) == f"belongs to user {NOBODY}; expected your file"


@pytest.mark.parametrize("content", [
    b"", b"\n \n", f"{TOKEN}\n{TOKEN}".encode(), b"x" * (MAX_BYTES + 1), b"\xff\xfe" * 10,
    "ключ-от-ангара-семь".encode()])
def test_what_is_not_one_plain_line_is_refused(file, content):
    file.write_bytes(content)
    assert refused(file).startswith("expected one line")


def test_what_is_no_file_is_refused_and_a_fifo_waits_for_nobody(tmp_path):
    assert refused(tmp_path) == "expected an ordinary file"
    os.mkfifo(tmp_path / "fifo", 0o600)
    assert refused(tmp_path / "fifo") == "expected an ordinary file"
    assert refused(tmp_path / "nothing") == "cannot be read (No such file or directory)"
    assert refused(Path("a\0b")).startswith("cannot be read")


def launched(*arguments: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), *arguments], check=False, capture_output=True,
        text=True, timeout=60, cwd=cwd, env={**os.environ, **environment})


@pytest.mark.parametrize("arguments", [
    ["--hmi-token", TOKEN], [f"--hmi-token={TOKEN}"], ["--hmi-token"],
    ["--virtual", "--hmi-token", TOKEN], ["--no-hmi", "--hmi-token", TOKEN],
    ["--system", "paper", "--hmi-token", TOKEN]])
def test_a_token_on_the_command_line_is_refused_and_not_repeated(tmp_path, arguments):
    done = launched(*arguments, "--hmi-host", "0.0.0.0", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("launch.py: --hmi-token: every user of this machine can read")
    assert "--hmi-token-file FILE" in done.stderr
    assert "RAMPART_HMI_TOKEN" in done.stderr
    assert TOKEN not in done.stdout + done.stderr


def test_a_bad_token_names_where_it_came_from_and_not_what_it_is(tmp_path, file):
    file.write_text("a-bad token")
    done = launched("--hmi-token-file", str(file), cwd=tmp_path, RAMPART_HMI_TOKEN=TOKEN)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith(f"launch.py: --hmi-token-file {file}: token of 11 characters: ")
    done = launched(cwd=tmp_path, RAMPART_HMI_TOKEN="short-one")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith("launch.py: RAMPART_HMI_TOKEN: token of 9 characters: ")
    assert "a-bad" not in done.stderr
    assert "short-one" not in done.stderr
    file.chmod(0o644)
    done = launched("--hmi-token-file", str(file), cwd=tmp_path)
    assert (done.returncode, done.stderr.splitlines()) == (2, [
        f"launch.py: --hmi-token-file {file}: mode 0644: others can access it; chmod 600"])
