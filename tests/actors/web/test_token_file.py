"""The token of the operator's page: where it may come from, and where it must not turn up."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rampart.actors.web.visitors import SECRET_BYTES, SecretError, read_secret
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


@pytest.mark.parametrize("mode", [0o640, 0o602, 0o601])
def test_a_file_that_others_can_get_at_is_refused(file, mode):
    file.chmod(mode)
    assert refused(file) == f"mode {mode:04o}: others can access it; chmod 600"


@needs_root
def test_a_file_of_somebody_else_is_refused(file):
    os.chown(file, NOBODY, NOBODY)
    assert refused(file) == f"belongs to user {NOBODY}; expected your file"


@pytest.mark.parametrize("content", [
    b"", b"\n \n", f"{TOKEN}\n{TOKEN}".encode(), b"x" * (SECRET_BYTES + 1), b"\xff\xfe" * 10,
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
