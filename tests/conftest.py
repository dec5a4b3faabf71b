"""Fixtures that several test files share; helpers are modules of their own."""

from __future__ import annotations

import os

import pytest

from rampart.actors.bus import run_folder


@pytest.fixture
def sockets():
    """The folder of a run, for sockets: the tests' own would make their addresses too long."""
    folder = run_folder.make(0, os.getpid())
    yield folder
    run_folder.remove(folder)


@pytest.fixture
async def world():
    """A small world for an HMI, with nobody else in it but `others`."""
    from tests.actors.operator.world import World

    made = World()
    async with made.running(made.others):
        yield made


@pytest.fixture
def patient(monkeypatch):
    """For tests in which time is not the subject: a busy machine is no silent page."""
    from rampart.actors.osmosis.page import stick as hmi_stick

    monkeypatch.setattr(hmi_stick, "SILENCE_S", 5.0)
    monkeypatch.setattr(hmi_stick, "TICKET_S", 5.0)
