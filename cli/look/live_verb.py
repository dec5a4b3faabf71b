"""`rampart live`: the run in somebody else's viewer, while it goes on.

Show the run in a viewer for robots: what its system shows of the robot,
and a log in words. Waits for a run, and for the next when one ends.

Examples:
  rampart live foxglove
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any

from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.recording.run_documents import known_of
from rampart.cli.following import LOOK_S, is_over, sessions, stopped_by_signals
from rampart.cli.output import UsageError, between, say, warn
from rampart.cli.session import Session, pause
from rampart.cli.verbs import add_family, add_verb, extra, served

if TYPE_CHECKING:
    from rampart.cli.look.live_foxglove import FoxgloveViewer

FOXGLOVE_PORT = 8765
"""Where viewers look unless told otherwise."""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    viewers = add_family(verbs, "live", "see the run live in Foxglove", __doc__, metavar="VIEWER")
    add_verb(viewers, "foxglove", "serve Foxglove's WebSocket protocol", foxglove,
             *served(FOXGLOVE_PORT, "look on"))


def foxglove(options: argparse.Namespace) -> Coroutine[Any, Any, int]:
    """Serve viewers until interrupted.

    Serve viewers that speak Foxglove's WebSocket protocol. They only read:
    nothing that they send reaches the robot. Needs the extra:
    pip install 'rampart[foxglove]'.

    Examples:
      rampart live foxglove
      rampart live foxglove --port 9000
    then open ws://127.0.0.1:8765 in the viewer; set the 3D panel's frame to map
    """
    extra("foxglove", "foxglove")
    from rampart.cli.look.live_foxglove import FoxgloveViewer  # noqa: PLC0415 of the extra

    between("--port", options.port, 0, 65535)
    try:
        viewer = FoxgloveViewer(options.host, options.port)
    except RuntimeError as error:
        raise UsageError(f"cannot serve on {options.host} port {options.port}: {error}; "
                         "choose another --port or --host") from None
    say(f"Foxglove viewers: ws://{options.host}:{viewer.port}")
    return live(options, viewer)


async def live(options: argparse.Namespace, viewer: FoxgloveViewer) -> int:
    """Show one run after the other until interrupted."""
    stop = asyncio.Event()
    try:
        with stopped_by_signals(stop):
            async with contextlib.aclosing(sessions(
                    options.of, stop, follow=True, option="--run")) as found:
                async for session in found:
                    _watch(session, viewer)
                    say(f"showing {session.run.title} (port {session.run.base_port})")
                    while not stop.is_set() and not is_over(session.run):
                        await pause(stop, LOOK_S)
                    if not stop.is_set():
                        say("the run has ended; waiting for the next one, Ctrl-C ends")
    finally:
        try:
            viewer.close()
        except RuntimeError as error:
            warn(f"the viewer did not take everything: {' '.join(str(error).split())}")
    return 0


def _watch(session: Session, viewer: FoxgloveViewer) -> None:
    run = session.run
    known = known_of({**run.plan, "system_file": run.system_file})
    if known.application is None:
        say("no map: the application of the run cannot be loaded here")
    views = known.views()

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
        viewer.begin(run, views.channels)
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(f"the viewer cannot be started: {' '.join(str(error).split())}") from None
    show(views.start(now_ns()))
    for topic in views.translators:
        see(topic)
