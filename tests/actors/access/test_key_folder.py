"""A folder of keys: what is made, who may read it, and what is left when its maker is killed."""

from __future__ import annotations

import datetime as dt
import multiprocessing
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric import dsa, ec, ed25519, rsa

from rampart.actors.access import certificates, key_folder
from rampart.actors.access.certificates import check_address, new_authority, read_certificate
from rampart.actors.access.key_folder import check, entries, init, issue, revoke, rotate
from rampart.actors.access.register import Identity, KeysError, Register, read_register

GENERATED = ec.generate_private_key
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


KINDS = {
    "RSA of 1024 bits": lambda: rsa.generate_private_key(65537, 1024),
    "RSA of 1536 bits": lambda: rsa.generate_private_key(65537, 1536),
    "curve secp521r1": lambda: GENERATED(ec.SECP521R1()),
    "curve secp256k1": lambda: GENERATED(ec.SECP256K1()),
    "DSA": lambda: dsa.generate_private_key(2048),
    "": lambda: rsa.generate_private_key(65537, 2048), " ": lambda: GENERATED(ec.SECP384R1()),
    "  ": ed25519.Ed25519PrivateKey.generate}


@pytest.mark.parametrize("kind", KINDS)
def test_a_key_that_no_router_takes_is_refused_before_a_run(keys, monkeypatch, kind):
    with monkeypatch.context() as patched:
        patched.setattr(certificates.ec, "generate_private_key", lambda _: KINDS[kind]())
        issue(keys, ["DM4"], "node")
    if kind.strip():
        with pytest.raises(KeysError, match=rf"DM4.pem: its key is [^\n]*{kind}") as raised:
            check(keys, ["DM4"])
        assert "rampart keys issue DM4" in str(raised.value)
    else:
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


def test_a_certificate_says_who_and_for_how_long(keys):
    issue(keys, ["DM4"], "node", days=2)
    found = certificate(keys, "DM4")
    assert (found.common_name, found.kind, found.is_ours, found.has_key) == (
        "DM4", "node", True, True)
    assert found.not_before < NOW
    assert found.not_after - found.not_before < dt.timedelta(days=2, minutes=6)
    assert found.addresses == ()


def test_people_have_theirs_for_a_shorter_time(keys):
    issue(keys, ["ada"], "operator")
    issue(keys, ["DM4"], "node")
    assert certificate(keys, "ada").not_after < certificate(keys, "DM4").not_after


def test_a_router_is_reached_on_loopback_and_where_it_is_said(keys):
    issue(keys, ["router_a"], "router", ["10.0.0.2", "rover.local", "fe80::1"])
    assert set(certificate(keys, "router_a").addresses) == {
        "127.0.0.1", "::1", "localhost", "10.0.0.2", "rover.local", "fe80::1"}


@pytest.mark.parametrize("text", ["10.0.0.2", "::1", "rover", "rover-2.example.org"])
def test_an_address_is_one(text):
    check_address(text)


@pytest.mark.parametrize("text", ["", "a b", "10.0.0.2:7450", "x..y", "*", "rövér", "a" * 64])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(ValueError, match="is no IP address"):
        check_address(text)


def test_openssl_verifies_what_is_issued(keys):
    issue(keys, ["DM4"], "node")
    issue(keys, ["router_a"], "router")
    for name, purpose, works in (("DM4", "sslclient", True), ("DM4", "sslserver", False),
                                 ("router_a", "sslserver", True), ("router_a", "sslclient", True)):
        done = subprocess.run(
            ["openssl", "verify", "-CAfile", keys / "ca.crt", "-purpose", purpose,
             keys / f"{name}.pem"], capture_output=True, text=True, check=False)
        assert (done.returncode == 0) == works, (name, purpose, done.stderr)


def test_a_second_authority_does_not_replace_the_first(keys):
    before = (keys / "authority.key").read_bytes()
    with pytest.raises(KeysError, match="has an authority already"):
        init(keys)
    assert (keys / "authority.key").read_bytes() == before


def test_a_folder_that_others_can_enter_is_refused(keys):
    keys.chmod(0o750)
    for what in (lambda: issue(keys, ["DM4"], "node"), lambda: check(keys, []),
                 lambda: init(keys)):
        with pytest.raises(KeysError, match="must be yours alone; chmod 700"):
            what()


def test_who_is_not_where_the_authority_is_issues_nothing(keys):
    issue(keys, ["DM4"], "node")
    (keys / "authority.key").unlink()
    with pytest.raises(KeysError, match="issued where the authority is"):
        issue(keys, ["DM5"], "node")
    assert check(keys, ["DM4"]) > NOW  # a run needs it not


def test_a_rotated_certificate_has_a_new_key_and_the_same_name_and_addresses(keys):
    issue(keys, ["router_a"], "router", ["10.0.0.2"])
    before = certificate(keys, "router_a")
    assert rotate(keys, []) == ["router_a"]
    after = certificate(keys, "router_a")
    assert after.fingerprint != before.fingerprint
    assert (after.common_name, set(after.addresses)) == ("router_a", set(before.addresses))


def test_nobody_is_rotated_who_has_none(keys):
    with pytest.raises(KeysError, match="DM4: has no certificate"):
        rotate(keys, ["DM4"])


def test_a_revoked_name_comes_back_as_somebody_else(keys):
    issue(keys, ["ada"], "operator")
    revoke(keys, ["ada"])
    assert not (keys / "ada.pem").exists()
    assert read_register(keys).of_kind("operator") == {}
    issue(keys, ["ada"], "operator")
    assert read_register(keys).of_kind("operator") == {"ada": "ada.2"}
    assert certificate(keys, "ada").common_name == "ada.2"
    with pytest.raises(KeysError, match="bob: has no certificate that could be revoked"):
        revoke(keys, ["bob"])


def test_a_name_is_of_one_kind(keys):
    issue(keys, ["DM4"], "node")
    with pytest.raises(KeysError, match="DM4: is the name of a node"):
        issue(keys, ["DM4"], "operator")


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
    assert why() == "DM5.pem: of DM4, and not of DM5; `rampart keys issue DM5` mends it"
    (keys / "DM5.pem").write_text("nothing")
    assert why().startswith("DM5.pem: ")
    issue(keys, ["DM5"], "node", days=-1)
    assert "valid from" in why()
    assert "`rampart keys rotate` renews it" in why()
    revoke(keys, ["DM5"])
    assert why() == "DM5.pem: DM5 is revoked; `rampart keys issue` gives it one"
    issue(keys, ["DM5"], "node")
    other = keys.parent / "other"
    init(other)
    issue(other, ["DM5"], "node")
    (keys / "DM5.pem").write_bytes((other / "DM5.pem").read_bytes())
    assert why() == "DM5.pem: of another authority; `rampart keys issue DM5` mends it"
    (keys / "DM5.pem").unlink()
    assert why() == "DM5.pem: DM5 has no certificate; `rampart keys issue` gives it one"


@pytest.mark.parametrize("text", [
    "", "[]", "{", '{"identities": {"a b": {"kind": "node"}}}', "[" * 100_000,
    '{"identities": {"DM4": {"kind": "king"}}}',
    '{"identities": {"DM4": {"kind": "node", "x": 1}}}',
    '{"identities": {"DM4": {"kind": "node", "number": 0}}}', "\udcff"])
def test_a_register_that_is_none_is_refused(keys, text):
    (keys / "register.json").write_text(text, errors="surrogateescape")
    with pytest.raises(KeysError, match=r"register\.json: "):
        read_register(keys)


def test_a_register_is_read_as_it_was_written():
    register = Register({"DM4": Identity("node", 3, revoked=True)})
    assert msgspec.json.decode(msgspec.json.encode(register), type=Register) == register


def _killed_at(folder, number):
    """Do what changes a folder of keys, and be killed at the n-th change of a name on the disk."""
    count = 0
    whole = Path.replace

    def replace(self, target):
        nonlocal count
        count += 1
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return whole(self, target)

    Path.replace = replace
    init(folder)
    issue(folder, ["DM4", "router_a"], "node")
    rotate(folder, ["DM4"])
    revoke(folder, ["DM4"])
    issue(folder, ["DM4"], "node")


@pytest.mark.parametrize("number", range(1, 12))
def test_who_is_killed_leaves_whole_files_and_can_go_on(tmp_path, number):
    folder = tmp_path / "keys"
    process = multiprocessing.get_context("spawn").Process(target=_killed_at, args=(folder, number))
    process.start()
    process.join(60)
    assert process.exitcode in {0, -signal.SIGKILL}
    if process.exitcode and number <= 3:
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


def test_an_authority_is_one():
    assert new_authority(NOW, 1) != new_authority(NOW, 1)
    assert key_folder.DAYS["operator"] < key_folder.DAYS["node"]
