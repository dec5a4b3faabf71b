"""`kill-node --list`: what is shown of other hosts, and what is said when they are not heard."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
from contextlib import asynccontextmanager, contextmanager

import pytest

from rampart.actors.bus import run_info
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable
from rampart.actors.supervision.process_title import RunProcess
from rampart.cli.operate import kill_node
from rampart.testing.ports import free_base_port

HOSTS = {"robot": "supervisor", "ground": "supervisor_ground", "moon": "supervisor_moon"}
RUN = RunInfo(1, 7450, 1.0, 0.0, "x.toml", "/nowhere", ("camera",), "r", 0, "t", hosts=HOSTS)


def row(name: str, pid: int, state: NodeState = NodeState.RUNNING, incarnation: int = 1,
        host: str = "ground") -> NodeInfo:
    return NodeInfo(name, "control", pid, state, incarnation, 0, host=host)


class Tables:
    """A session in which the supervisors of some hosts publish their tables."""

    def __init__(self, tables: dict[str, NodeTable]) -> None:
        self.tables = tables

    def listen(self, _topic, heard) -> None:
        for supervisor, table in self.tables.items():
            heard("", Header(supervisor, 1, 1, 0.0), table)

    def real_s(self, _simulated_s: float) -> float:
        return 0.05


@pytest.fixture
def bus(monkeypatch):
    """Return a function that says which tables arrive."""
    def has(**tables: NodeTable) -> None:
        @asynccontextmanager
        async def connect(_port):
            yield Tables(tables)

        monkeypatch.setattr(kill_node, "connect", connect)

    return has


def test_processes_of_other_hosts_are_those_that_their_supervisors_publish(bus):
    bus(supervisor_ground=NodeTable((
            row("camera", 11), row("hmi", 0, NodeState.UNREACHABLE),
            row("DM1", 12, NodeState.CRASHED), row("DM2", 13, NodeState.WEDGED, 4))),
        supervisor_moon=NodeTable((row("drill", 14, host="moon"),)))
    rows, missing = asyncio.run(kill_node._other_hosts(RUN))
    assert missing == ""
    assert [(one["host"], one["name"], one["pid"], one["incarnation"]) for one in rows] == [
        ("ground", "camera", 11, 1), ("ground", "DM2", 13, 4), ("moon", "drill", 14, 1)]


def test_a_host_whose_table_does_not_arrive_is_named(bus):
    bus(supervisor_moon=NodeTable(()))
    _, missing = asyncio.run(kill_node._other_hosts(RUN))
    assert missing.startswith("the processes of ground are missing: ")


@pytest.fixture
def here(monkeypatch):
    """Return a function that says what the run on port 7450 has on other hosts."""
    monkeypatch.setattr(kill_node, "find_processes", lambda _port: [
        RunProcess(21, 7450, 20, ("pilot",), 3), RunProcess(31, 7460, 30, ("a", "b"), 1)])
    monkeypatch.setattr(kill_node, "find_runs", list)

    def has(*rows, missing: str = "") -> None:
        async def found(_run: RunInfo):
            return list(rows), missing

        monkeypatch.setattr(kill_node, "find_runs", lambda: [RUN])
        monkeypatch.setattr(kill_node, "_other_hosts", found)

    return has


def test_only_with_several_hosts_each_process_has_its_host(here, capsys):
    assert kill_node.main(["--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0] == {
        "name": "pilot", "pid": 21, "incarnation": 3, "port": 7450}
    here({"host": "ground", "name": "hmi", "pid": 12, "incarnation": 1, "port": 7450})
    assert kill_node.main(["--list", "--json"]) == 0
    assert [(one["name"], one.get("host")) for one in json.loads(capsys.readouterr().out)] == [
        ("pilot", "robot"), ("a", None), ("b", None), ("hmi", "ground")]


def test_what_is_missing_is_told_in_a_line_beside_the_list_of_this_machine(here, capsys):
    here(missing="no\nground")
    assert kill_node.main(["--list"]) == 0
    told = capsys.readouterr()
    assert told.out == ("  7450       21 #3    robot pilot\n  7460       31 #1          a\n"
                        "  7460       31 #1          b\n")
    assert told.err == "kill-node: no ground\n"


@contextmanager
def launcher(info: RunInfo):
    """Answer tools as a launcher does, of a run whose bus is not there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(run_info.address(info.base_port))
        listener.listen(8)
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                run_info.answer(listener, info)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            over.set()
            run_info.ask(info.base_port)
            thread.join()


def test_without_a_bus_the_others_are_not_waited_for_long(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(kill_node, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(kill_node, "_LISTED_S", 0.1)
    port = free_base_port()
    info = RunInfo(os.getpid(), port, 1.0, 0.0, "x.toml", str(tmp_path), (), "r", 0, "t",
                   hosts=HOSTS)
    with launcher(info):
        assert kill_node.main(["--list", "--port", str(port)]) == 0
    assert capsys.readouterr().err == (
        "kill-node: the processes of ground and moon are missing: no message arrived\n")
