"""A tool that stays: it waits for a run, sees its end, and goes on with the next. No processes."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal

import msgspec
import pytest

from rampart.actors.bus.run_info import RunInfo
from rampart.cli import session
from rampart.cli.output import UsageError

RUN = RunInfo(os.getpid(), 7450, 1.0, 0.0, "paper.toml", "", (), "first", 0, "AB")


def run(name: str, port: int = 7450) -> RunInfo:
    return msgspec.structs.replace(RUN, run_id=name, base_port=port)


@pytest.fixture
def runs(monkeypatch) -> list[RunInfo]:
    """The runs of this machine, as `sessions` finds and joins them."""
    there: list[RunInfo] = []

    @contextlib.asynccontextmanager
    async def connect(port):
        found = [r for r in there if port in {None, r.base_port}]
        if len(found) != 1:
            raise UsageError("no run found" if not found else "several runs, choose with --port")
        yield found[0]

    monkeypatch.setattr(session, "find_runs", lambda: list(there))
    monkeypatch.setattr(session, "connect", connect)
    monkeypatch.setattr(session, "LOOK_S", 0.001)
    return there


async def test_a_run_is_waited_for_and_the_next_one_follows_until_the_user_has_had_enough(runs):
    stop, names = asyncio.Event(), []

    async def follow() -> None:
        async for joined in session.sessions(8000, stop):
            names.append(joined.run_id)
            runs[:] = [run("other", 9000)]

    following_runs = asyncio.create_task(follow())
    for name in ("first", "second"):
        await asyncio.sleep(0.02)
        runs.append(run(name, 8000))
        async with asyncio.timeout(10):
            while name not in names:
                await asyncio.sleep(0.001)
    stop.set()
    async with asyncio.timeout(10):
        await following_runs
    assert names == ["first", "second"]


async def test_several_runs_are_a_choice_for_the_user_by_the_verbs_own_option(runs):
    runs += [run("one", 8000), run("other", 9000)]
    with pytest.raises(UsageError, match="choose with --run"):
        async for _ in session.sessions(None, asyncio.Event()):
            pass


@pytest.mark.parametrize("nohup", [False, True])
async def test_a_closed_terminal_ends_it_but_under_nohup(nohup):
    stop = asyncio.Event()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    try:
        with session.stopped_by_signals(stop):
            os.kill(os.getpid(), signal.SIGHUP)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), 0.1 if nohup else 10)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert stop.is_set() != nohup


def test_a_run_is_over_when_its_launcher_is():
    assert not session.is_over(RUN)
    assert session.is_over(msgspec.structs.replace(RUN, pid=2**22 + 1))
