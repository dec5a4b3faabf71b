"""Type-valid extremes into every handler of every actor, and into whatever shows what it hears.

One actor lives alone on a virtual bus, and a stranger tells it, in any order, whatever its types
allow: numbers at their bounds, NaN, names of nodes and of nobody, documents that are none, headers
of any source, incarnation, sequence and stamp; timers tick in between. Then it is started again,
with what it has kept. Nothing may end it, nothing may take long, and it may publish nothing that
its own readers would refuse.

`python -m tests.fuzz.handler_fuzz RUNS [SEED]` makes so many runs of each actor; the suite makes a
few (`test_handler_fuzz.py`). A finding names actor and seed, and comes again with both.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect

from rampart.actors.bus.envelope import UNREADABLE, Header, decode
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.machine.patience import AT_LEISURE, Usage
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.views import OsmosisViews
from rampart.actors.runtime.actor import BASE_OUTPUTS, Actor, Context
from rampart.actors.runtime.checkpoint import MemoryCheckpoints, Record
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, SUPERVISOR, RunPlan
from rampart.actors.system.layout import Layout, load_run
from rampart.actors.system.topics import find_topic
from rampart.cli import systems
from rampart.cli.look import top_view
from rampart.cli.look.metrics_families import families
from rampart.cli.look.topic_verbs import in_line
from rampart.cli.osmosis.lines import OsmosisLines
from rampart.cli.run_picture import DECODED, RunPicture
from rampart.manager.spec.specification import SystemSpec
from rampart.sim.osmosis.trial.mission_trial import MissionTrial
from rampart.sim.runs.console import Console
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualClock, VirtualLoop
from tests import system_file
from tests.fuzz.message_extremes import Drawer, all_topics

SYSTEMS = ("osmosis", "paper", "cell")

MESSAGES = 40
"""Told to an actor in one of its two lives."""

PATIENCE_S = 2.0
"""Seconds of processor time that one message, with the timers after it, may cost."""

MEMORY_MB = 500
"""By so much a long session may grow."""

_DOMAIN = inspect.type_info(Header)


@dataclass(frozen=True, slots=True)
class Finding:
    """What went wrong: in whom, by which seed, and what was last told to it."""

    who: str
    seed: int
    what: str
    told: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n  ".join((f"{self.who} seed {self.seed}: {self.what}", *self.told))


class SlowError(Exception):
    """Something takes longer than `PATIENCE_S`."""


@dataclass(frozen=True)
class System:
    """A system with what its actors share; nothing listens on a port."""

    spec: SystemSpec
    plan: RunPlan
    layout: Layout
    run: RunContext
    words: tuple[str, ...]


@cache
def system(name: str) -> System:
    """Return a system by its name."""
    spec = systems.load(str(system_file(name)))
    plan = RunPlan("fuzz", system_file=str(system_file(name)), launcher_pid=1,
                   options={} if name == "cell" else {"obstacles": 1})
    run = load_run(plan, spec)
    layout = Layout(plan, spec, run.application)
    lights = [light.name for light in run.application.airport.lights[:2]] \
        if name != "cell" else []
    words = (*layout.members, *(m.name for m in spec.mechanisms), *lights, "fuzz/first", "x",
             "crate", "front left", "FTM1", "control/command", "localization/pose", "heartbeat/DM1",
             "drop", "delay", "corrupt", "freeze", "stuck", "duplicate", "restamp", "x_m",
             "nodes", "enable", "disable", "retune", "set", "strategy", "order",
             "safety-first", "guarded-repair", '{"value": "safety-first"}', '{"deadline_s": 1.0}',
             msgspec.json.encode(run.document).decode())
    return System(spec, plan, layout, run, words)


class Machine:
    """`Processes` whose processes are numbers."""

    has_routers = False

    def __init__(self) -> None:
        self._pid = 100

    def living(self) -> Sequence[Any]:
        return ()

    def fork(self, _names: tuple[str, ...], _incarnation: int,
             answer: Callable[[int, str], None]) -> None:
        self._pid += 1
        answer(self._pid, "")

    def hold(self, pid: int, _ended: Callable[[], None], node: str = "") -> Any:
        if pid < 100:
            raise ProcessLookupError(pid)
        return self

    def adapt(self, _adapted: Any) -> None:
        pass

    def end(self, _handles: Sequence[Any], _grace_s: float) -> None:
        pass

    def kill(self) -> None:
        pass

    def gone(self) -> bool:
        return True

    def stopped(self) -> bool:
        return False

    def usage(self) -> Usage:
        return AT_LEISURE

    def ignore(self) -> None:
        pass

    def close(self) -> None:
        pass


class Stranger:
    """Tells an actor, or a sink, whatever its types allow."""

    def __init__(self, seed: Any, of: System) -> None:
        self.drawer = Drawer(seed, of.words)
        self.dice = self.drawer.dice
        self._nodes = tuple(of.layout.members)
        self._sequence = 0
        self.told: list[str] = []

    def header(self, now_s: float, *, wild: float = 0.15) -> Header:
        """Return whose message it is said to be; mostly one that is not refused at once."""
        dice, self._sequence = self.dice, self._sequence + 1
        self.drawer.wild = True
        drawn = self.drawer.value(_DOMAIN)
        source = dice.choice(self._nodes) if dice.random() < 0.8 else drawn["source"]
        stamp = now_s - dice.choice((0.0, 0.0, 0.0, 0.01, 0.3, 2.0))
        drawn["incarnation"] = min(drawn["incarnation"], 2**30)  # the last one has no successor
        parts = [source, dice.choice((1, 1, 1, 2, 3)), self._sequence, stamp]
        for index, name in enumerate(("source", "incarnation", "sequence", "stamp")):
            if dice.random() < wild / 4:
                parts[index] = drawn[name]
        return Header(*parts)

    def payload(self, topic: Topic[Any], header: Header) -> bytes:
        """Return a message of a topic in the bytes of the wire."""
        self.drawer.wild = self.dice.random() < 0.5
        kind = inspect.type_info(topic.type)
        body = self.drawer.value(kind)
        while not _is_valid(topic, body):
            body = self.drawer.value(kind)
        self.drawer.remember(body)
        self.told.append(f"{topic.key} from {header.source!r}: {body!r}"[:400])
        return msgspec.msgpack.encode(
            (header.source, header.incarnation, header.sequence, header.stamp, body))


def _is_valid(topic: Topic[Any], body: Any) -> bool:
    try:
        decode(topic, msgspec.msgpack.encode(("", 0, 0, 0.0, body)))
    except UNREADABLE:
        return False
    return True


def fuzz_actor(system_name: str, name: str, seed: int) -> Finding | None:
    """Tell one actor of a system what its types allow, in two lives; return what went wrong."""
    of = system(system_name)
    stranger = Stranger(f"{system_name} {name} {seed}", of)
    shelf, who = list[Record](), f"{system_name} {name}"
    try:
        for incarnation in (1, 2):
            with _patience(), asyncio.Runner(loop_factory=VirtualLoop) as runner:
                problem = runner.run(_live(of, name, incarnation, shelf, stranger))
            if problem:
                return Finding(who, seed, problem, tuple(stranger.told[-4:]))
    except Exception as error:
        return Finding(who, seed, _trace(error), tuple(stranger.told[-4:]))
    return None


async def _live(of: System, name: str, incarnation: int, shelf: list[Record],
                stranger: Stranger) -> str:
    """Let an actor live and be told things; raise what ends it, return what it should not say."""
    loop = asyncio.get_running_loop()
    hub, member = Hub(), of.layout.members[name]
    clock = VirtualClock(loop, loop.time() + 1.0)  # type: ignore[arg-type]
    more = {SUPERVISOR: [Machine()], OBSERVER: [_sinks(of, clock)]}.get(name, [])
    actor = member.actor(Context(
        name, incarnation, clock, VirtualBus(hub, name, incarnation), member.parameters, of.run,
        pid=100, checkpoints=MemoryCheckpoints(shelf, incarnation), topics=of.layout.topics), *more)
    problems: list[str] = []

    def overheard(_now_s: float, source: str, key: str, payload: bytes) -> None:
        if source == name:
            problems.extend(_flaw(actor, key, payload))
            stranger.drawer.remember(msgspec.msgpack.decode(payload)[4])

    hub.taps.append(overheard)
    bus = VirtualBus(hub, "stranger")
    await bus.open()
    for node in (*of.layout.members, "nobody"):
        hub.announce(node, 1, alive=True)
    task = asyncio.create_task(actor.run())
    await asyncio.sleep(stranger.dice.choice((0.0, 1.0)))
    inputs = [*(topic for topic in actor.inputs() if actor.listens(topic)),
              *(of.layout.topics[key] for key in dict.fromkeys(named.key for named in
                                             actor.named(actor.parameters)["heard"]))]
    for _ in range(MESSAGES):
        topic = stranger.dice.choice(inputs)
        payload = stranger.payload(topic, stranger.header(clock.now()))
        for copy in range(stranger.dice.choice((1, 1, 1, 2))):  # noqa: B007
            bus.publish(topic, _key(actor, topic, stranger), payload)
        if stranger.dice.random() < 0.1:
            hub.announce(stranger.dice.choice(tuple(of.layout.members)), stranger.dice.choice(
                (1, 2, 2**53)), alive=stranger.dice.random() < 0.5)
        await asyncio.sleep(stranger.dice.choice((0.0, 0.0, 0.01, 0.06, 0.3)))
        if task.done():
            break
        _reset_patience()
    if not task.done():
        await asyncio.sleep(stranger.dice.choice((0.0, 3.0)))
        actor.stop()
    await task
    return "; ".join(problems[:3])


def _key(actor: Actor, topic: Topic[Any], stranger: Stranger) -> str:
    if not topic.is_family:
        return topic.at()
    names = actor.names(topic, actor.name, actor.parameters)
    return topic.at(stranger.dice.choice(names or (actor.name, "DM1", "x")))


def _flaw(actor: Actor, key: str, payload: bytes) -> Iterator[str]:
    topic = find_topic(key.removeprefix(f"{ROOT}/"), (*actor.outputs, *BASE_OUTPUTS))
    if topic is None:
        return
    try:
        decode(topic, payload)
    except UNREADABLE as error:
        yield f"it published on {key} what its readers refuse: {error}"


# -- what only shows ----------------------------------------------------------------------------


def _sinks(of: System, clock: VirtualClock) -> list[Any]:
    """Return what the launcher has the observer tell the run's story to."""
    if not isinstance(of.run.application, Osmosis):
        return [Console(io.StringIO()).take]
    run = MissionTrial(of.run, 60.0, io.StringIO())

    def conclude(_topic: Any, _message: Any, _header: Header) -> None:
        run.over(clock.now())
        msgspec.json.encode(run.conclude(clock.now(), "fuzz"))

    return [*run.sinks(clock), conclude]


def fuzz_tools(seed: int) -> Finding | None:
    """Tell what the tools show of a run whatever the types allow; return what went wrong."""
    of = system("osmosis")
    stranger = Stranger(f"tools {seed}", of)
    picture = RunPicture(OsmosisLines())
    views = OsmosisViews(of.run.application, of.run.system)
    run = _Run()
    try:
        with _patience():
            for number in range(MESSAGES):
                topic = stranger.dice.choice(all_topics())
                header = stranger.header(1.0, wild=0.6)
                found, body = decode(topic, stranger.payload(topic, header))
                now_s = stranger.dice.choice((0.0, 1.0, 1.0 + number, 1e12))
                if topic in (*DECODED, *OsmosisLines.read):
                    picture.heard(topic, found, body, now_s)
                picture.sample(now_s)
                in_line(body)
                for _, view in views.of(topic, topic.at("DM1") if topic.is_family else topic.at(),
                                        found, body, 0):
                    msgspec.json.encode(view)
                frame = top_view.Frame("fuzz", 7450, 1.0, now_s, picture)
                for width, height in ((80, 24), (1, 1), (200, 60), (0, 0)):
                    top_view.lines(frame, width, height)
                msgspec.json.encode(top_view.picture_json(frame))
                list(families(run.exposition(now_s, picture)))
                _reset_patience()
    except Exception as error:
        return Finding("tools", seed, _trace(error), tuple(stranger.told[-4:]))
    return None


class _Run:
    """What an exposition needs of a run."""

    run_id, title, base_port, rate, recording, keys = "fuzz", "fuzz", 7450, 1.0, "", ""

    def exposition(self, now_s: float, picture: RunPicture) -> Any:
        from rampart.cli.look.metrics_families import Exposition

        return Exposition(self, now_s, picture)  # type: ignore[arg-type]


# -- patience -----------------------------------------------------------------------------------


@contextlib.contextmanager
def _patience() -> Iterator[None]:
    """Raise `SlowError` in the middle of whatever takes too much processor time."""

    def stop(_signal: int, _frame: Any) -> None:
        raise SlowError(f"more than {PATIENCE_S:g} s of processor time")

    before = signal.signal(signal.SIGVTALRM, stop)
    _reset_patience()
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _reset_patience() -> None:
    signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE_S)


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error)[-8:]).rstrip()


# -- many runs ----------------------------------------------------------------------------------


def cases() -> list[tuple[str, str]]:
    """Return system and name of each actor, of those of the same class and parameters one."""
    found: dict[Any, tuple[str, str]] = {}
    for name in SYSTEMS:
        for member in system(name).layout.members.values():
            found.setdefault((member.actor, repr(member.parameters)), (name, member.name))
    return list(found.values())


def main(runs: int = 1, seed: int = 0, say: Callable[[str], None] = print) -> list[Finding]:
    """Make so many runs of each actor and of the tools; return what was found, each kind once.

    Args:
        runs: of each.
        seed: of the first; the others follow.
        say: takes what is found, and at the end what was done.
    """
    found: dict[str, Finding] = {}
    begun_s = time.monotonic()
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(seed, seed + runs):
        results = [fuzz_actor(*case, number) for case in cases()]
        for finding in (*results, fuzz_tools(number)):
            if finding is not None and found.setdefault(_kind(finding), finding) is finding:
                say(str(finding))
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - grown_kb) / 1024
    if grown_mb > MEMORY_MB:
        found["memory"] = Finding("all", seed, f"{grown_mb:.0f} MB more memory")
    told = runs * (len(cases()) * 2 + 1) * MESSAGES
    say(f"{told} messages to {len(cases())} actors and the tools in "
        f"{time.monotonic() - begun_s:.0f} s, {grown_mb:.0f} MB: {len(found)} findings")
    return list(found.values())


def _kind(finding: Finding) -> str:
    """Return what findings of the same cause have in common: where it was raised."""
    lines = finding.what.splitlines()
    return next((line for line in reversed(lines) if line.startswith('  File "')), finding.what)


if __name__ == "__main__":
    warnings.simplefilter("error")  # as the suite has it: what numpy warns of is no number
    sys.exit(1 if main(*map(int, sys.argv[1:])) else 0)
