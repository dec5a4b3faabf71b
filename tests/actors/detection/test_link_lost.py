"""A host that cannot be reached: when it is reported, which host, and when it is over."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.detection.link_lost import LinkLost
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.testing import Ear, VirtualSystem
from tests.virtual_time import within


def table(*lost: str) -> fm.NodeTable:
    return fm.NodeTable(tuple(
        fm.NodeInfo(f"router_a_{host}", "supervision", 1, fm.NodeState.UNREACHABLE if host in lost
                    else fm.NodeState.RUNNING, 1, 0, host=host) for host in ("ground", "moon")))


@pytest.mark.parametrize(("parameters", "lost", "reason"), [
    ({}, ("ground",), "no link to ground"),
    ({}, ("ground", "moon"), "no link to ground, moon"),
    ({"host": "moon"}, ("ground",), ""),
    ({"host": "moon"}, ("ground", "moon"), "no link to moon"),
    ({"for_s": 1.0}, ("ground",), ""),
    ({"for_s": 0.3}, ("ground",), "no link to ground"),
])
@within(VirtualSystem)
async def test_who_is_lost_is_told_after_the_time_that_was_said(system, parameters, lost, reason):
    system.start("D_LINK", LinkLost, **parameters)
    ear = system.start("ear", Ear)
    for said in (table(), table(*lost), table(*lost)):
        system.say(topics.NODES, said, "supervisor")
        await asyncio.sleep(0.4)
    assert ear.heard[-1][1].reason == reason
    assert ear.states == (["idle", "active"] if reason else ["idle"])
    system.say(topics.NODES, table(), "supervisor")
    await asyncio.sleep(0.4)
    system.say(topics.NODES, table(), "supervisor")
    await asyncio.sleep(0.1)
    assert ear.states[-1] == "idle"
