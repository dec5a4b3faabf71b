"""Holders that are not recovery modules are obeyed and reported, and can be released.

Nor does a forged later incarnation mute a recovery module, or a source of commands.
"""

import asyncio
from functools import partial

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.holders import UNKNOWN
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.pilot.safety_gate import Checks, GateLimits, SafetyGate
from rampart.actors.osmosis.messages import PilotMode
from rampart.testing import VirtualSystem
from tests.fuzz.test_handler_fuzz import system
from tests.virtual_time import within

FORGED = 999_999


class World(VirtualSystem):
    """One actor of the paper's system, its messages, and any sender."""

    def __init__(self, name):
        of = system("paper")
        super().__init__(of.run, of.layout)
        self.register = dict.fromkeys(of.layout.members, 1).get
        self.name = name

    async def __aenter__(self):
        await super().__aenter__()
        self.sent = self.overhear(self.name)
        self.actor = self.start_node(self.name)
        await asyncio.sleep(0.1)
        return self

    async def tell(self, topic, body, source, incarnation=1):
        self.say(topic, body, source, incarnation=incarnation)
        await asyncio.sleep(0.05)

    async def reset(self, holder):
        await self.tell(ftm_topics.RESET, fm.Reset(holder, "operator"), "tool")

    def last(self, key):
        return [body for found, body in self.sent if found == key][-1]

    @property
    def holders(self):
        return tuple(self.last(f"holds/{self.name}")["holders"])

    @property
    def is_braked(self):
        return bool(self.actor._brakes)

    @property
    def reports(self):
        return [(body["context"], body["offender"]) for key, body in self.sent
                if key == f"diagnostic/{self.name}"]


STOP = m.PilotOrder(True, PilotMode.STOP, "test")
BRAKE, LET_GO = (m.BrakeCommand(engaged, "test") for engaged in (True, False))


# -- the base -----------------------------------------------------------------------------------


@within(partial(World, "simulator"))
async def test_an_unknown_holder_of_the_brake_is_obeyed_shown_and_can_be_made_to_let_go(world):
    await world.tell(topics.BRAKE, BRAKE, "nobody")
    assert world.is_braked
    assert world.holders == ("nobody",)
    assert ("brake", "nobody") in world.reports
    world.sent.clear()
    await asyncio.sleep(0.5)
    assert [key for key, _ in world.sent].count("holds/simulator") == 2
    await world.reset("nobody")
    assert not world.is_braked
    assert world.holders == ()
    world.sent.clear()
    await asyncio.sleep(0.5)
    assert "holds/simulator" not in [key for key, _ in world.sent]
    await world.tell(topics.BRAKE, BRAKE, "nobody")
    await world.tell(topics.BRAKE, LET_GO, "nobody")
    assert (world.is_braked, world.holders) == (False, ())


@within(partial(World, "simulator"))
async def test_a_recovery_module_s_brake_is_its_own_to_release_whatever_anybody_forges(world):
    await world.tell(topics.BRAKE, LET_GO, "RM1", FORGED)
    await world.tell(topics.BRAKE, BRAKE, "RM1")
    await world.reset("RM1")
    await world.tell(topics.BRAKE, LET_GO, "RM1", FORGED)
    assert world.is_braked
    assert not any(key.startswith("holds") for key, _ in world.sent)
    await world.tell(topics.BRAKE, LET_GO, "RM1")
    assert not world.is_braked


# -- the Safety Pilot ---------------------------------------------------------------------------


@within(partial(World, "safety_pilot"))
async def test_an_order_of_an_unknown_module_is_obeyed_reported_shown_and_can_be_ended(world):
    await world.tell(topics.PILOT_ORDER, STOP, "nobody")
    assert world.last("pilot/status")["mode"] == "stop"
    assert world.holders == ("nobody",)
    assert ("pilot order", "nobody") in world.reports
    await world.reset("nobody")
    assert world.last("pilot/status")["mode"] == "auto"
    assert world.holders == ()


def test_orders_of_a_crowd_are_bounded_and_the_strictest_holds():
    gate = SafetyGate(GateLimits(), Checks(), 0.0, ["RM2"])
    for number in range(10_000):
        gate.order(f"s{number}", m.PilotOrder(True, PilotMode.AUTO, "", 0.1))
    assert len(gate.orders.unknown) == UNKNOWN + 1
    assert gate.mode is PilotMode.STOP
    for name in gate.orders.unknown:
        assert gate.orders.reset(name)
    assert (gate.mode, gate.top_speed_mps, gate.orders.unknown) == (PilotMode.AUTO, 0.0, ())
    gate.order("RM2", m.PilotOrder(True, PilotMode.STOP, ""))
    assert not gate.orders.reset("RM2")
    assert gate.orders.unknown == ()
