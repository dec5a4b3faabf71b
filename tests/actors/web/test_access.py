"""Who may talk to the operator's page: rules, cookies, visitors, and what is kept of them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from itsdangerous import TimestampSigner

from rampart.actors.web import audit, visitors
from rampart.actors.web.access import Access, AccessError, check_token, page_url
from rampart.actors.web.audit import STRANGERS_S, AuditLog, read_audit
from rampart.actors.web.door import LASTS_S, Gate
from rampart.actors.web.visitors import Register, Role, Visitor, VisitorError, digest, issue
from rampart.cli.main import main
from tests.other_user import NOBODY, needs_root

HERE = Access("127.0.0.1", 8080)
EVERYWHERE = Access("0.0.0.0", 8080, asks=True, plain=True, names=("robot",))
OVER_TLS = Access("0.0.0.0", 8080, asks=True, tls=True, names=("robot", "*.robots.example"))


def test_on_loopback_only_the_page_itself_is_its_own_origin_and_host():
    for origin in (None, *(f"http://{host}:8080" for host in ("127.0.0.1", "localhost", "[::1]"))):
        assert HERE.own_origin(origin), origin
    for origin in ("http://127.0.0.1:8081", "https://127.0.0.1:8080", "null",
                   "http://127.0.0.1.evil.example:8080", "http://evil.example",
                   "http://evil@127.0.0.1:8080", "http://127.0.0.1:8080/x", "http://[::1", "",
                   "http://127.0.0.1:99999999", "http://192.168.0.7:8080", "http://robot:8080"):
        assert not HERE.own_origin(origin), origin
    for host in ("127.0.0.1:8080", "localhost", "LOCALHOST:8080", "[::1]:8080"):
        assert HERE.own_host(host), host
    for host in ("evil.example:8080", "192.168.0.7", "", None, "127.0.0.1@evil.example", "a:b:c"):
        assert not HERE.own_host(host), host


def test_elsewhere_an_address_or_the_own_name_will_do_since_they_cannot_be_rebound():
    for host, own in (
            ("192.168.0.7:8080", True), ("[fe80::1]:8080", True), ("robot:8080", True),
            ("Robot", True), ("localhost:8080", True), ("evil.example:8080", False),
            ("robot.evil.example", False)):
        assert EVERYWHERE.own_host(host) is own, host
        assert EVERYWHERE.own_origin(f"http://{host.removesuffix(':8080')}:8080") is own, host


def test_over_tls_its_origin_is_https_and_the_names_of_its_certificate_are_its_own():
    for origin, own in (
            ("https://robot:8080", True), ("https://192.168.0.7:8080", True), (None, True),
            ("https://one.robots.example:8080", True), ("http://robot:8080", False),
            ("https://one.two.robots.example:8080", False), ("https://robot", False),
            ("https://robots.example:8080", False)):
        assert OVER_TLS.own_origin(origin) is own, origin
    # Browsers leave the usual ports out.
    assert Access("0.0.0.0", 443, asks=True, tls=True, names=("robot",)).own_origin("https://robot")
    assert Access("127.0.0.1", 80).own_origin("http://127.0.0.1")
    assert not HERE.own_origin("http://127.0.0.1")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "robot", "", "localhost.evil"])
def test_nothing_but_loopback_is_served_without_a_token_or_unencrypted_unless_told_explicitly(host):
    with pytest.raises(AccessError, match="needs a token"):
        Access(host, 8080, tls=True)
    with pytest.raises(AccessError, match=r"encrypted.* --hmi-cert .* or --hmi-unencrypted"):
        Access(host, 8080, asks=True)
    Access(host, 8080, asks=True, tls=True)
    Access(host, 8080, asks=True, plain=True)
    Access("127.0.0.1", 8080, asks=True)


@pytest.mark.parametrize("token", ["x" * 15, "with a space in the middle", "ä" * 20, "y" * 201])
def test_a_token_that_is_short_or_no_word_is_refused(token):
    with pytest.raises(AccessError, match="expected 16 to 200") as error:
        check_token(token)
    assert token not in str(error.value)


def test_the_address_to_open():
    assert EVERYWHERE.url == HERE.url == "http://127.0.0.1:8080/"
    assert OVER_TLS.url == "https://127.0.0.1:8080/"
    assert page_url("fe80::1", 1) == "http://[fe80::1]:1/"
    assert page_url("robot", 8080, tls=True) == "https://robot:8080/"


def test_behind_a_proxy_its_origin_is_the_proxys_and_a_token_is_needed():
    behind = Access("127.0.0.1", 8080, True, behind="https://robot.example")
    assert behind.url == "https://robot.example/"
    assert behind.own_host("robot.example")
    assert behind.own_origin("https://robot.example")
    for foreign in ("http://robot.example", "https://robot.example:8443", "https://evil.example"):
        assert not behind.own_origin(foreign)
    assert not behind.own_host("evil.example")
    with pytest.raises(AccessError, match="needs a token"):
        Access("127.0.0.1", 8080, behind="https://robot.example")
    for wrong in ("robot.example", "https://robot.example/", "https://robot.example/ui", "ftp://a",
                  "https://"):
        with pytest.raises(AccessError, match="expected an origin"):
            Access("127.0.0.1", 8080, True, behind=wrong)


# -- Logging in by a token, and being known by a cookie --


TOKEN = "secret-of-the-hangar-7"
ANNA = Visitor("anna", Role.DRIVE, digest(TOKEN))
SECRET = "of the run"


@pytest.fixture
def clock(monkeypatch):
    """Wall time, which a test sets."""
    now = SimpleNamespace(now_s=1000.0)
    monkeypatch.setattr(TimestampSigner, "get_timestamp", lambda _signer: int(now.now_s))
    return now


def made(*, register: Register | None = None, secret: str = SECRET, tls: bool = True,
         port: int = 8080) -> Gate:
    return Gate(register or Register([ANNA]), secret, port, tls=tls)


def cookie(gate: Gate, token: str = TOKEN) -> str:
    visitor = gate.visitor(f"Bearer {token}", None)
    assert visitor is not None
    return gate.cookie(visitor).partition(";")[0]


def test_a_cookie_is_hidden_from_scripts_and_other_sites_and_over_tls_sent_over_tls_alone(clock):
    over_tls = made().cookie(ANNA)
    name, *attributes = over_tls.split("; ")
    assert name.startswith("__Host-rampart-8080=anna.")
    assert attributes == ["Path=/", f"Max-Age={LASTS_S}", "HttpOnly", "SameSite=Strict", "Secure"]
    plain = made(tls=False).cookie(ANNA)
    assert plain.startswith("rampart-8080=")
    assert plain.split("; ")[1:] == attributes[:-1]
    assert TOKEN not in over_tls + plain
    assert digest(TOKEN) not in over_tls + plain
    assert "Max-Age=0;" in made().no_cookie()


def test_a_cookie_ends_after_hours_and_is_none_from_the_future(clock):
    gate = made()
    shown = cookie(gate)
    clock.now_s += LASTS_S
    assert gate.visitor(None, shown) == ANNA
    clock.now_s += 1
    assert gate.visitor(None, shown) is None
    clock.now_s = 0.0
    assert gate.visitor(None, shown) is None


def test_whatever_is_changed_in_a_cookie_it_opens_nothing(clock):
    gate = made(register=Register([ANNA, Visitor("eve", Role.INJECT, "e" * 64)]))
    shown = cookie(gate)
    value = shown.partition("=")[2]
    name, since, mac = value.split(".")
    for changed in (f"eve.{since}.{mac}", f"{name}.{since}x.{mac}", f"{name}.{since}.{mac[:-2]}",
                    f"{name}.{mac}", f"{name}.{'9' * 400}.{mac}", f".{since}.{mac}", "", "..."):
        assert gate.visitor(None, f"__Host-rampart-8080={changed}") is None
    assert gate.visitor(None, f"rampart-8080={value}") is None


@given(st.text(max_size=80), st.text(max_size=80))
def test_no_header_whatever_is_in_it_raises_or_opens(authorization, cookies):
    gate = made()
    assert gate.visitor(authorization, cookies) is None
    assert gate.visitor(f"Bearer {authorization}", f"__Host-rampart-8080={cookies}") is None


# -- The file of who may use a page, its verbs, and what is made of a file that changes --


LISTED = f"anna drive {'a' * 64}"


def test_a_file_is_read_with_comments_and_blank_lines():
    lines = ["# who", "", f"  {LISTED}  # the first", f"b.o-b@x look {'b' * 64}"]
    assert visitors.parse(lines) == {
        "anna": Visitor("anna", Role.DRIVE, "a" * 64),
        "b.o-b@x": Visitor("b.o-b@x", Role.LOOK, "b" * 64)}


@pytest.mark.parametrize(("lines", "why"), [
    (["anna drive"], "line 1: expected NAME ROLE SHA256"),
    (["", "anna captain " + "a" * 64], "line 2: role 'captain': unknown; known: look, drive, "
                                       "inject"),
    ([LISTED, f"anna look {'b' * 64}"],
     "line 2: name 'anna': there already; expected each name once"),
    ([LISTED, f"bob look {'a' * 64}"], "line 2: 'bob': another visitor has the same token"),
    (["an|na drive " + "a" * 64], "line 1: name 'an|na': expected up to 40"),
    (["anna drive " + "A" * 64], "line 1: anna: expected the SHA-256 of a token"),
    ([f"v{i} look {i:064x}" for i in range(visitors.MOST + 1)],
     f"{visitors.MOST + 1} names; expected at most {visitors.MOST}")])
def test_what_is_no_list_of_visitors_is_one_line(lines, why):
    with pytest.raises(VisitorError) as error:
        visitors.parse(lines)
    assert str(error.value).startswith(why)
    assert "\n" not in str(error.value)


def test_a_token_is_issued_once_kept_as_a_digest_and_revoked(tmp_path):
    file = tmp_path / "page.tokens"
    anna, bob = issue(file, "anna", Role.DRIVE), issue(file, "bob", Role.LOOK)
    assert file.stat().st_mode & 0o777 == 0o600
    assert visitors.read_visitors(file) == {"anna": Visitor("anna", Role.DRIVE, digest(anna)),
                                   "bob": Visitor("bob", Role.LOOK, digest(bob))}
    with pytest.raises(VisitorError, match="anna has a token already; revoke it first"):
        issue(file, "anna", Role.LOOK)
    visitors.revoke(file, "anna")
    assert list(visitors.read_visitors(file)) == ["bob"]
    with pytest.raises(VisitorError, match="no visitor 'anna'; known: bob"):
        visitors.revoke(file, "anna")


def test_a_file_of_one_word_is_a_bare_token_and_all_else_a_list(tmp_path):
    file = tmp_path / "file"
    file.touch(0o600)
    for text, is_list in (("secret-of-the-hangar-7\n", False), (f"{LISTED}\n", True), ("", True),
                          ("# nobody yet\n", True), (f"# all\n{LISTED}\n", True)):
        file.write_text(text)
        assert visitors.lists_visitors(file) is is_list


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
    assert visitors.read_visitors(file) == {}


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


@pytest.fixture
def file(tmp_path) -> Path:
    made = tmp_path / "token"
    made.touch(0o600)
    made.write_text(f"{TOKEN}\n")
    return made


def not_taken(file: Path) -> str:
    with pytest.raises(visitors.SecretError) as error:
        visitors.read_secret(file)
    assert TOKEN not in str(error.value)
    return str(error.value)


def test_a_file_that_only_its_owner_can_read_is_taken(file, tmp_path):
    assert visitors.read_secret(file) == TOKEN
    link = tmp_path / "link"
    link.symlink_to(file)
    assert visitors.read_secret(link) == TOKEN


@pytest.mark.parametrize("mode", [0o640, 0o602, 0o601])
def test_a_file_that_others_can_get_at_is_refused(file, mode):
    file.chmod(mode)
    assert not_taken(file) == f"mode {mode:04o}: others can access it; chmod 600"


@needs_root
def test_a_file_of_somebody_else_is_refused(file):
    os.chown(file, NOBODY, NOBODY)
    assert not_taken(file) == f"belongs to user {NOBODY}; expected your file"


@pytest.mark.parametrize("content", [
    b"", b"\n \n", f"{TOKEN}\n{TOKEN}".encode(), b"x" * (visitors.SECRET_BYTES + 1),
    b"\xff\xfe" * 10, "ключ-от-ангара-семь".encode()])
def test_what_is_not_one_plain_line_is_refused(file, content):
    file.write_bytes(content)
    assert not_taken(file).startswith("expected one line")


def test_what_is_no_file_is_refused_and_a_fifo_waits_for_nobody(tmp_path):
    assert not_taken(tmp_path) == "expected an ordinary file"
    os.mkfifo(tmp_path / "fifo", 0o600)
    assert not_taken(tmp_path / "fifo") == "expected an ordinary file"
    assert not_taken(tmp_path / "nothing") == "cannot be read (No such file or directory)"
    assert not_taken(Path("a\0b")).startswith("cannot be read")


# -- The file that says who did what: whole after any death, bounded, and never in the way --


@pytest.fixture
def around():
    """Simulated and real time, and what was complained of."""
    return SimpleNamespace(now_s=12.3456, real_s=1000.0, told=[])


def log_in(around, kept) -> AuditLog:
    return AuditLog(kept, lambda: around.now_s, around.told.append, lambda: around.real_s)


@pytest.fixture
def kept(tmp_path):
    return tmp_path / "audit.jsonl"


@pytest.fixture
def log(around, kept) -> AuditLog:
    return log_in(around, kept)


def test_a_line_says_who_when_what_and_what_came_of_it(kept, log):
    log.write("reset", who="anna", address="10.0.0.7", role="drive", page=3,
              asked={"recovery": "RM1"}, why="reset of RM1 asked for")
    log.write("log in", address="10.0.0.8", refused=True, why="unknown token")
    first, second = (json.loads(line) for line in kept.read_text().splitlines())
    utc = first.pop("utc")
    assert (len(utc), utc[10], utc[-6:]) == (29, "T", "+00:00")
    assert first == {"t_s": 12.346, "who": "anna", "address": "10.0.0.7", "role": "drive",
                     "page": 3, "what": "reset", "asked": {"recovery": "RM1"},
                     "outcome": "accepted",
                     "why": "reset of RM1 asked for"}
    assert second["outcome"] == "refused"
    assert [line.outcome for line in read_audit(kept)] == ["accepted", "refused"]
    assert kept.stat().st_mode & 0o777 == 0o600


def test_of_visitors_without_a_token_one_line_a_second_is_kept_and_the_others_counted(
        kept, log, around):
    for i in range(300):
        log.write("log in", address=f"10.0.0.{i % 250}", refused=True)
        log.write("reset", who="anna")
    assert [line.who for line in read_audit(kept)] == ["", *["anna"] * 300]
    around.real_s += STRANGERS_S
    log.write("log in", address="10.0.0.1", refused=True)
    assert sum(line.left_out for line in read_audit(kept)) == 299


def test_a_full_file_says_so_in_its_last_line_and_grows_no_more(kept, log, around, monkeypatch):
    monkeypatch.setattr(audit, "MAX_BYTES", 5000)
    for i in range(300):
        log.write("reset", who="anna", asked={"n": i})
    size = kept.stat().st_size
    assert 4000 < size < 5400
    last = read_audit(kept)[-1]
    assert (last.who, last.why) == ("page", "full: later actions are not recorded")
    assert around.told == [f"{kept}: full: later actions are not recorded"]


def test_a_file_that_cannot_be_written_keeps_nobody_from_acting_and_is_told_once(tmp_path, around):
    kept = tmp_path / "gone" / "audit.jsonl"
    log = log_in(around, kept)
    for _ in range(3):
        log.write("reset", who="anna")
    assert around.told == [
        f"{kept}: cannot be written (No such file or directory): actions are not recorded"]
    kept.parent.mkdir()
    log.write("reset", who="anna")
    assert [(line.who, line.left_out) for line in read_audit(kept)] == [("anna", 3)]


def test_a_disk_that_takes_half_a_line_loses_that_line_alone(kept, log, around, monkeypatch):
    log.write("open", who="anna")
    real = os.write
    monkeypatch.setattr(audit.os, "write", lambda handle, data: real(handle, data[:20]))
    log.write("reset", who="anna")
    monkeypatch.setattr(audit.os, "write", real)
    log.write("close", who="anna")
    assert [(line.what, line.why, line.left_out) for line in read_audit(kept)] == [
        ("open", "", 0), ("audit", "damaged line", 0), ("close", "", 1)]
    assert "the disk is full" in around.told[0]


def test_a_link_in_the_place_of_the_file_is_not_followed_and_without_a_file_nothing_is_kept(
        tmp_path, around):
    (tmp_path / "elsewhere").write_text("mine")
    (tmp_path / "audit.jsonl").symlink_to(tmp_path / "elsewhere")
    log_in(around, tmp_path / "audit.jsonl").write("reset", who="anna")
    assert (tmp_path / "elsewhere").read_text() == "mine"
    assert len(around.told) == 1
    log_in(around, None).write("reset")
    assert read_audit(tmp_path / "nothing") == ()


def test_a_long_request_is_kept_without_what_it_asked(kept, around):
    log_in(around, kept).write("order", who="anna", asked={"reason": "x" * 5000}, why="y" * 5000)
    (line,) = read_audit(kept)
    assert (line.what, line.asked, len(line.why)) == ("order", {}, 500)
