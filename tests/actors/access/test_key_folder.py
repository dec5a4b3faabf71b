"""A folder of keys: what is made, who may read it, and what is left when its maker is killed."""

import contextlib
import datetime as dt
import os
import stat
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import dsa, ec, ed25519, rsa

from rampart.actors.access import certificates, key_folder
from rampart.actors.access.certificates import check_address, read_certificate
from rampart.actors.access.key_folder import check, entries, init, issue, revoke, rotate
from rampart.actors.access.register import KeysError, read_register

NOW = dt.datetime.now(dt.UTC)


@pytest.fixture
def keys(tmp_path):
    folder = tmp_path / "keys"
    init(folder)
    return folder


def mode(file):
    return stat.S_IMODE(file.stat().st_mode)


def certificate(keys, name):
    return read_certificate((keys / f"{name}.pem").read_bytes(), (keys / "ca.crt").read_bytes())


def test_private_keys_are_their_users_alone(keys):
    before = os.umask(0)
    try:
        issue(keys, ["DM4"], "node")
    finally:
        os.umask(before)
    assert mode(keys) == 0o700
    assert mode(keys / "authority.key") == mode(keys / "DM4.pem") == 0o600
    assert b"PRIVATE" not in (keys / "ca.crt").read_bytes() + (keys / "register.json").read_bytes()


@pytest.mark.parametrize(("made", "is_taken"), [
    (partial(rsa.generate_private_key, 65537, 1536), False),
    (partial(rsa.generate_private_key, 65537, 2048), True),
    (partial(ec.generate_private_key, ec.SECP521R1()), False),
    (partial(ec.generate_private_key, ec.SECP256K1()), False),
    (partial(ec.generate_private_key, ec.SECP384R1()), True),
    (partial(dsa.generate_private_key, 2048), False),
    (ed25519.Ed25519PrivateKey.generate, True)])
def test_a_key_that_no_router_takes_is_refused_before_a_run(keys, monkeypatch, made, is_taken):
    key = made()
    with monkeypatch.context() as patched:
        patched.setattr(certificates.ec, "generate_private_key", lambda _: key)
        issue(keys, ["DM4"], "node")
    with contextlib.nullcontext() if is_taken else pytest.raises(
            KeysError, match=r"DM4.pem: its key is .*rampart keys issue DM4"):
        check(keys, ["DM4"])


def test_of_expired_certificates_each_is_named_with_its_file(keys):
    issue(keys, ["DM4"], "node", days=1 / 86_400)
    issue(keys, ["DM5"], "node", days=3)
    assert key_folder.lifetimes(keys, ["DM4", "DM5", "DM6"]).keys() == {"DM4", "DM5"}
    until = key_folder.lifetimes(keys, ["DM5"])["DM5"]
    assert key_folder.days_left(until) == pytest.approx(3, 0.01)
    time.sleep(1.1)
    found = key_folder.expired(keys, ["DM4", "DM5", "DM6"])
    assert list(found) == ["DM4"]
    assert str(keys / "DM4.pem") in found["DM4"]
    assert "rampart keys rotate DM4" in found["DM4"]


def test_a_certificate_says_who_where_and_for_how_long(keys):
    issue(keys, ["DM4"], "node", days=2)
    found = certificate(keys, "DM4")
    assert (found.common_name, found.kind, found.is_ours, found.has_key, found.addresses) == (
        "DM4", "node", True, True, ())
    assert found.not_before < dt.datetime.now(dt.UTC)
    assert found.not_after - found.not_before < dt.timedelta(days=2, minutes=6)
    issue(keys, ["ada"], "operator")
    issue(keys, ["DM5"], "node")
    assert certificate(keys, "ada").not_after < certificate(keys, "DM5").not_after
    issue(keys, ["router_a"], "router", ["10.0.0.2", "rover.local", "fe80::1"])
    before = certificate(keys, "router_a")
    assert set(before.addresses) == {
        "127.0.0.1", "::1", "localhost", "10.0.0.2", "rover.local", "fe80::1"}
    assert rotate(keys, ["router_a"]) == ["router_a"]
    for name, purpose, works in (("DM4", "sslclient", True), ("DM4", "sslserver", False),
                                 ("router_a", "sslserver", True), ("router_a", "sslclient", True)):
        done = subprocess.run(
            ["openssl", "verify", "-CAfile", keys / "ca.crt", "-purpose", purpose,
             keys / f"{name}.pem"], capture_output=True, text=True, check=False)
        assert (done.returncode == 0) == works, (name, purpose, done.stderr)
    after = certificate(keys, "router_a")
    assert after.fingerprint != before.fingerprint
    assert (after.common_name, after.addresses) == ("router_a", before.addresses)


@pytest.mark.parametrize(("text", "is_one"), [
    ("10.0.0.2", True), ("::1", True), ("rover-2.example.org", True), ("", False), ("a b", False),
    ("10.0.0.2:7450", False), ("x..y", False), ("*", False), ("rövér", False), ("a" * 64, False)])
def test_an_address_is_one_of_ip_or_the_name_of_a_host(text, is_one):
    with contextlib.nullcontext() if is_one else pytest.raises(ValueError, match="an IP address"):
        check_address(text)


def test_an_impossible_change_of_a_folder_is_refused_in_one_line(keys):
    issue(keys, ["DM4"], "node")
    before = (keys / "authority.key").read_bytes()
    for what, why in (
            (lambda: init(keys), "has an authority already"),
            (lambda: rotate(keys, ["DM5"]), "DM5: has no certificate"),
            (lambda: revoke(keys, ["bob"]), "bob: no certificate to revoke"),
            (lambda: issue(keys, ["DM4"], "operator"), "DM4: is the name of a node")):
        with pytest.raises(KeysError, match=why):
            what()
    assert (keys / "authority.key").read_bytes() == before
    (keys / "authority.key").unlink()
    with pytest.raises(KeysError, match="where the authority is"):
        issue(keys, ["DM5"], "node")
    assert check(keys, ["DM4"]) > NOW  # a run needs no authority
    keys.chmod(0o750)
    for what in (lambda: issue(keys, ["DM4"], "node"), lambda: check(keys, []),
                 lambda: init(keys)):
        with pytest.raises(KeysError, match="must be yours alone; chmod 700"):
            what()


def test_a_run_is_started_with_certificates_that_are_valid(keys):
    issue(keys, ["DM4", "DM5"], "node")
    assert check(keys, ["DM4", "DM5"]) > NOW + dt.timedelta(days=29)

    def why():
        with pytest.raises(KeysError) as told:
            check(keys, ["DM4", "DM5"])
        return str(told.value).removeprefix(f"{keys}/")

    (keys / "DM5.pem").chmod(0o640)
    assert why() == "DM5.pem: others can read it; chmod 600 it"
    (keys / "DM5.pem").write_bytes((keys / "DM4.pem").read_bytes())
    assert why() == "DM5.pem: of DM4, and not of DM5; `rampart keys issue DM5` repairs it"
    (keys / "DM5.pem").write_text("nothing")
    assert why().startswith("DM5.pem: ")
    issue(keys, ["DM5"], "node", days=-1)
    assert "valid from" in why()
    assert "`rampart keys rotate` renews it" in why()
    revoke(keys, ["DM5"])
    assert not (keys / "DM5.pem").exists()
    assert why() == "DM5.pem: DM5 is revoked; `rampart keys issue` gives it one"
    issue(keys, ["DM5"], "node")
    assert read_register(keys).of_kind("node") == {"DM4": "DM4", "DM5": "DM5.2"}
    assert certificate(keys, "DM5").common_name == "DM5.2", "it comes back as somebody else"
    other = keys.parent / "other"
    init(other)
    issue(other, ["DM5"], "node")
    (keys / "DM5.pem").write_bytes((other / "DM5.pem").read_bytes())
    assert why() == "DM5.pem: of another authority; `rampart keys issue DM5` repairs it"
    (keys / "DM5.pem").unlink()
    assert why() == "DM5.pem: DM5 has no certificate; `rampart keys issue` gives it one"


@pytest.mark.parametrize("text", [
    "", "[" * 100_000, '{"identities": {"a b": {"kind": "node"}}}',
    '{"identities": {"DM4": {"kind": "node", "number": 0}}}', "\udcff"])
def test_a_register_that_is_none_is_refused(keys, text):
    (keys / "register.json").write_text(text, errors="surrogateescape")
    with pytest.raises(KeysError, match=r"register\.json: "):
        read_register(keys)


class Killed(BaseException):
    """Ends a change of a folder of keys, as the end of its process would."""


@pytest.mark.parametrize("number", range(1, 12))
def test_a_killed_command_leaves_whole_files_and_can_be_repeated(tmp_path, monkeypatch, number):
    folder, left, whole = tmp_path / "keys", iter(range(1, number)), Path.replace

    def replace(self, target):
        if next(left, None) is None:
            raise Killed
        return whole(self, target)

    with monkeypatch.context() as patched, contextlib.suppress(Killed):
        patched.setattr(Path, "replace", replace)
        init(folder)
        issue(folder, ["DM4", "router_a"], "node")
        rotate(folder, ["DM4"])
        revoke(folder, ["DM4"])
        issue(folder, ["DM4"], "node")
    if number <= 3:
        init(folder)  # completes it
    for entry in entries(folder):
        if entry.certificate is not None and not entry.identity.revoked:
            assert entry.certificate.is_ours
            assert entry.certificate.has_key
    issue(folder, ["DM4", "DM5"], "node")
    assert check(folder, ["DM4", "DM5"]) > NOW


def test_two_at_once_lose_nothing(keys):
    code = ("import sys; from pathlib import Path; from rampart.actors.access import key_folder\n"
            "for i in range(8):\n"
            "    key_folder.issue(Path(sys.argv[1]), [sys.argv[2] + str(i)], 'node')")
    running = [subprocess.Popen([sys.executable, "-c", code, str(keys), name])
               for name in ("A", "B")]
    assert [one.wait(60) for one in running] == [0, 0]
    assert set(read_register(keys).of_kind("node")) == {f"{n}{i}" for n in "AB" for i in range(8)}
