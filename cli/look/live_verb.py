"""`rampart live`: the run in somebody else's viewer, while it goes on."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from pathlib import Path
from typing import Any, Protocol

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.recording.run_documents import SYSTEM, footprint_m
from rampart.actors.run.run_info import RunInfo
from rampart.cli.extras import extra
from rampart.cli.following import LOOK_S, is_over, sessions, stopped_by_signals
from rampart.cli.output import UsageError, say, warn
from rampart.cli.session import Session
from rampart.files import toml
from rampart.files.reading import FileError, read_bytes

FOXGLOVE_PORT = 8765
"""Where viewers look unless told otherwise."""

RERUN_URL = "rerun+http://127.0.0.1:9876/proxy"
"""Where a Rerun viewer on this machine listens."""

RERUN_SCHEMES = ("rerun+http://", "rerun+https://", "rerun://")

SHOWN: tuple[Topic[Any], ...] = (
    topics.POSE, topics.ODOMETRY, topics.SCAN, topics.UPPER_SCAN, topics.OBSTACLES, topics.ROUTE,
    topics.LIGHT_MEASURED, topics.MISSION_STATUS, ftm_topics.DECISION, ftm_topics.PROCESS_EVENT,
    bus_topics.DIAGNOSTIC, ftm_topics.DETECTION, bus_topics.INJECTION_REPORT, topics.MISSION_ORDER,
    topics.MISSION_ORDER_ANSWER)
"""What `rampart.actors.recording.views` translates."""


class Viewer(Protocol):
    """Somebody who shows views (`rampart.actors.recording.views`)."""

    def begin(self, run: RunInfo) -> None:
        """A run begins; what was shown of an earlier one is over."""

    def show(self, channel: str, record: Any, at_ns: int) -> None:
        """Show a view; `at_ns` is simulated time."""

    def close(self) -> None:
        """It is over."""


def add(verbs: Any, formatter: Any, common: argparse.ArgumentParser) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser(
        "live", formatter_class=formatter, help="see the run live in Foxglove or Rerun",
        description="Show the run in a viewer for robots: map, prohibited area, lights, obstacles,"
                    "\nroute, robot, transforms, laser, and a log in words. Waits for a run, and\n"
                    "for the next when one ends.",
        epilog="examples:\n  rampart live foxglove\n  rampart live rerun\n"
               "  rampart live rerun --save run.rrd")
    viewers = parser.add_subparsers(dest="subverb", required=True, metavar="VIEWER")

    foxglove = viewers.add_parser(
        "foxglove", formatter_class=formatter, help="serve Foxglove's WebSocket protocol",
        description="Serve viewers that speak Foxglove's WebSocket protocol. They only read:\n"
                    "nothing that they send reaches the robot. Needs the extra:\n"
                    "pip install 'rampart[foxglove]'.",
        epilog="examples:\n  rampart live foxglove\n  rampart live foxglove --port 9000\n"
               "then open ws://127.0.0.1:8765 in the viewer; set the 3D panel's frame to map")
    foxglove.add_argument("--port", type=int, default=FOXGLOVE_PORT, metavar="N",
                          help=f"port to serve on (default {FOXGLOVE_PORT})")
    foxglove.add_argument("--host", default="127.0.0.1", metavar="ADDRESS",
                          help="address to serve on (default 127.0.0.1; whoever reaches it may "
                               "look on)")
    foxglove.add_argument("--run", dest="of", type=int, metavar="N",
                          help="base port of the run, if there are several on this machine")
    foxglove.set_defaults(option="--run", run=lambda options: asyncio.run(live(
        options, _foxglove(options))))

    rerun = viewers.add_parser(
        "rerun", parents=[common], formatter_class=formatter, help="open a Rerun viewer",
        description="Open a Rerun viewer, send to one that is open, or write a file for it.\n"
                    "Needs the extra (170 MB): pip install 'rampart[rerun]'.",
        epilog="examples:\n  rampart live rerun\n"
               "  rerun --bind 127.0.0.1 & rampart live rerun --connect\n"
               "  rampart live rerun --save run.rrd && rerun run.rrd")
    how = rerun.add_mutually_exclusive_group()
    how.add_argument("--connect", nargs="?", const=RERUN_URL, metavar="URL",
                     help=f"send to a viewer that is open (default {RERUN_URL})")
    how.add_argument("--save", metavar="FILE", help="write a file instead, until interrupted")
    rerun.set_defaults(run=lambda options: asyncio.run(live(
        argparse.Namespace(of=options.port, option="--port"), _rerun(options))))


async def live(options: argparse.Namespace, viewer: Viewer) -> int:
    """Show one run after the other until interrupted."""
    stop = asyncio.Event()
    try:
        with stopped_by_signals(stop):
            async with contextlib.aclosing(sessions(
                    options.of, stop, follow=True, option=options.option)) as found:
                async for session in found:
                    say(f"showing {session.run.title} (port {session.run.base_port})")
                    _watch(session, viewer)
                    while not stop.is_set() and not is_over(session.run):
                        with contextlib.suppress(TimeoutError):
                            await asyncio.wait_for(stop.wait(), LOOK_S)
                    if not stop.is_set():
                        say("the run has ended; waiting for the next one, Ctrl-C ends")
    finally:
        try:
            viewer.close()
        except RuntimeError as error:
            warn(f"the viewer did not take everything: {' '.join(str(error).split())}")
    return 0


def _watch(session: Session, viewer: Viewer) -> None:
    from rampart.actors.recording.views import Views  # noqa: PLC0415 heavy

    views = Views(_airport(session.run), _footprint_m(session.run))

    def now_ns() -> int:
        return max(0, int(session.clock.now() * 1e9))

    def see(topic: Topic[Any]) -> None:
        session.listen(topic, topic.pattern, lambda key, header, body: show(
            views.of(topic, f"{ROOT}/{key}", header, body, now_ns())))

    def show(found: list[tuple[str, Any]]) -> None:
        at_ns = now_ns()
        for channel, record in found:
            viewer.show(channel, record, at_ns)

    try:
        viewer.begin(session.run)
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(f"the viewer cannot be started: {' '.join(str(error).split())}") from None
    show(views.start(now_ns()))
    for topic in SHOWN:
        see(topic)


def _airport(run: RunInfo) -> Airport | None:
    """Return the run's airport; without it the map is missing, and the rest is there."""
    name = str(run.plan.get("airport") or "")
    try:
        return load_airport(name) if name else None
    except (OSError, ValueError) as error:
        say(f"no map: {' '.join(str(error).split())}")
        return None


def _footprint_m(run: RunInfo) -> tuple[float, float] | None:
    """Return length and width of the run's robot, None if its system does not say."""
    try:
        return footprint_m([(SYSTEM, "", read_bytes(Path(run.system_file), toml.MAX_SIZE))])
    except (OSError, FileError):
        return None


def _foxglove(options: argparse.Namespace) -> Viewer:
    extra("foxglove", "foxglove")
    from rampart.cli.look.live_foxglove import FoxgloveViewer  # noqa: PLC0415 of the extra

    if not 0 <= options.port <= 65535:
        raise UsageError(f"--port {options.port}: must be between 0 and 65535")
    try:
        viewer = FoxgloveViewer(options.host, options.port)
    except RuntimeError as error:
        raise UsageError(f"cannot serve on {options.host} port {options.port}: {error}; "
                         "choose another --port or --host") from None
    say(f"Foxglove viewers: ws://{options.host}:{viewer.port}")
    return viewer


def _rerun(options: argparse.Namespace) -> Viewer:
    extra("rerun", "rerun")
    from rampart.cli.look.live_rerun import RerunViewer  # noqa: PLC0415 of the extra

    if options.connect is not None and not options.connect.startswith(RERUN_SCHEMES):
        raise UsageError(f"--connect {options.connect}: must begin with one of "
                         f"{', '.join(RERUN_SCHEMES)}; e.g. {RERUN_URL}")
    if options.save is not None and not Path(options.save).resolve().parent.is_dir():
        raise UsageError(f"--save {options.save}: there is no such directory")
    return RerunViewer(connect=options.connect, save=options.save)
