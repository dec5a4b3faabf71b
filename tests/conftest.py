"""Fixtures that several test files share; helpers are modules of their own."""

from __future__ import annotations

import pytest


@pytest.fixture
async def world():
    """A small world for an HMI, with nobody else in it but `others`."""
    from hmi_world import World

    made = World()
    async with made.running(made.others):
        yield made


@pytest.fixture
def patient(monkeypatch):
    """For tests in which time is not the subject: a busy machine is no silent page."""
    from actors.operator import hmi_stick

    monkeypatch.setattr(hmi_stick, "SILENCE_S", 5.0)
    monkeypatch.setattr(hmi_stick, "TICKET_S", 5.0)
