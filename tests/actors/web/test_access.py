"""Who may talk to the operator's page: the rules, on loopback and elsewhere."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from itsdangerous import TimestampSigner

from rampart.actors.web.access import Access, AccessError, check_token, page_url
from rampart.actors.web.door import LASTS_S, Gate
from rampart.actors.web.visitors import Register, Role, Visitor, digest

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
