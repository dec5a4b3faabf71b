"""Spares are used, and whatever happens to one costs nothing but itself."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import re
import selectors
import signal
import socket
import time
from pathlib import Path
from typing import NoReturn

import msgspec
import pytest

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem, RespawnRequest
from rampart.actors.machine.patience import usage
from rampart.actors.osmosis import topics as robot
from rampart.actors.runtime.actor import Actor, on
from rampart.actors.runtime.run_plan import load_document, load_system
from rampart.actors.supervision import spare
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.layout import Layout
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.testing import eventually
from tests.actors.supervision import test_supervision as base
from tests.stub_actors import IdleDetection, IdlePose, launched, stub_plan, write_stub_system

HURTS = (signal.SIGKILL, signal.SIGSTOP, signal.SIGUSR2)
"""Killed, stopped, hung."""


def hot_system(folder: Path) -> Path:
    """Write the stub system with a localization that talks, and has a hot spare."""
    file = write_stub_system(folder)
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(
        'actor = "tests.stub_actors:IdlePose"',
        'actor = "tests.actors.supervision.test_spares:TalkingPose"\nspare = "hot"'),
        encoding="utf-8")
    return file


class TalkingPose(IdlePose):
    """Says something fifty times a second."""

    def on_start(self) -> None:
        self._say()

    def _say(self) -> None:
        self.publish(robot.POSE, robot.POSE.type(1.0, 2.0, 3.0))
        self.call_later(0.02, self._say)


class Listener(base.Witness):
    """Also notes who says where the robot is."""

    def __init__(self, context, launcher) -> None:
        super().__init__(context, launcher)
        self.said: list[int] = []
        self.there: list[tuple[int, bool]] = []

    @classmethod
    def watches(cls, name, parameters):
        return ("localization",)

    def on_peer(self, node: str, incarnation: int, alive: bool) -> None:
        self.there.append((incarnation, alive))

    @on(robot.POSE)
    def pose(self, _message, header: Header) -> None:
        self.said.append(header.incarnation)


def pids(port: int, *names: str) -> dict[str, int]:
    return {name: p.pid for p in find_processes(port) for name in p.names if name in names}


async def spares(port: int, *names: str,
                 other_than: dict[str, int] | None = None) -> dict[str, int]:
    """Return the spares of these names, once they are there and have had time to be ready."""
    old = set((other_than or {}).values())
    await eventually(lambda: set(pids(port, *names)) == set(names)
                     and old.isdisjoint(pids(port, *names).values()), 20)
    await asyncio.sleep(0.5)
    return pids(port, *names)


def respawn(witness: base.Witness, node: str, failed: int) -> None:
    witness.publish(topics.RESPAWN, RespawnRequest(failed, node, failed, "RM3"))


class TellingDetection(IdleDetection):
    """Tells what it was started with."""

    def on_start(self) -> None:
        self.report_diagnostic("started with", str(self.context.run.document["title"]), "")


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.parametrize("characters", [155_000, 400_000])
async def test_whatever_starts_after_a_change_knows_it_and_spares_are_used_as_before(
        tmp_path, characters):
    file = tmp_path / "telling.toml"
    file.write_text(write_stub_system(tmp_path).read_text(encoding="utf-8").replace(
        "tests.stub_actors:IdleDetection",
        "tests.actors.supervision.test_spares:TellingDetection"), encoding="utf-8")
    async with base.running(tmp_path, system_file=str(file)) as (launcher, witness):
        port, both = launcher.plan.base_port, ("spare_a", "spare_b")
        there, start = await spares(port, *both), len(witness.errors)
        document = load_document(launcher.plan)
        document["title"] = "changed"
        document["node"][0].setdefault("parameters", {})["text"] = "x" * characters
        row = next(row for row in document["detection"] if row["name"] == "DM1")
        row.setdefault("parameters", {})["margin_m"] = 0.7
        witness.publish(topics.ADAPTED_SYSTEM, AdaptedSystem(
            1, "retune DM1", "me", msgspec.json.encode(document).decode()))
        await eventually(lambda: witness.state("DM1") == ("running", 2))
        for number in range(2):
            there = await spares(port, *both, other_than=there)
            os.kill(witness.pid("DM2"), signal.SIGKILL)
            await eventually(lambda n=number: witness.state("DM2") == ("running", n + 2))
            assert witness.pid("DM2") in there.values()  # of whichever spawner was not slow before
            there = {"used": witness.pid("DM2")}
        os.kill(pids(port, "supervisor")["supervisor"], signal.SIGKILL)
        await eventually(lambda: witness.state("supervisor") == ("running", 2))
        os.kill(witness.pid("DM3"), signal.SIGKILL)
        await eventually(lambda: witness.state("DM3") == ("running", 2))
        titles = [e.reason for e in witness.errors[start:] if e.context == "started with"]
        assert titles == 4 * ["changed"]


@pytest.mark.processes
@pytest.mark.alone
async def test_a_spare_becomes_the_node_and_one_that_cannot_costs_nothing_but_itself(tmp_path):
    async with base.running(tmp_path) as (launcher, witness):
        port, both = launcher.plan.base_port, ("spare_a", "spare_b")
        there = await spares(port, *both)
        os.kill(witness.pid("DM1"), signal.SIGKILL)
        await eventually(lambda: witness.state("DM1") == ("running", 2))
        assert witness.pid("DM1") == there["spare_a"]
        for number, hurt in enumerate(HURTS):
            there = await spares(port, *both, other_than={"used": there["spare_a"]})
            for pid in there.values():
                os.kill(pid, hurt)
            os.kill(witness.pid("DM1"), signal.SIGKILL)
            await eventually(lambda n=number: witness.state("DM1") == ("running", n + 3))
            assert witness.pid("DM1") not in there.values()
            await eventually(lambda t=there: not Path(f"/proc/{t['spare_a']}").exists())
        there = await spares(port, *both, other_than={"used": there["spare_a"]})
        for hurt in HURTS:  # it is found out though nobody needs it
            for pid in there.values():
                os.kill(pid, hurt)
            there = await spares(port, *both, other_than=there)
        spawner = pids(port, "spawner_a")["spawner_a"]
        ran_s, begun_s = usage(spawner).ran_s, time.monotonic()
        await asyncio.sleep(2.5)
        assert pids(port, *both) == there, "one that is well is left alone"
        assert usage(spawner).ran_s - ran_s < (time.monotonic() - begun_s) / 4, "it asks too often"


@pytest.mark.processes
async def test_one_made_ready_waits_for_the_decision_and_not_for_ever(tmp_path):
    async with base.running(tmp_path) as (launcher, witness):
        port, waits = launcher.plan.base_port, "spare.localization"
        await spares(port, "spare_a", "spare_b")
        for failed in (1, 2):
            os.kill(witness.pid("localization"), signal.SIGKILL)
            await eventually(lambda: pids(port, waits))
            ready = pids(port, waits)[waits]
            assert witness.state("localization")[1] == failed
            respawn(witness, "localization", failed)
            await eventually(
                lambda f=failed: witness.state("localization") == ("running", f + 1))
            assert witness.pid("localization") == ready
            await asyncio.sleep(0.6)
        for failed, hurt in enumerate(HURTS, 3):
            os.kill(witness.pid("localization"), signal.SIGKILL)
            await eventually(lambda: pids(port, waits))
            ready = pids(port, waits)[waits]
            os.kill(ready, hurt)
            respawn(witness, "localization", failed)
            await eventually(
                lambda f=failed: witness.state("localization") == ("running", f + 1))
            assert witness.pid("localization") != ready
            await eventually(lambda r=ready: not Path(f"/proc/{r}").exists())
            await asyncio.sleep(0.6)
        os.kill(witness.pid("localization"), signal.SIGKILL)
        await eventually(lambda: pids(port, waits))
        await eventually(lambda: not pids(port, waits), 5)  # nobody wants it
        assert witness.state("localization")[0] == "crashed"
        os.kill(pids(port, "supervisor")["supervisor"], signal.SIGKILL)
        await eventually(lambda: witness.state("supervisor") == ("running", 2), 20)
        respawn(witness, "localization", 6)
        await eventually(lambda: witness.state("localization") == ("running", 7))


@pytest.mark.processes
async def test_a_hot_spare_is_silent_until_it_is_the_node(tmp_path):
    async with launched(stub_plan(hot_system(tmp_path))) as launcher:
        port, waits = launcher.plan.base_port, "spare.localization"
        witness = Listener(base.Context(
            "observer", 1, base.Clock(launcher.plan.origin_s), launcher.observers_bus()), launcher)
        task = asyncio.create_task(witness.run())
        try:
            await eventually(lambda: witness.state("localization") == ("running", 1), 20)
            hot = await spares(port, waits)
            for hurt in HURTS:  # it is found out though nobody needs it
                os.kill(hot[waits], hurt)
                hot = await spares(port, waits, other_than=hot)
            assert set(witness.said) == {1}
            os.kill(witness.pid("localization"), signal.SIGKILL)
            respawn(witness, "localization", 1)
            await eventually(lambda: witness.state("localization") == ("running", 2))
            assert witness.pid("localization") == hot[waits]
            await eventually(lambda: witness.said[-1] == 2)
            assert witness.said == sorted(witness.said), "both spoke"
            hot = await spares(port, waits, other_than=hot)
            os.kill(witness.pid("localization"), signal.SIGKILL)
            os.kill(hot[waits], signal.SIGSTOP)
            respawn(witness, "localization", 2)
            await eventually(lambda: witness.state("localization") == ("running", 3))
            assert witness.pid("localization") != hot[waits]
            assert [which for which in witness.there if which[1]] == [(1, True), (2, True),
                                                                      (3, True)]
            await eventually(lambda: not Path(f"/proc/{hot[waits]}").exists())
        finally:
            witness.stop()
            await task


@pytest.mark.processes
async def test_a_spare_of_ones_own_is_silent_and_costs_nothing_but_itself(tmp_path):
    file = hot_system(tmp_path)
    file.write_text(file.read_text(encoding="utf-8").replace('"hot"', '"own"'), encoding="utf-8")
    async with launched(stub_plan(file)) as launcher:
        port, waits = launcher.plan.base_port, "spare.localization"
        witness = Listener(base.Context(
            "observer", 1, base.Clock(launcher.plan.origin_s), launcher.observers_bus()), launcher)
        task = asyncio.create_task(witness.run())
        try:
            await eventually(lambda: witness.state("localization") == ("running", 1), 20)
            own = await spares(port, waits)
            for hurt in HURTS:  # it is found out though nobody needs it
                os.kill(own[waits], hurt)
                own = await spares(port, waits, other_than=own)
            assert set(witness.said) == {1}
            for failed in (1, 2):  # RM3 decides at once, or when the spare is set up
                os.kill(witness.pid("localization"), signal.SIGKILL)
                await asyncio.sleep(0.2 * (failed - 1))
                assert witness.said[-1] == failed
                respawn(witness, "localization", failed)
                await eventually(
                    lambda f=failed: witness.state("localization") == ("running", f + 1))
                assert witness.pid("localization") == own[waits]
                await eventually(lambda f=failed: witness.said[-1] == f + 1)
                own = await spares(port, waits, other_than=own)
            assert witness.said == sorted(witness.said), "both spoke"
            for failed, hurt in enumerate(HURTS, 3):
                os.kill(witness.pid("localization"), signal.SIGKILL)
                os.kill(own[waits], hurt)
                respawn(witness, "localization", failed)
                await eventually(
                    lambda f=failed: witness.state("localization") == ("running", f + 1))
                assert witness.pid("localization") != own[waits]
                await eventually(lambda o=own: not Path(f"/proc/{o[waits]}").exists())
                own = await spares(port, waits, other_than=own)
            assert [number for number, there in witness.there if there] == [1, 2, 3, 4, 5, 6]
        finally:
            witness.stop()
            await task


@pytest.mark.processes
async def test_of_a_rehearsal_nothing_remains(tmp_path):
    async with base.running(tmp_path) as (launcher, _witness):
        await spares(launcher.plan.base_port, "spare_a", "spare_b")
        assert not list(Path(launcher.plan.folder).glob("rehearsal*"))


def spare_of(folder: Path, name: str) -> str:
    plan = stub_plan(folder / "stub.toml")
    return Layout(plan, load_system(plan)).spare_of((name,))


def test_a_spare_is_what_the_spec_says_and_the_class_allows(tmp_path, monkeypatch):
    hot_system(tmp_path)
    assert spare_of(tmp_path, "localization") == "hot"
    assert spare_of(tmp_path, "DM1") == "warm"
    assert spare_of(tmp_path, "supervisor") == "none"
    assert spare_of(tmp_path, "router_a") == "none"
    text = (tmp_path / "stub.toml").read_text()
    with monkeypatch.context() as changed:
        changed.setattr(TalkingPose, "most_spare", "warm")
        (tmp_path / "stub.toml").write_text(text.replace('spare = "hot"', 'spare = "own"'))
        assert spare_of(tmp_path, "localization") == "own"
        (tmp_path / "stub.toml").write_text(text)
    for most, allowed in (("none", "'none'"), ("warm", "'warm'")):
        monkeypatch.setattr(TalkingPose, "most_spare", most)
        with pytest.raises(ValueError, match=re.escape(
                f"stub.toml: node localization: spare = 'hot': TalkingPose allows {allowed} at "
                "most")):
            spare_of(tmp_path, "localization")
    (tmp_path / "stub.toml").write_text(text.replace('spare = "hot"', 'spare = "boiling"'))
    with pytest.raises(ValueError, match=r"spare.*'boiling'"):
        spare_of(tmp_path, "localization")


def test_a_hot_spare_may_not_touch_the_checkpoints_of_the_node(tmp_path):
    class Keeping(Actor):
        """Keeps its state."""

    actor = Keeping(base.Context(
        "a", 2, base.Clock(0.0), VirtualBus(Hub(), "a", 2), waits="hot"))
    with pytest.raises(RuntimeError, match="Keeping keeps checkpoints: its class has to say most"):
        actor.kept(None)


@pytest.mark.parametrize("what", ["socketpair", "fork"])
def test_a_spare_that_cannot_be_made_is_tried_again_and_ends_no_spawner(what, monkeypatch):
    module = {"socketpair": socket, "fork": os}[what]

    def fail(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(spare, "_PAUSE_S", 0.0)
    with selectors.DefaultSelector() as selector:
        spares = spare.Spares(1, selector, lambda _control: os._exit(0))
        with monkeypatch.context() as without:
            without.setattr(module, what, fail)
            assert [spares.look_after() for _ in range(2)] == [0.0, 0.0]
        assert not selector.get_map()
        spares.look_after()
        ((key, _),) = selector.select(5.0)
        key.data(key.fileobj)  # it has ended at once
        assert not selector.get_map()
    os.wait()


def test_a_spare_that_is_ended_after_it_was_seen_to_speak_ends_no_spawner():
    def speak(control: socket.socket) -> NoReturn:
        control.send(b"r")
        signal.pause()
        os._exit(0)

    with selectors.DefaultSelector() as selector:
        spares = spare.Spares(1, selector, speak)
        until_s = time.monotonic() + 10
        while not selector.get_map() and time.monotonic() < until_s:
            time.sleep(0.01)
            spares.look_after()
        events = selector.select(10)
        assert events
        spares.end()
        for key, _ in events:
            key.data(key.fileobj)
        with contextlib.suppress(ChildProcessError):
            os.wait()
