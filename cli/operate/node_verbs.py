"""`rampart status`, `node`, `top` and `reset`, and the old verb `trigger`.

Show the nodes of the run.

Examples:
  rampart node list
  rampart node list --json
  rampart node log NODE
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from collections import deque
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.run_info import RunInfo, find_run
from rampart.actors.bus.topic import Topic
from rampart.actors.foreign.program import LOGS
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ros2.ros_nodes import GRAPH, RosGraphReport
from rampart.actors.ros2.translation.tables import GATEWAY
from rampart.cli import completion, systems
from rampart.cli.output import (
    NoEffectError,
    between,
    positive,
    print_json,
    print_rows,
    say,
    unknown,
)
from rampart.cli.robot_lines import RobotLines
from rampart.cli.run_picture import manager_in_words
from rampart.cli.session import Latest, Session, connect, first_to_expire, pause, stopped_by_signals
from rampart.cli.verbs import JSON, PORT, add_family, add_verb, flag, option, whole
from rampart.files.plain_text import printable
from rampart.manager.spec.clearing import clearing_in_words

MOST_LINES = 1_000_000
_WAIT_S = 1.5
"""Simulated seconds to collect states; the slowest is published twice a second."""


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    add_verb(verbs, "status", "show robot, manager and nodes in a few lines", status, PORT, JSON)
    node = add_family(verbs, "node", "show the nodes of the run", __doc__)
    add_verb(node, "list", "list all nodes", node_list, PORT, JSON)
    add_verb(node, "log", "print the output of a node's command", node_log, PORT,
             option("name", metavar="NODE", help="a node with a command",
                    completer=completion.nodes),
             whole("--lines", "N", "print the last N lines (default: 50)", 50))
    add_verb(verbs, "top", "watch processes, topics and decisions", top, PORT,
             flag("--once", "print one picture and end"),
             flag("--json", "print one picture as JSON and end"))
    add_verb(verbs, "reset", "release a latched recovery", reset, PORT,
             option("recovery", metavar="NAME",
                    help="a recovery module, for example RM1, or another holder"))
    add_verb(verbs, "trigger", "", trigger, PORT,
             option("module", metavar="NAME", help="detection module, e.g. D_LEVEL"),
             option("--for", dest="duration", type=float, default=2.0, metavar="S",
                    help="simulated seconds (default 2)"), hidden=True)


async def node_list(options: argparse.Namespace) -> int:
    """Print the supervisor's table.

    List each node with kind, process id, state, incarnation and number of restarts.

    Examples:
      rampart node list
      kill -9 $(rampart node list --json | python3 -c 'import json,sys; \
print(next(n["pid"] for n in json.load(sys.stdin) if n["name"] == "localization"))')
    """
    async with connect(options.port) as session:
        found = await session.latest((ftm_topics.NODES,), session.real_s(_WAIT_S) + 1.0)
    if not found:
        raise NoEffectError("the supervisor does not answer; it may just be restarting, try again")
    table: fm.NodeTable = found[ftm_topics.NODES.key]
    rare = {"host", "failing", "next_attempt_s"}
    fields = [name for name in fm.NodeInfo.__struct_fields__
              if name not in rare or any(getattr(node, name) for node in table.nodes)]
    rows = [[getattr(node, name) for name in fields] for node in table.nodes]
    print_rows(fields, rows, table.nodes, as_json=options.json)
    return 0


def node_log(options: argparse.Namespace) -> int:
    """Print the output of a command.

    Print the output of a node that is a command, over all its incarnations.
    Lines that begin with --- come from the process that runs the command.

    Examples:
      rampart node log estimator
      rampart node log estimator --lines 1000 | less
    """
    between("--lines", options.lines, 0, MOST_LINES)
    run = find_run(options.port)
    folder = Path(run.folder, LOGS)
    if options.name not in run.nodes:
        raise unknown("node", options.name, run.nodes)
    file = folder / f"{options.name}.log"
    if not file.is_file():
        logs = sorted(log.stem for log in folder.glob("*.log"))
        raise NoEffectError(f"{options.name}: no command, or its output is not kept; nodes with "
                            f"output: {', '.join(logs) or 'none'}")
    for line in last_lines(file, options.lines):
        print(printable(line.decode(errors="replace").rstrip("\r\n"), keep="\t"), flush=True)
    return 0


def last_lines(file: Path, count: int) -> deque[bytes]:
    """Return the last lines of a log, whose previous part is `FILE.1`."""
    lines: deque[bytes] = deque(maxlen=count)
    for part in (file.with_name(f"{file.name}.1"), file):
        with contextlib.suppress(FileNotFoundError), part.open("rb") as opened:
            lines.extend(opened)
    return lines


async def status(options: argparse.Namespace) -> int:
    """Print the state of the run.

    Show the robot, the FTM Manager and the nodes of the run. Parts of the system
    that do not answer are shown as silent.

    Examples:
      rampart status
      rampart status --json
    """
    async with connect(options.port) as session:
        run, held = session.run, Holdings(session)
        lines, has_gateway, clearing = _lines(session.run)
        wanted = (*lines.status_read, ftm_topics.MANAGER_STATUS, ftm_topics.NODES,
                  *[GRAPH] * has_gateway)
        found, _ = await asyncio.gather(
            session.latest(wanted, session.real_s(_WAIT_S)), held.settle())
        time_s = session.clock.now()

    def latest(topic: Topic[Any]) -> Any:
        return found.get(topic.key)

    manager: fm.ManagerStatus | None = found.get(ftm_topics.MANAGER_STATUS.key)
    nodes: fm.NodeTable | None = found.get(ftm_topics.NODES.key)
    graph: RosGraphReport | None = found.get(GRAPH.key)
    if options.json:
        print_json({
            "run_id": run.run_id, "title": run.title, "port": run.base_port, "pid": run.pid,
            "rate": run.rate, "system": run.system_file, "time_s": round(time_s, 3),
            **lines.status_data(latest), "manager": manager, "holders": held.holders,
            "nodes": nodes.nodes if nodes else None, **({"ros2": graph} if has_gateway else {}),
            **({"keys": left} if (left := first_to_expire(run)) else {}),
            "recording": run.recording_data()})
        return 0
    page = f", page {run.page}" if run.page else ""
    say(f"run       {run.title} (port {run.base_port}, pid {run.pid})")
    say(f"time      {time_s:.1f} s at rate {run.rate:g}{page}")
    kinds = {n.kind for n in nodes.nodes} if nodes else {"pilot", "manager"}
    for label, text in lines.status(latest, run.plan, kinds):
        say(f"{label:<9} {text}")
    if manager is not None or "manager" in kinds:
        say(f"manager   {manager_in_words(manager)}")
    for name in (*manager.active, *manager.latched) if manager else ():
        if words := clearing.get(name):
            say(f"clearing  {name} {words}")
    for name, what in held.holders.items():
        say(f"held      {' and '.join(what)} by {name}, not a recovery module of this system; "
            f"rampart reset {name} releases it")
    if has_gateway:
        say(f"ros2      {_in_ros2(graph)}")
    if left := first_to_expire(run):
        say(f"keys      {max(left['days_left'], 0)} days left: {left['name']} expires first, at "
            f"{left['not_after'][:16].replace('T', ' ')} UTC")
    if run.recording:
        say(f"recording {run.recording_in_words}")
    say(f"nodes     {_nodes(nodes, time_s, run.rate)}")
    return 0


def top(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Show the run.

    Show the robot, mechanisms, decisions, processes and topic rates of the run,
    four times a second. q or Ctrl-C quits. Processor time is in percent of one
    core. Memory is resident memory, most of which is shared.

    Examples:
      rampart top
      rampart top --once | less
      NO_COLOR=1 rampart top
      rampart top --json | python3 -m json.tool
    """
    from rampart.cli.look import top  # noqa: PLC0415 its import would slow other verbs

    return top.top(options)


def _lines(run: RunInfo) -> tuple[RobotLines, bool, dict[str, str]]:
    """Return the lines of the robot, whether it has a gateway to ROS 2, and what clears how."""
    try:
        spec = systems.load(run.system_file)
        return (systems.lines_of(spec), any(node.actor == GATEWAY for node in spec.nodes),
                clearing_in_words(spec))
    except ValueError:  # for example a run from another folder: show the engine's lines
        return RobotLines(), False, {}


def _in_ros2(graph: RosGraphReport | None) -> str:
    if graph is None:
        return "silent (gateway)"
    problems = f"; {graph.problems[0]}" if graph.problems else ""
    return (f"{'linked' if graph.linked else 'no router'}, {len(graph.nodes)} nodes, "
            f"{graph.refused} messages refused{problems}")


def _nodes(table: fm.NodeTable | None, time_s: float, rate: float) -> str:
    if table is None:
        return "silent (supervisor)"
    bad = [f"{n.name} {n.state.value}" + (
        f" (next attempt in {max(0.0, n.next_attempt_s - time_s) / rate:.0f} s)"
        if n.next_attempt_s else "")
        for n in table.nodes if n.state is not fm.NodeState.RUNNING]
    restarts = sum(n.restarts for n in table.nodes)
    text = f"{len(table.nodes) - len(bad)} of {len(table.nodes)} running, {restarts} restarts"
    bad += [f"{n.name} is unstable" for n in table.nodes if n.failing]
    return f"{text}; {', '.join(bad)}" if bad else text


STUB_DETECTION = "rampart.actors.detection.stub:StubDetection"

_RESET_WAIT_S = 3.0
"""Simulated seconds within which the manager releases a recovery whose cause is gone."""

_HOLDS_S = 0.3
"""Simulated seconds within which each node repeats its holders (nominally each 0.2 s)."""

_NODES = 16
"""Nodes that can be held, at most."""


async def reset(options: argparse.Namespace) -> int:
    """Release a latched recovery.

    Release a recovery that stays in force until an operator resets it: it is
    latched, or one of its mechanisms clears by operator. While its cause persists,
    or if a mechanism never clears, it is not released, and the exit code is 1.
    `rampart status` shows how each clears. The verb also ends the hold of a client
    that is not a recovery module, for example on the brake; `rampart status` lists
    such holders.

    Examples:
      rampart reset RM1
      rampart reset rampart-4711
    """
    async with connect(options.port) as session:
        session.check_may_order()
        known = [r.name for r in systems.load(session.run.system_file).recoveries]
        if options.recovery not in known:
            return await _let_go(session, options.recovery, known)
        latched = Latest[fm.ManagerStatus]()
        session.listen(ftm_topics.MANAGER_STATUS, latched.keep)
        status = await latched.first(session.real_s(1.0))
        if status is None:
            raise NoEffectError("the FTM Manager does not answer; try again when it is back")
        if options.recovery not in status.latched:
            waiting = ", ".join(status.latched) or "none"
            raise NoEffectError(f"no effect: {options.recovery} is not latched; latched: {waiting}")
        refusals: list[str] = []

        def keep(_key: str, _header: Header, body: bm.Diagnostic) -> None:
            if body.context == fm.RESET_REFUSED and body.offender == options.recovery:
                refusals.append(body.reason)

        session.listen(bus_topics.DIAGNOSTIC, keep)

        def is_released() -> bool:
            return latched.value is not None and options.recovery not in latched.value.latched

        await session.command(
            ftm_topics.RESET, fm.Reset(options.recovery, session.name),
            lambda: is_released() or bool(refusals), session.real_s(_RESET_WAIT_S))
    if refusals:
        raise NoEffectError(f"{options.recovery} was not released: {refusals[0]}")
    if not is_released():
        active = ", ".join(latched.value.active) if latched.value else ""
        raise NoEffectError(f"{options.recovery} was not released; active: {active or 'none'}")
    say(f"{options.recovery} released")
    return 0


async def _let_go(session: Session, name: str, known: list[str]) -> int:
    """Release what a holder holds that is not a recovery module."""
    held = Holdings(session)
    await held.settle()
    what = held.by(name)
    if not what:
        raise unknown("recovery", name, [*known, *held.holders])
    if not await session.command(ftm_topics.RESET, fm.Reset(name, session.name),
                                 lambda: not held.by(name), session.real_s(_RESET_WAIT_S)):
        raise NoEffectError(f"{name} still holds {' and '.join(held.by(name))}; it repeats its "
                            "order")
    say(f"{name} released: {' and '.join(what)}")
    return 0


async def trigger(options: argparse.Namespace) -> int:
    """Activate a stand-in.

    Activate a stand-in for a detection module (`detection.stub`) for some simulated
    seconds. For other detection modules, inject a fault: rampart inject.

    Examples:
      rampart inject trigger:D_LEVEL
      rampart inject trigger:D_VISION --for 5
    """
    positive("--for", options.duration, below=1e6)
    async with connect(options.port) as session:
        spec = systems.load(session.run.system_file)
        stubs = [d.name for d in spec.detections if d.actor == STUB_DETECTION]
        if options.module not in stubs:
            raise unknown("stand-in detection module", options.module, stubs)
        report = Latest[fm.DetectionReport]()
        session.listen(ftm_topics.DETECTION, report.keep,
                       ftm_topics.DETECTION.at(options.module))

        async def bring(state: fm.DetectionState) -> bool:
            return await session.command(
                ftm_topics.STUB_TRIGGER, fm.StubTrigger(
                    options.module, state is fm.DetectionState.ACTIVE, "triggered by hand"),
                lambda: report.value is not None and report.value.state is state,
                session.real_s(1.0))

        if not await bring(fm.DetectionState.ACTIVE):
            raise NoEffectError(f"no effect: {options.module} does not answer")
        say(f"{options.module} detects")
        stop = asyncio.Event()
        with stopped_by_signals(stop):
            await pause(stop, options.duration / session.clock.rate)
        if not await bring(fm.DetectionState.IDLE):
            raise NoEffectError(f"{options.module} did not become idle again")
    say(f"{options.module} is idle again")
    return 0


class Holdings:
    """What holders hold that are not recovery modules, from now on.

    Args:
        session: the connection to the run.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._held: Remembered[str, fm.Holds] = Remembered(_NODES)
        session.listen(ftm_topics.HOLDS, self._keep)

    def _keep(self, _key: str, header: Header, body: fm.Holds) -> None:
        self._held[header.source] = body

    async def settle(self) -> None:
        """Wait until each node has repeated its holders."""
        await asyncio.sleep(self._session.real_s(_HOLDS_S))

    def by(self, name: str) -> tuple[str, ...]:
        """Return what a client holds."""
        return tuple(holds.what for holds in self._held.values() if name in holds.holders)

    @property
    def holders(self) -> dict[str, tuple[str, ...]]:
        """Holder → what it holds."""
        names = dict.fromkeys(name for holds in self._held.values() for name in holds.holders)
        return {name: self.by(name) for name in names}
