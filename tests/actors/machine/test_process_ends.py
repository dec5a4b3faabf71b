"""The end of a process is known at once by its mark, and all the same without one."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rampart.actors.machine import process_ends
from rampart.actors.machine.process_ends import LocalProcess, Marks, ProcessEnds, leave_marks
from rampart.actors.machine.unix_peer import process_id
from rampart.testing import eventually

pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")

MEMORY = 1 << 28
"""So much is taken apart when it ends that it shows."""


@pytest.fixture
def forked() -> Iterator[Callable[..., LocalProcess]]:
    """Returns a process that does nothing but have a mark, and memory; killed at the end."""
    pids: list[int] = []

    def fork(*marks: Path, memory: int = 1) -> LocalProcess:
        ready, tell = os.pipe()
        pid = os.fork()
        if pid == 0:
            with contextlib.suppress(BaseException):
                held = bytearray(memory)
                held[::4096] = b"x" * len(held[::4096])
                if marks:
                    leave_marks(list(map(str, marks)))
                os.write(tell, b"x")
                while True:
                    signal.pause()
            os._exit(1)
        pids.append(pid)
        os.close(tell)
        assert os.read(ready, 1) == b"x"
        os.close(ready)
        found = process_id(pid)
        assert found is not None
        return LocalProcess(found, str(marks[0]) if marks else "")

    yield fork
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


async def test_an_end_is_told_once_and_long_before_the_process_is_gone(tmp_path, forked):
    ratios = []
    for number in range(5):
        process = forked(tmp_path / f"{number}", memory=MEMORY)
        told: list[float] = []
        ends = ProcessEnds()
        ends.hold("it", process, lambda told=told: told.append(time.monotonic()))
        gone = os.pidfd_open(process.id.pid)
        was_gone = asyncio.Event()
        asyncio.get_running_loop().add_reader(gone, was_gone.set)
        began_s = time.monotonic()
        os.kill(process.id.pid, signal.SIGKILL)
        await asyncio.wait_for(was_gone.wait(), 5)
        gone_s = time.monotonic()
        asyncio.get_running_loop().remove_reader(gone)
        os.close(gone)
        await eventually(lambda told=told: bool(told))
        await asyncio.sleep(0.01)
        assert len(told) == 1
        ratios.append((told[0] - began_s) / (gone_s - began_s))
        ends.close()
    assert sorted(ratios)[2] < 0.5, ratios


@pytest.mark.parametrize("what", ["none", "another's", "no file", "a short file"])
async def test_without_a_mark_of_its_own_it_is_told_by_the_kernel_all_the_same(
        tmp_path, forked, what):
    process = forked()
    mark = tmp_path / "mark"
    if what == "another's":
        mark = Path(forked(mark).mark)
    elif what == "a short file":
        mark.write_bytes(b"x")
    told: list[str] = []
    ends = ProcessEnds()
    ends.hold("it", LocalProcess(process.id, "" if what == "none" else str(mark)),
              lambda: told.append("it"))
    await asyncio.sleep(0.02)
    assert told == []
    os.kill(process.id.pid, signal.SIGKILL)
    await eventually(lambda: told == ["it"])
    ends.close()


async def test_all_who_watch_are_told_and_of_more_than_one_call_can_wait_for(tmp_path, forked):
    processes = [forked(tmp_path / f"{number}") for number in range(140)]
    told: list[tuple[int, int]] = []
    watchers = [ProcessEnds() for _ in range(3)]
    for which, ends in enumerate(watchers):
        for number, process in enumerate(processes):
            ends.hold(number, process, lambda pair=(which, number): told.append(pair))
    for process in processes[::-1]:
        os.kill(process.id.pid, signal.SIGKILL)
    await eventually(lambda: len(told) == 3 * 140)
    assert len(set(told)) == 3 * 140
    for ends in watchers:
        ends.close()


async def test_one_that_is_let_go_is_not_told_of_and_another_of_its_name_is(tmp_path, forked):
    first, second = forked(tmp_path / "1"), forked(tmp_path / "2")
    told: list[int] = []
    ends = ProcessEnds()
    ends.hold("it", first, lambda: told.append(1))
    ends.let_go("it")
    ends.hold("it", second, lambda: told.append(2))
    os.kill(first.id.pid, signal.SIGKILL)
    await asyncio.sleep(0.05)
    assert told == []
    os.kill(second.id.pid, signal.SIGKILL)
    await eventually(lambda: told == [2])
    ends.close()


async def test_a_mark_has_all_names_and_the_next_process_takes_them_over(tmp_path, forked):
    names = [tmp_path / "DM1", tmp_path / "DM2"]
    forked(*names)
    second = forked(*names)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["DM1", "DM2"], "nothing is left over"
    marks, told = Marks(), []
    for name in names:
        marks.watch(name, LocalProcess(second.id, str(name)), lambda n=name: told.append(n))
    os.kill(second.id.pid, signal.SIGKILL)
    await eventually(lambda: sorted(told) == names)
    marks.close()


def test_without_room_there_is_no_mark_and_no_harm(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(process_ends.os, "posix_fallocate", full)
    leave_marks([str(tmp_path / "DM1")])
    leave_marks([str(tmp_path / "no folder" / "DM1")])
    assert list(tmp_path.iterdir()) == []


async def test_on_a_kernel_without_the_call_the_pidfd_tells(tmp_path, forked, monkeypatch):
    monkeypatch.setattr(process_ends, "_FUTEX_WAITV", 100_000)
    process, told = forked(tmp_path / "mark"), []
    ends = ProcessEnds()
    ends.hold("it", process, lambda: told.append("it"))
    os.kill(process.id.pid, signal.SIGKILL)
    await eventually(lambda: told == ["it"])
    ends.close()
