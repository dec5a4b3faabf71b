"""Every request of a page with every role: the server decides, whatever the page shows."""

from __future__ import annotations

import msgspec
import pytest

from rampart.actors.operator.requests import Request
from rampart.actors.web.visitors import Role, issue
from tests.actors.operator.world import ask, hear, visited

NEEDS = {"reset": Role.DRIVE, "stick": Role.DRIVE, "mission": Role.DRIVE, "order": Role.DRIVE,
         "strategy": Role.INJECT, "signal": Role.INJECT, "inject": Role.INJECT,
         "end-fault": Role.INJECT}
"""Each kind of request that there is, and who may make it: a new one has to be put here."""

SAMPLES = {
    "reset": {"recovery": "RM1"}, "strategy": {"name": "mission-first"},
    "signal": {"node": "localization", "signal": "KILL"}, "inject": {"fault": "gps-bias"},
    "end-fault": {"injection": "x"}, "stick": {"panel": "Drive", "held": True},
    "mission": {"name": "A"}, "order": {"action": "pause"}}


def test_a_request_of_ones_own_is_for_those_who_may_do_everything_unless_it_says_otherwise():
    class Flush(Request, frozen=True, tag="flush"):
        """Declares no role."""

    assert Flush.role is Role.INJECT


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("role", Role)
async def test_what_a_role_lacks_the_server_refuses_and_nothing_happens(world, tmp_path, role):
    file = tmp_path / "page.tokens"
    token = issue(file, "anna", role)
    async with visited(world, token, hmi_token_file=str(file)) as (hmi, page):
        asked: list[str] = []
        handlers = hmi._server._handlers

        def fulfil(request: Request, page: int):
            asked.append(str(request.__struct_config__.tag))
            return handlers.fulfil(request, page)

        hmi._server._handlers = msgspec.structs.replace(handlers, fulfil=fulfil)
        barred = (await hear(page, "visitor"))["barred"]
        for kind, sample in SAMPLES.items():
            answer = await ask(page, type=kind, **sample)
            if not role.may(NEEDS[kind]):
                why = f"Needs the role {NEEDS[kind]}; anna has the role {role}"
                assert answer == {"type": "error", "text": why}
                assert barred.pop(kind) == why
        assert asked == [kind for kind in SAMPLES if role.may(NEEDS[kind])]
        assert barred == {}
    if not asked:
        assert [*world.others.requests, *world.others.orders, *world.others.resets,
                *world.others.adaptations, *world.others.injections] == []
