"""Faults of processes: what runs on another host is hit by the supervisor there."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.run_context import RunContext
from rampart.manager.spec.specification import parse_specification
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.injector import Injector
from rampart.sim.faults.scenario import parse_fault
from rampart.testing import VirtualSystem, run
from tests.two_hosts import two_hosts

SYSTEM = parse_specification(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}), "two.toml")


class Supervisor(Actor):
    """The supervisor of the other host, on which there is `hmi`, and `DM5` that may not be hit."""

    outputs = (topics.PROCESS_EVENT,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.orders: list[tuple[float, str, str]] = []

    @on(topics.SIGNAL)
    def signal(self, order: fm.SignalOrder, _header: Header) -> None:
        self.orders.append((round(self.clock.now(), 1), order.node, order.signal))
        if order.node in ("hmi", "DM5"):
            is_hit = order.node == "hmi"
            self.publish(topics.PROCESS_EVENT, fm.ProcessEvent(
                order.node, "signalled" if is_hit else "refused", 7 * is_hit, 1, order.order,
                "" if is_hit else "not permitted"))


@pytest.mark.parametrize(("fault", "orders", "affected", "reason"), [
    ("kill:hmi@1", [(1.0, "hmi", "KILL")], 1, ""),
    ("wedge:hmi@1", [(1.0, "hmi", "WEDGE")], 1, ""),
    ("stop:hmi@1+2", [(1.0, "hmi", "STOP"), (3.0, "hmi", "CONT")], 1, ""),
    ("kill:DM5@1", [(1.0, "DM5", "KILL")], 0, "DM5: not permitted"),
    ("kill:DM13@1", [(1.0, "DM13", "KILL")], 0, "no host has answered that it runs DM13"),
    ("kill:DM1@1", [], 1, ""),
])
def test_what_runs_on_another_host_is_hit_by_its_supervisor(fault, orders, affected, reason):
    async def scenario() -> None:
        async with VirtualSystem() as system:
            supervisor = system.start("supervisor_ground", Supervisor)
            context = replace(system.context("injector", {}), run=RunContext(system=SYSTEM))
            injector = Injector(
                context, [parse_fault(fault)], lambda _what, node, _pace_s: node == "DM1",
                nodes=("hmi", "DM1", "DM5", "DM13"), known=(), faults=Faults())
            task = asyncio.create_task(injector.run())
            await asyncio.sleep(5.0)
            (outcome,) = injector.outcomes()
            assert (outcome.affected, outcome.reason) == (affected, reason)
            assert supervisor.orders == orders
            injector.stop()
            await task

    run(scenario)
