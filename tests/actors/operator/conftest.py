"""An HMI in a small world, and a page on it."""

import pytest

from rampart.actors.operator import stick_arbitration
from tests.actors.operator.browser import browser
from tests.actors.operator.world import World, open_page, served


@pytest.fixture
async def world():
    """A small world for an HMI: only `others` are in it."""
    made = World()
    async with made.running(made.others):
        yield made


@pytest.fixture
async def hmi(world, request):
    """An HMI that serves its page; a parameter of the test has its fields."""
    async with world.hmi(**getattr(request, "param", {})) as made:
        await served(made)
        yield made


@pytest.fixture
async def page(hmi):
    """The WebSocket of a page on `hmi`."""
    async with open_page(await served(hmi)) as opened:
        yield opened


@pytest.fixture
async def tab():
    """A tab of Chromium that is to have no reason to complain."""
    async with browser() as opened:
        yield opened
        assert opened.errors == []


@pytest.fixture
def patient(monkeypatch):
    """Let a page of a busy machine not count as silent, where time is not the subject."""
    monkeypatch.setattr(stick_arbitration, "TIMEOUT_S", 5.0)
