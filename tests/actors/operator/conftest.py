"""An HMI in a small world, and a page on it."""

import pytest

from rampart.actors.operator import stick_arbitration
from rampart.actors.supervision.kill_node import UnknownNodeError
from rampart.actors.supervision.process_title import RunProcess
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


@pytest.fixture
def signalled(monkeypatch):
    """Nodes of this host that were signalled from a page, and how: no process is hit."""
    sent = []

    def signal_node(node, name, _port):
        if node not in ("localization", "osmosis_control", "hmi"):
            raise UnknownNodeError(f"unknown node {node!r}")
        sent.append((node, name))
        return RunProcess(77, 7450, 1, (node,), 1)

    monkeypatch.setattr("rampart.actors.operator.operating.signal_node", signal_node)
    return sent
