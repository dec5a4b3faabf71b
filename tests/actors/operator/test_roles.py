"""Every request of a page with every role: the server decides, whatever the page shows."""

from __future__ import annotations

import msgspec
import pytest

from rampart.actors.operator.requests import Request
from rampart.actors.web.visitors import Role, issue
from rampart.testing import free_port
from tests.actors.operator.test_operating import ask, open_page
from tests.actors.operator.world import hear, served

NEEDS = {"reset": Role.DRIVE, "stick": Role.DRIVE, "mission": Role.DRIVE, "order": Role.DRIVE,
         "strategy": Role.INJECT, "signal": Role.INJECT, "inject": Role.INJECT,
         "end-fault": Role.INJECT}
"""Each kind of request that there is, and who may make it: a new one has to be put here."""

SAMPLES = {
    "reset": {"recovery": "RM1"}, "strategy": {"name": "mission-first"},
    "signal": {"node": "localization", "signal": "KILL"}, "inject": {"fault": "gps-bias"},
    "end-fault": {"injection": "x"}, "stick": {"panel": "Drive", "held": True},
    "mission": {"name": "A"}, "order": {"action": "pause"}}


def tag(kind: type[Request]) -> str:
    return str(kind.__struct_config__.tag)


def test_a_request_of_ones_own_is_for_those_who_may_do_everything_unless_it_says_otherwise():
    class Flush(Request, frozen=True, tag="flush"):
        """Declares no role."""

    assert Flush.role is Role.INJECT


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("kind", NEEDS)
@pytest.mark.parametrize("role", Role)
async def test_what_a_role_lacks_the_server_refuses_and_nothing_happens(
        world, tmp_path, monkeypatch, role, kind):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna", role)
    async with world.hmi(hmi_port=free_port(), hmi_token_file=str(file)) as hmi:
        asked: list[Request] = []
        handlers = hmi._server._handlers if hmi._server else None
        at = await served(hmi)
        handlers = hmi._server._handlers

        def fulfil(request: Request, page: int):
            asked.append(request)
            return handlers.fulfil(request, page)

        hmi._server._handlers = msgspec.structs.replace(handlers, fulfil=fulfil)
        async with open_page(at, additional_headers={"Authorization": f"Bearer {token}"}) as page:
            told = await hear(page, "visitor")
            answer = await ask(page, type=kind, **SAMPLES[kind])
            if role.may(NEEDS[kind]):
                assert [tag(type(request)) for request in asked] == [kind]
                assert kind not in told["barred"]
            else:
                why = f"Needs the role {NEEDS[kind]}; anna has the role {role}"
                assert (answer, asked) == ({"type": "error", "text": why}, [])
                assert told["barred"][kind] == why
    if not role.may(NEEDS[kind]):
        assert [*world.others.requests, *world.others.orders, *world.others.resets,
                *world.others.adaptations, *world.others.injections] == []
