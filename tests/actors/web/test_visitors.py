"""Who may use a page: their file, its verbs, and what is made of a file that changes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from rampart.actors.web.visitors import (
    MOST,
    SECRET_BYTES,
    Register,
    Role,
    SecretError,
    Visitor,
    VisitorError,
    digest,
    issue,
    lists_visitors,
    parse,
    read_secret,
    read_visitors,
    revoke,
)
from rampart.cli.main import main
from tests.other_user import NOBODY, needs_root

ANNA = f"anna drive {'a' * 64}"


def test_a_file_is_read_with_comments_and_blank_lines():
    assert parse(["# who", "", f"  {ANNA}  # the first", f"b.o-b@x look {'b' * 64}"]) == {
        "anna": Visitor("anna", Role.DRIVE, "a" * 64),
        "b.o-b@x": Visitor("b.o-b@x", Role.LOOK, "b" * 64)}


@pytest.mark.parametrize(("lines", "why"), [
    (["anna drive"], "line 1: expected NAME ROLE SHA256"),
    (["", "anna captain " + "a" * 64], "line 2: role 'captain': unknown; known: look, drive, "
                                       "inject"),
    ([ANNA, f"anna look {'b' * 64}"],
     "line 2: name 'anna': there already; expected each name once"),
    ([ANNA, f"bob look {'a' * 64}"], "line 2: 'bob': another visitor has the same token"),
    (["an|na drive " + "a" * 64], "line 1: name 'an|na': expected up to 40"),
    (["anna drive " + "A" * 64], "line 1: anna: expected the SHA-256 of a token"),
    ([f"v{i} look {i:064x}" for i in range(MOST + 1)],
     f"{MOST + 1} names; expected at most {MOST}")])
def test_what_is_no_list_of_visitors_is_one_line(lines, why):
    with pytest.raises(VisitorError) as error:
        parse(lines)
    assert str(error.value).startswith(why)
    assert "\n" not in str(error.value)


def test_a_token_is_issued_once_kept_as_a_digest_and_revoked(tmp_path):
    file = tmp_path / "page.tokens"
    anna, bob = issue(file, "anna", Role.DRIVE), issue(file, "bob", Role.LOOK)
    assert file.stat().st_mode & 0o777 == 0o600
    assert read_visitors(file) == {"anna": Visitor("anna", Role.DRIVE, digest(anna)),
                                   "bob": Visitor("bob", Role.LOOK, digest(bob))}
    with pytest.raises(VisitorError, match="anna has a token already; revoke it first"):
        issue(file, "anna", Role.LOOK)
    revoke(file, "anna")
    assert list(read_visitors(file)) == ["bob"]
    with pytest.raises(VisitorError, match="no visitor 'anna'; known: bob"):
        revoke(file, "anna")


def test_a_file_of_one_word_is_a_bare_token_and_all_else_a_list(tmp_path):
    file = tmp_path / "file"
    file.touch(0o600)
    for text, is_list in (("secret-of-the-hangar-7\n", False), (f"{ANNA}\n", True), ("", True),
                          ("# nobody yet\n", True), (f"# all\n{ANNA}\n", True)):
        file.write_text(text)
        assert lists_visitors(file) is is_list


def test_a_file_that_changes_is_read_anew_and_one_that_breaks_lets_nobody_in(tmp_path):
    file = tmp_path / "page.tokens"
    told: list[str] = []
    anna = issue(file, "anna", Role.DRIVE)
    register = Register((), file, told.append)
    visitor = register.by_token(anna)
    assert visitor == Visitor("anna", Role.DRIVE, digest(anna))
    assert register.still(visitor)
    for wrong in ("", anna[:-1], anna + "a", "ä", "\ud800", digest(anna)):
        assert register.by_token(wrong) is None

    file.write_text(file.read_text().replace("anna drive", "anna look"))
    assert not register.still(visitor)
    assert register.by_token(anna).role is Role.LOOK

    file.write_text("what is")
    assert register.by_token(anna) is None
    assert register.visitors() == {}
    assert told == [f"{file}: line 1: expected NAME ROLE SHA256, as `rampart tokens issue` writes "
                    "it; it admits no visitors"]
    file.unlink()
    assert register.visitors() == {}
    bob = issue(file, "bob", Role.INJECT)
    assert register.by_token(bob).name == "bob"
    file.chmod(0o644)
    assert register.by_token(bob) is None
    assert told[1:] == [
        f"{file}: cannot be read (No such file or directory); it admits no visitors",
        f"{file}: mode 0644: others can access it; chmod 600; it admits no visitors"]


# ---- the verbs ----------------------------------------------------------------------------------


def test_the_verbs_issue_show_and_revoke(tmp_path, capsys):
    def tokens(*arguments: str) -> str:
        assert main(["tokens", *arguments, "--file", str(file)]) == 0
        return capsys.readouterr().out

    file = tmp_path / "page.tokens"
    token = tokens("issue", "anna", "--role", "drive").strip()
    assert Register((), file).by_token(token) == Visitor("anna", Role.DRIVE, digest(token))
    assert json.loads(tokens("show", "--json")) == [{"name": "anna", "role": "drive"}]
    assert tokens("show").split() == ["name", "role", "anna", "drive"]
    assert tokens("revoke", "anna") == "revoked the token of anna\n"
    assert read_visitors(file) == {}


@pytest.mark.parametrize(("arguments", "words"), [
    (["issue", "bob", "--role", "captain"], "--role: role 'captain': unknown; known: look, "
                                            "drive, inject"),
    (["issue", "b b", "--role", "look"], "page.tokens: name 'b b': expected up to 40"),
    (["revoke", "bob"], "page.tokens: no visitor 'bob'; known: anna"),
    (["show", "--file", "nowhere"], "nowhere: cannot be read (No such file or directory)"),
    (["issue", "bob", "--role", "look", "--file", "no/where"], "no/where: No such file"),
    (["show", "--file", "open"], "open: mode 0644: others can access it; chmod 600")])
def test_what_a_verb_cannot_do_is_one_line_and_code_2(
        tmp_path, monkeypatch, refused, arguments, words):
    monkeypatch.chdir(tmp_path)
    issue(tmp_path / "page.tokens", "anna", Role.DRIVE)
    (tmp_path / "open").write_text("")
    (tmp_path / "open").chmod(0o644)
    assert refused("tokens", *arguments).startswith(f"rampart: {words}")


# -- The token of the operator's page: where it may come from, and where it must not turn up --


TOKEN = "secret-of-the-hangar-7"


@pytest.fixture
def file(tmp_path) -> Path:
    made = tmp_path / "token"
    made.touch(0o600)
    made.write_text(f"{TOKEN}\n")
    return made


def not_taken(file: Path) -> str:
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
    assert not_taken(file) == f"mode {mode:04o}: others can access it; chmod 600"


@needs_root
def test_a_file_of_somebody_else_is_refused(file):
    os.chown(file, NOBODY, NOBODY)
    assert not_taken(file) == f"belongs to user {NOBODY}; expected your file"


@pytest.mark.parametrize("content", [
    b"", b"\n \n", f"{TOKEN}\n{TOKEN}".encode(), b"x" * (SECRET_BYTES + 1), b"\xff\xfe" * 10,
    "ключ-от-ангара-семь".encode()])
def test_what_is_not_one_plain_line_is_refused(file, content):
    file.write_bytes(content)
    assert not_taken(file).startswith("expected one line")


def test_what_is_no_file_is_refused_and_a_fifo_waits_for_nobody(tmp_path):
    assert not_taken(tmp_path) == "expected an ordinary file"
    os.mkfifo(tmp_path / "fifo", 0o600)
    assert not_taken(tmp_path / "fifo") == "expected an ordinary file"
    assert not_taken(tmp_path / "nothing") == "cannot be read (No such file or directory)"
    assert not_taken(Path("a\0b")).startswith("cannot be read")
