"""Who may talk to the operator's page: the rules, on loopback and elsewhere."""

from __future__ import annotations

import pytest

from rampart.actors.web.access import Access, AccessError, check_token, page_url

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
