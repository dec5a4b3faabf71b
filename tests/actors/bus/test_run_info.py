"""How tools find runs, whatever else is on the machine."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import msgspec
import pytest

from rampart.actors.bus import run_info
from rampart.testing import free_base_port


@contextmanager
def answering(answer: bytes) -> Iterator[int]:
    """Stand for a launcher that answers once; yields its base port."""
    port = free_base_port()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as launcher:
        launcher.bind(run_info.address(port))
        launcher.listen()

        def tell() -> None:
            connection, _ = launcher.accept()
            with connection, contextlib.suppress(OSError):  # who asks need not wait
                connection.send(answer)

        teller = threading.Thread(target=tell)
        teller.start()
        yield port
        teller.join()


INFO = run_info.RunInfo(1, 7450, 1.0, 0.0, "x.toml", "", (), "r", 0, "a run")


def test_a_socket_of_another_user_is_not_a_launcher(monkeypatch):
    monkeypatch.setattr(run_info, "is_same_user", lambda _connection: False)
    with answering(msgspec.json.encode(INFO)) as port:
        assert run_info.ask(port) is None


@pytest.mark.parametrize("answer", [b"nothing", b"{}", b'{"title": "\xff"}'])
def test_an_invalid_answer_is_not_a_run(answer):
    with answering(answer) as port:
        assert run_info.ask(port) is None


def test_a_socket_whose_name_is_not_utf_8_is_ignored():
    with (answering(msgspec.json.encode(INFO)) as port,
          socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger):
        stranger.bind(b"\0caf\xe9." + str(os.getpid()).encode())
        assert INFO in run_info.find_runs(), port


def test_a_base_whose_launcher_s_name_is_taken_is_not_free(monkeypatch):
    free, other = free_base_port(), free_base_port()
    monkeypatch.setattr("rampart.testing.ports._BASES", iter((free, other)))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as launcher:
        launcher.bind(run_info.address(free))
        assert free_base_port() == other
