"""A tool that stays: it waits for a run, sees its end, and goes on with the next. No processes."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal

import msgspec
import pytest

from rampart.actors.bus.run_info import RunInfo
from rampart.cli import following
from rampart.cli.output import UsageError

RUN = RunInfo(os.getpid(), 7450, 1.0, 0.0, "paper.toml", "", (), "first", 0, "AB")


class Machine:
    """The runs there are, as `sessions` finds and joins them."""

    def __init__(self, monkeypatch) -> None:
        self.runs: list[RunInfo] = []
        self.left: list[str] = []
        monkeypatch.setattr(following, "find_runs", lambda: list(self.runs))
        monkeypatch.setattr(following, "connect", self._connect)
        monkeypatch.setattr(following, "LOOK_S", 0.001)

    @contextlib.asynccontextmanager
    async def _connect(self, port):
        found = [r for r in self.runs if port in {None, r.base_port}]
        if len(found) != 1:
            raise UsageError("no run found" if not found else "several runs, choose with --port")
        try:
            yield found[0]
        finally:
            self.left.append(found[0].run_id)


@pytest.fixture
def machine(monkeypatch):
    return Machine(monkeypatch)


def run(name: str, port: int = 7450) -> RunInfo:
    return msgspec.structs.replace(RUN, run_id=name, base_port=port)


async def seen(machine: Machine, stop: asyncio.Event, ends: dict[str, list[RunInfo]],
               port: int | None = None) -> list[str]:
    """Follow; at the end of each run those in `ends` are there, and after the last we stop."""
    names = []
    async with contextlib.aclosing(following.sessions(port, stop, follow=True)) as found:
        async for session in found:
            names.append(session.run_id)
            machine.runs = ends[session.run_id]
            if not machine.runs:
                stop.set()
    return names


async def test_one_run_follows_the_other_and_each_is_left(machine):
    machine.runs = [run("first")]
    ends = {"first": [run("second", 8000)], "second": []}
    assert await seen(machine, asyncio.Event(), ends) == ["first", "second"]
    assert machine.left == ["first", "second"]


async def test_a_run_that_is_not_there_yet_is_waited_for(machine):
    waiting = asyncio.create_task(seen(machine, asyncio.Event(), {"late": []}))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    machine.runs = [run("late")]
    async with asyncio.timeout(10):
        assert await waiting == ["late"]


async def test_with_a_port_only_runs_on_it_are_followed(machine):
    machine.runs = [run("other", 9000), run("mine", 8000)]
    assert await seen(machine, asyncio.Event(), {"mine": []}, port=8000) == ["mine"]


async def test_waiting_ends_when_the_user_has_had_enough(machine):
    stop = asyncio.Event()
    waiting = asyncio.create_task(seen(machine, stop, {}))
    await asyncio.sleep(0.01)
    stop.set()
    async with asyncio.timeout(10):
        assert await waiting == []


async def test_several_runs_are_a_choice_for_the_user_by_the_verbs_own_option(machine):
    machine.runs = [run("one", 8000), run("other", 9000)]
    with pytest.raises(UsageError, match="choose with --run"):
        async for _ in following.sessions(None, asyncio.Event(), follow=True, option="--run"):
            pass


async def test_without_following_no_run_is_an_error_and_one_is_enough(machine):
    with pytest.raises(UsageError, match="no run found"):
        async for _ in following.sessions(None, asyncio.Event(), follow=False):
            pass
    machine.runs = [run("first")]
    names = [s.run_id async for s in following.sessions(None, asyncio.Event(), follow=False)]
    assert names == ["first"]


@pytest.mark.parametrize("nohup", [False, True])
async def test_a_closed_terminal_ends_it_but_under_nohup(nohup):
    stop = asyncio.Event()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    try:
        with following.stopped_by_signals(stop):
            os.kill(os.getpid(), signal.SIGHUP)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), 0.1 if nohup else 10)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert stop.is_set() != nohup


def test_a_run_is_over_when_its_launcher_is():
    assert not following.is_over(RUN)
    assert following.is_over(msgspec.structs.replace(RUN, pid=2**22 + 1))
