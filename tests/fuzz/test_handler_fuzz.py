"""Messages as extreme as their types allow, to every handler of every actor and to the tools.

One actor lives alone on a virtual bus. A stranger sends it, in any order, what its types allow:
numbers at their bounds, NaN, names of nodes and unknown names, texts that are not documents,
headers of any source, incarnation, sequence and stamp. Timers tick in between. Then the actor is
restarted with its checkpoints. Nothing may end it or exceed the limits of `target`, and it
publishes nothing that its own readers refuse.
"""

from __future__ import annotations

import asyncio
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from msgspec import inspect
from rich.console import Console as RichConsole

from rampart.actors.bus.envelope import UNREADABLE, Header, decode
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.views import OsmosisViews
from rampart.actors.runtime.actor import BASE_OUTPUTS, Actor, Context
from rampart.actors.runtime.checkpoint import MemoryCheckpoints, Record
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, SUPERVISOR, RunPlan
from rampart.actors.supervision.processes import ProcessHandle
from rampart.actors.system.layout import Layout, load_run
from rampart.actors.system.topics import find_topic
from rampart.cli import systems
from rampart.cli.look import top
from rampart.cli.look.live_metrics import Exposition, families
from rampart.cli.look.topic_verbs import in_line
from rampart.cli.osmosis.lines import OsmosisLines
from rampart.cli.run_picture import DECODED, RunPicture
from rampart.manager.spec.specification import SystemSpec
from rampart.sim.osmosis.trial.mission_trial import MissionTrial
from rampart.sim.runs.console import Console
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualClock, VirtualLoop
from rampart.testing import VirtualSystem, run
from tests import system_file
from tests.fuzz.message_extremes import all_topics, pack, values
from tests.fuzz.target import Draw, limits, restart_limit

pytestmark = pytest.mark.filterwarnings("ignore:Generating overly large repr")

SYSTEMS = ("osmosis", "paper", "cell")

MESSAGES = 10
"""At most so many are sent to an actor in each of its two incarnations."""


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
    """`Processes` whose processes are numbers, and end at once."""

    has_routers = False

    def __init__(self) -> None:
        self._pids = count(101)

    def fork(self, _names: tuple[str, ...], _incarnation: int,
             answer: Callable[[int, str], None]) -> None:
        answer(next(self._pids), "")

    def hold(self, pid: int, _ended: Callable[[], None]) -> ProcessHandle:
        if pid < 100:
            raise ProcessLookupError(pid)
        return ProcessHandle()

    def living(self) -> Sequence[Any]:
        return ()

    def nothing(self, *_: Any) -> None:
        """Ignore what changes no process."""

    adapt = end = close = nothing


_INCARNATIONS = st.sampled_from((1, 1, 2, 3))
_AGES = st.sampled_from((0.0, 0.0, 0.01, 0.3, 2.0))
_WILD = st.sampled_from(("",) * 20 + ("source", "incarnation", "sequence", "stamp"))
"""The field of a header that has any value; mostly none."""


class Stranger:
    """Draws messages of any source.

    Args:
        draw: of Hypothesis.
        of: the system whose names it knows.
    """

    def __init__(self, draw: Draw, of: System) -> None:
        self.draw = draw
        self._words = of.words
        self._nodes = st.sampled_from(tuple(of.layout.members))
        self._sequence = 0

    def header(self, now_s: float) -> Header:
        """Return a header that is mostly not refused: at most one of its fields is wild."""
        self._sequence += 1
        fields = {"source": self.draw(self._nodes), "incarnation": self.draw(_INCARNATIONS),
                  "sequence": self._sequence, "stamp": now_s - self.draw(_AGES)}
        if wild := self.draw(_WILD):
            fields[wild] = self.draw(_bodies(Header, self._words))[wild]
        # The last incarnation has no successor.
        return Header(**{**fields, "incarnation": min(fields["incarnation"], 2**30)})

    def payload(self, topic: Topic[Any], header: Header) -> bytes:
        """Return a message of a topic in the bytes of the wire."""
        body = self.draw(_bodies(topic.type, self._words).filter(
            lambda body: _refused(topic, pack("", 0, 0, 0.0, body)) is None))
        return pack(header.source, header.incarnation, header.sequence, header.stamp, body)


@cache
def _bodies(kind: type, words: tuple[str, ...]) -> st.SearchStrategy[Any]:
    return values(inspect.type_info(kind), words)


def _refused(topic: Topic[Any], payload: bytes) -> Exception | None:
    try:
        decode(topic, payload)
    except UNREADABLE as error:
        return error
    return None


def fuzz_actor(of: System, name: str, draw: Draw) -> None:
    """Send one actor of a system what its types allow, in two incarnations.

    Raises:
        Exception: whatever ends the actor, or exceeds the limits.
    """
    stranger, shelf = Stranger(draw, of), list[Record]()
    for incarnation in (1, 2):
        with limits(), asyncio.Runner(loop_factory=VirtualLoop) as runner:
            runner.run(_live(of, name, incarnation, shelf, stranger))


async def _live(of: System, name: str, incarnation: int, shelf: list[Record],
                stranger: Stranger) -> None:
    loop, draw = asyncio.get_running_loop(), stranger.draw
    hub, member = Hub(), of.layout.members[name]
    clock = VirtualClock(loop, loop.time() + 1.0)  # type: ignore[arg-type]
    more = {SUPERVISOR: [Machine()], OBSERVER: [_sinks(of, clock)]}.get(name, [])
    actor = member.actor(Context(
        name, incarnation, clock, VirtualBus(hub, name, incarnation), member.parameters, of.run,
        pid=100, checkpoints=MemoryCheckpoints(shelf, incarnation), topics=of.layout.topics), *more)
    problems: list[str] = []

    def overheard(_now_s: float, source: str, key: str, payload: bytes) -> None:
        topic = find_topic(key.removeprefix(f"{ROOT}/"), (*actor.outputs, *BASE_OUTPUTS))
        if source == name and topic is not None and (error := _refused(topic, payload)):
            problems.append(f"{key}: its readers refuse what it published: {error}")

    hub.taps.append(overheard)
    bus = VirtualBus(hub, "stranger")
    await bus.open()
    nodes = st.sampled_from(tuple(of.layout.members))
    for node in (*of.layout.members, "nobody"):
        hub.announce(node, 1, alive=True)
    task = asyncio.create_task(actor.run())
    await asyncio.sleep(draw(st.sampled_from((0.0, 1.0))))
    inputs = st.sampled_from([
        *(topic for topic in actor.inputs() if actor.listens(topic)),
        *(of.layout.topics[key] for key in dict.fromkeys(
            named.key for named in actor.named(actor.parameters)["heard"]))])
    for _ in range(draw(st.integers(0, MESSAGES))):
        topic = draw(inputs)
        payload = stranger.payload(topic, stranger.header(clock.now()))
        for _ in range(draw(st.sampled_from((1, 1, 1, 2)))):
            bus.publish(topic, _key(actor, topic, draw), payload)
        if draw(st.integers(0, 9)) == 9:
            hub.announce(draw(nodes), draw(st.sampled_from((1, 2, 2**53))),
                         alive=draw(st.booleans()))
        await asyncio.sleep(draw(st.sampled_from((0.0, 0.01, 0.06, 0.3))))
        if task.done():
            break
        restart_limit()
    if not task.done():
        await asyncio.sleep(draw(st.sampled_from((0.0, 3.0))))
        actor.stop()
    await task
    assert problems == []


def _key(actor: Actor, topic: Topic[Any], draw: Draw) -> str:
    if not topic.is_family:
        return topic.at()
    names = actor.names(topic, actor.name, actor.parameters)
    return topic.at(draw(st.sampled_from(tuple(names or (actor.name, "DM1", "x")))))


def _sinks(of: System, clock: VirtualClock) -> list[Any]:
    """Return the sinks that the launcher gives to the observer."""
    if not isinstance(of.run.application, Osmosis):
        return [Console(io.StringIO()).take]
    run = MissionTrial(of.run, 60.0, io.StringIO())

    def conclude(_topic: Any, _message: Any, _header: Header) -> None:
        run.over(clock.now())
        msgspec.json.encode(run.conclude(clock.now(), "fuzz"))

    return [*run.sinks(clock), conclude]


def fuzz_tools(draw: Draw) -> None:
    """Show in every tool what the types allow.

    Raises:
        Exception: whatever a tool raises.
    """
    of = system("osmosis")
    stranger, picture = Stranger(draw, of), RunPicture(OsmosisLines())
    views = OsmosisViews(of.run.application, of.run.system)
    for number in range(draw(st.integers(1, MESSAGES))):
        topic = draw(st.sampled_from(all_topics()))
        header, body = decode(topic, stranger.payload(topic, stranger.header(1.0)))
        now_s = draw(st.sampled_from((1.0, 0.0, 1.0 + number, 1e12)))
        with limits():
            if topic in (*DECODED, *OsmosisLines.read):
                picture.heard(topic, header, body, now_s)
            picture.sample(now_s)
            in_line(body)
            for _, view in views.of(topic, topic.at("DM1") if topic.is_family else topic.at(),
                                    header, body, 0):
                msgspec.json.encode(view)
            frame = top.Frame("fuzz", 7450, 1.0, now_s, picture)
            for width in (1, 80, 200):
                RichConsole(file=io.StringIO(), width=width).print(top.screen(frame, width))
            msgspec.json.encode(top.picture_json(frame))
            list(families(Exposition(_Run(), now_s, picture)))  # type: ignore[arg-type]


class _Run:
    """The parts of a run that its metrics show."""

    run_id, title, base_port, rate, recording, keys = "fuzz", "fuzz", 7450, 1.0, "", ""


def cases() -> list[tuple[str, str]]:
    """Return system and name of each actor, of those of the same class and parameters one."""
    found: dict[Any, tuple[str, str]] = {}
    for name in SYSTEMS:
        for member in system(name).layout.members.values():
            found.setdefault((member.actor, repr(member.parameters)), (name, member.name))
    return list(found.values())


FEW = settings(max_examples=settings.default.max_examples // 5,
               suppress_health_check=list(HealthCheck), phases=set(Phase) - {Phase.explain})


@pytest.mark.parametrize(("of", "name"), cases())
@FEW
@given(st.data())
def test_no_message_that_its_type_allows_ends_an_actor(of, name, data):
    fuzz_actor(system(of), name, data.draw)


@FEW
@given(st.data())
def test_every_tool_shows_any_message_that_its_type_allows(data):
    fuzz_tools(data.draw)


@pytest.mark.parametrize("document", [
    "null", "{", "{}", '{"node": 3}', '{"node": [[]]}',
    "[" * 300_000, '{"a":' * 50_000,
    '{"name": "x", "node": [{"name": "' + "n" * 100_000 + '"}]}'], ids=lambda text: text[:15])
def test_a_changed_system_that_is_no_document_is_reported_and_the_supervisor_goes_on(document):
    of, reports = system("paper"), []

    async def scenario():
        async with VirtualSystem(of.run, of.layout) as living:
            actor = living.start_node(SUPERVISOR, Machine())
            actor.report_diagnostic = lambda *report: reports.append(report)
            await asyncio.sleep(0.1)
            living.say(ftm_topics.ADAPTED_SYSTEM, m.AdaptedSystem(
                1, "a change", "somebody", document), "ftm_manager", stamp_s=0.0)
            await asyncio.sleep(0.1)
            await living.stop(SUPERVISOR)

    run(scenario)
    assert [(context, offender) for context, _, offender in reports] == [("adaptation", "a change")]
