"""Logging in by a token, and being known by a cookie."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from itsdangerous import TimestampSigner

from rampart.actors.web.door import LASTS_S, Gate
from rampart.actors.web.visitors import Register, Role, Visitor, digest

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
