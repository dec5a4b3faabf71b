"""Who may talk to the operator's page: the rules, on loopback and elsewhere."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.web.access import Access, AccessError, new_token, shown_token

BUSY = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
TOKEN = "a" * 22
HERE = Access("127.0.0.1", 8080)
EVERYWHERE = Access("0.0.0.0", 8080, TOKEN, ("robot",))


@pytest.mark.parametrize(("origin", "own"), [
    (None, True), ("http://127.0.0.1:8080", True), ("http://localhost:8080", True),
    ("http://[::1]:8080", True),
    ("http://127.0.0.1:8081", False), ("https://127.0.0.1:8080", False), ("null", False),
    ("http://127.0.0.1.evil.example:8080", False), ("http://evil.example", False),
    ("http://evil@127.0.0.1:8080", False), ("http://127.0.0.1:8080/x", False),
    ("http://127.0.0.1:99999999", False), ("http://[::1", False), ("", False),
    ("http://192.168.0.7:8080", False), ("http://robot:8080", False),
])
def test_on_loopback_only_the_page_itself_is_its_own_origin(origin, own):
    assert HERE.own_origin(origin) is own


@pytest.mark.parametrize(("host", "own"), [
    ("127.0.0.1:8080", True), ("localhost", True), ("LOCALHOST:8080", True), ("[::1]:8080", True),
    ("evil.example:8080", False), ("192.168.0.7", False), ("", False), (None, False),
    ("127.0.0.1@evil.example", False), ("a:b:c", False),
])
def test_on_loopback_a_host_header_must_name_loopback(host, own):
    assert HERE.own_host(host) is own


@pytest.mark.parametrize(("host", "own"), [
    ("192.168.0.7:8080", True), ("[fe80::1]:8080", True), ("robot:8080", True), ("Robot", True),
    ("localhost:8080", True), ("evil.example:8080", False), ("robot.evil.example", False),
])
def test_elsewhere_an_address_or_the_own_name_will_do_since_they_cannot_be_rebound(host, own):
    assert EVERYWHERE.own_host(host) is own
    assert EVERYWHERE.own_origin(f"http://{host.removesuffix(':8080')}:8080") is own


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "robot", "", "localhost.evil"])
def test_nothing_but_loopback_is_served_without_a_token(host):
    with pytest.raises(AccessError, match="needs a token"):
        Access(host, 8080)


@pytest.mark.parametrize("token", ["short", "x" * 15, "with a space in the middle", "ä" * 20,
                                   "slash/slash/slash/slash", "y" * 201])
def test_a_token_that_is_short_or_no_word_is_refused(token):
    with pytest.raises(AccessError, match="must be 16 or more"):
        Access("0.0.0.0", 8080, token)


def test_only_the_token_opens_and_on_loopback_nothing_is_asked():
    assert EVERYWHERE.permits(TOKEN)
    assert HERE.permits(None)
    for wrong in (None, "", TOKEN[:-1], TOKEN + "a", TOKEN.upper(), "ä", "\ud800"):
        assert not EVERYWHERE.permits(wrong)


def test_a_loopback_page_with_a_token_asks_for_it_too():
    assert not Access("127.0.0.1", 8080, TOKEN).permits(None)


def test_new_tokens_are_accepted_and_never_the_same():
    tokens = {new_token() for _ in range(100)}
    assert len(tokens) == 100
    for token in tokens:
        Access("0.0.0.0", 8080, token)


@pytest.mark.parametrize(("shown", "found"), [
    ((f"Bearer {TOKEN}", None, ()), TOKEN), ((f"bearer {TOKEN}", "other", ()), TOKEN),
    ((None, None, ("rampart", f"token.{TOKEN}")), TOKEN), ((None, TOKEN, ("rampart",)), TOKEN),
    (("Basic x", None, ()), None), ((None, None, ()), None),
])
def test_a_token_is_shown_by_header_subprotocol_or_query(shown, found):
    assert shown_token(*shown) == found


def test_the_address_to_open_carries_the_token_where_no_server_sees_it():
    assert EVERYWHERE.url == f"http://127.0.0.1:8080/#token={TOKEN}"
    assert HERE.url == "http://127.0.0.1:8080/"
    assert Access("fe80::1", 1, TOKEN).url.startswith("http://[fe80::1]:1/#")


@BUSY
@given(st.text(max_size=60))
def test_no_header_whatever_is_in_it_raises(text):
    for access in (HERE, EVERYWHERE):
        assert access.own_host(text) in (True, False)
        assert access.own_origin(text) in (True, False)
        assert access.permits(text) in (True, False)
