"""Asking spawners: what they answer is not believed blindly, and no process appears twice.

The test is the spawner here: it answers when the client has gone on already, or too late.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise

import msgspec
import pytest

from rampart.actors.machine import unix_peer
from rampart.actors.supervision import spawner_client
from rampart.actors.supervision.spawner import (
    MAX_DATAGRAM,
    NAMES,
    ForkRequest,
    Ping,
    Reply,
    Request,
    address,
)
from rampart.actors.supervision.spawner_client import (
    SpawnerBusyError,
    SpawnerClient,
    SpawnerUnavailableError,
)
from rampart.testing import free_base_port
from tests import ROOT

DM1 = ("DM1",)

_CHILD = """
import socket, sys, time
from rampart.actors.supervision.process_title import set_title
port, launcher, name, incarnation, fd = sys.argv[1:]
set_title(int(port), int(launcher), (name,), int(incarnation))
socket.socket(fileno=int(fd)).send(b"{}")
time.sleep(60)
"""


class FakeSpawner:
    """Listens under a spawner's name, and does what the test says."""

    def __init__(self, folder: str, port: int, name: str) -> None:
        self._port = port
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(address(folder, name))
        self._listener.listen()
        self._listener.settimeout(10)
        self.connections: list[socket.socket] = []
        self.children: list[subprocess.Popen[bytes]] = []

    def take(self) -> tuple[socket.socket, Request]:
        """Accept a request."""
        connection, _ = self._listener.accept()
        self.connections.append(connection)
        return connection, msgspec.json.decode(connection.recv(MAX_DATAGRAM), type=Request)

    def answer(self, data: bytes) -> Request:
        """Take a request and answer it oneself."""
        connection, request = self.take()
        connection.send(data)
        connection.close()
        return request

    def fork(self, name: str = "DM1", incarnation: int = 2, launcher: int | None = None) -> int:
        """Take a request and have a process of its own answer it, under this title."""
        connection, _ = self.take()
        child = subprocess.Popen(
            [sys.executable, "-c", _CHILD, str(self._port), str(launcher or os.getpid()), name,
             str(incarnation), str(connection.fileno())],
            pass_fds=[connection.fileno()], env={**os.environ, "PYTHONPATH": str(ROOT)})
        self.children.append(child)
        connection.close()
        return child.pid

    def close(self) -> None:
        for connection in (self._listener, *self.connections):
            connection.close()
        for child in self.children:
            child.kill()
            child.wait()


class Stage:
    def __init__(self, folder: str, names: str) -> None:
        self.folder = folder
        port = free_base_port()
        self.spawners = {name: FakeSpawner(folder, port, name) for name in names}
        self.client = SpawnerClient(folder, port, os.getpid())

    def fork(self, incarnation: int = 2) -> int:
        return self.client.fork(DM1, incarnation)

    def until_answered(self) -> int:
        """Ask again and again, as the supervisor does."""
        while True:
            try:
                return self.fork()
            except SpawnerBusyError:
                continue

    def close(self) -> None:
        self.client.close()
        for spawner in self.spawners.values():
            spawner.close()


@pytest.fixture
def staged(monkeypatch, sockets) -> Iterator[Callable[[str], Stage]]:
    stages: list[Stage] = []

    def stage(names: str = "ab", patience_s: float = 60.0) -> Stage:
        monkeypatch.setattr(spawner_client, "WAIT_S", 0.0)
        monkeypatch.setattr(spawner_client, "PATIENCE_S", patience_s)
        stages.append(Stage(sockets, names))
        return stages[-1]

    yield stage
    for one in stages:
        one.close()


def test_a_process_that_is_forked_while_the_client_goes_on_is_found_when_it_asks_again(staged):
    stage = staged("a")
    with pytest.raises(SpawnerBusyError):
        stage.fork()
    with pytest.raises(SpawnerBusyError):
        stage.fork()
    child = stage.spawners["a"].fork()
    assert stage.until_answered() == child


@pytest.mark.parametrize(("data", "why"), [
    *((data, "its answer makes no sense") for data in (
        b"nonsense", b"[]", b"\xff", b'{"error": 5}', b"[" * 100_000,
        b'{"error": "' + b"x" * (MAX_DATAGRAM + 10))),
    (b"{}", "a stranger answers"),  # this test: no process of the run
    (b'{"sender": 1}', "a stranger answers"), (b'{"error": "no"}', "no"), (b"", "no answer")])
def test_an_answer_that_is_none_is_an_error_and_no_process(staged, data, why):
    stage = staged("a")
    with pytest.raises(SpawnerBusyError):
        stage.fork()
    stage.spawners["a"].answer(data)
    with pytest.raises(SpawnerUnavailableError, match=f"spawner_a: {why}"):
        stage.fork()
    assert not stage.client.turns("a")
    stage.spawners["a"].answer(data)
    stage.client.turns("a")  # raises nothing
    with pytest.raises(SpawnerBusyError):  # and it is asked again
        stage.fork()


@pytest.mark.parametrize("title", [
    {"launcher": 1}, {"name": "DM2"}, {"incarnation": 3}], ids=str)
def test_a_process_with_another_title_is_not_the_one_that_was_asked_for(staged, title):
    stage = staged("a")
    with pytest.raises(SpawnerBusyError):
        stage.fork()
    stage.spawners["a"].fork(**title)
    with pytest.raises(SpawnerUnavailableError, match="a stranger answers"):
        stage.until_answered()


def test_a_spawner_of_another_user_is_asked_for_nothing(staged, monkeypatch):
    stage = staged("ab")
    monkeypatch.setattr(unix_peer.os, "getuid", lambda: 4711)
    with pytest.raises(SpawnerUnavailableError, match="spawner_a: its name is taken by another "
                       "user; spawner_b: its name is taken by another user"):
        stage.fork()
    assert not stage.client.turns("a")
    monkeypatch.undo()
    with stage.spawners["a"]._listener.accept()[0] as connection:
        assert connection.recv(10) == b""


def test_who_does_not_answer_at_once_is_passed_over_until_the_other_one_does_not_either(staged):
    stage = staged("ab")
    with pytest.raises(SpawnerBusyError, match="spawner_b"):
        stage.fork()
    withdrawn, request = stage.spawners["a"].take()
    assert request == ForkRequest(DM1, 2)
    with pytest.raises(BrokenPipeError):  # its child learns that nobody waits for it
        withdrawn.send(b"{}")
    child = stage.spawners["b"].fork()
    assert stage.until_answered() == child
    with pytest.raises(SpawnerBusyError, match="spawner_b"):  # who answered is asked first
        stage.fork()


def test_a_request_that_is_not_answered_for_long_moves_on_and_is_answered_once(staged):
    stage = staged("ab", patience_s=0.0)
    with pytest.raises(SpawnerUnavailableError, match="spawner_b: no answer yet"):
        stage.fork()
    stage.spawners["a"].take()
    with pytest.raises(SpawnerUnavailableError, match="spawner_a: no answer yet"):
        stage.fork()
    late, _ = stage.spawners["b"].take()
    with pytest.raises(BrokenPipeError):
        late.send(b"{}")
    stage.client._forks[DM1][1].patience_s = 60.0
    child = stage.spawners["a"].fork()
    assert stage.until_answered() == child


def test_a_request_stays_longer_each_time_so_that_a_busy_machine_answers_some_time(
        staged, monkeypatch):
    stage, now_s, asked = staged("ab", patience_s=0.25), [0.0], []
    monkeypatch.setattr(spawner_client.time, "monotonic", lambda: now_s[0])
    for _ in range(1000):
        with pytest.raises(SpawnerUnavailableError):
            stage.fork()
        here = stage.client._forks[DM1][1]
        if not asked or asked[-1][1] is not here:
            asked.append((now_s[0], here))
        now_s[0] += 0.01
    stays_s = [after[0] - before[0] for before, after in pairwise(asked)]
    assert stays_s == pytest.approx([0.25, 0.5, 1.0, 2.0, 4.0], abs=0.03)


def test_an_answer_that_came_before_the_request_was_withdrawn_counts(staged, monkeypatch):
    stage = staged("ab")
    with pytest.raises(SpawnerBusyError):
        stage.fork()
    child = stage.spawners["b"].fork()
    asked = stage.client._forks[DM1][1]
    assert asked.reply(20.0) == Reply("", child)
    monkeypatch.setattr(spawner_client, "PATIENCE_S", 0.0)
    assert stage.fork() == child


def test_a_process_that_nobody_wants_any_more_is_killed(staged):
    stage = staged("a")
    with pytest.raises(SpawnerBusyError):
        stage.fork(2)
    child = stage.spawners["a"].fork()
    assert stage.client._forks[DM1][1].reply(20.0) == Reply("", child)
    with pytest.raises(SpawnerBusyError):
        stage.fork(3)
    assert stage.spawners["a"].children[0].wait(10) == -9


@pytest.mark.parametrize("is_late", [False, True])
def test_one_that_is_withdrawn_is_ended_whether_it_has_answered_or_not(staged, is_late):
    stage = staged("a")
    with pytest.raises(SpawnerBusyError):
        stage.fork(2)
    if is_late:
        stage.client.withdraw(DM1)
        with pytest.raises(OSError, match="pipe"):
            stage.spawners["a"].answer(b"{}")  # as its child does, which then ends
    else:
        child = stage.spawners["a"].fork()
        assert stage.client._forks[DM1][1].reply(20.0) == Reply("", child)
        stage.client.withdraw(DM1)
        assert stage.spawners["a"].children[0].wait(10) == -9
    assert not stage.client._forks


def test_a_spawner_that_hangs_is_pinged_once_however_often_it_is_asked_about(staged):
    stage = staged("a")
    for _ in range(5):
        assert not stage.client.turns("a")
    assert not stage.client.turns("b")  # not there at all
    assert stage.spawners["a"].answer(b"{}") == Ping()
    assert stage.client.turns("a")
    assert not stage.client.turns("a")
    stage.spawners["a"].answer(b"{}")


def test_no_call_waits_for_one_who_does_not_even_accept(staged):
    stage = staged("ab")
    for spawner in stage.spawners.values():
        spawner._listener.listen(0)
    fillers = []
    for name in NAMES:
        for _ in range(2):
            filler = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            filler.setblocking(False)
            fillers.append(filler)
            filler.connect_ex(address(stage.folder, name))
    with pytest.raises(SpawnerUnavailableError, match=r"spawner_a: not there .*; spawner_b: not"):
        stage.fork()
    for filler in fillers:
        filler.close()
