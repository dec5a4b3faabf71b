"""Actors on both buses: what a node may rely on, whichever carries its messages."""

import ast
import asyncio
import inspect
import math
import textwrap
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import ClassVar

import pytest

from rampart import DetectionModule, Message, Qos, RecoveryModule, Topic
from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bus import Bus
from rampart.actors.bus.envelope import ArrivalGuard, encode
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.declaration import Declared
from rampart.actors.supervision.supervisor import Supervisor
from rampart.actors.system.members import load_class
from rampart.cli import systems
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.testing import eventually
from rampart.testing.virtual import VirtualSystem
from tests.virtual_time import within


class Talker(Actor):
    """Publishes poses on demand."""

    outputs = (topics.POSE, topics.GOAL, ftm_topics.RESET)


class Listener(Actor):
    """Keeps the messages that it receives."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.heard: list[tuple[bm.Message, Header]] = []
        self.peers: list[tuple[str, int]] = []

    @classmethod
    def names(cls, topic, name, parameters):
        return ("talker",) if topic is bus_topics.HEARTBEAT else None

    @on(topics.POSE)
    def pose(self, message: m.Pose, header: Header) -> None:
        self.heard.append((message, header))

    @on(ftm_topics.RESET)
    def reset(self, message: fm.Reset, header: Header) -> None:
        if message.by == "poison":
            raise RuntimeError("poisoned")
        self.heard.append((message, header))

    @on(topics.GOAL)
    def goal(self, message: m.GoalOrder, header: Header) -> None:
        self.heard.append((message, header))

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, _message: bm.Heartbeat, header: Header) -> None:
        if (header.source, header.incarnation) not in self.peers:
            self.peers.append((header.source, header.incarnation))


MakeBus = Callable[[str, int], Bus]


@pytest.fixture(params=["virtual", "zenoh"])
def make_bus(request: pytest.FixtureRequest, bus_folder: str) -> MakeBus:
    if request.param == "virtual":
        hub = Hub()
        return lambda name, incarnation: VirtualBus(hub, name, incarnation)
    return lambda name, incarnation: ZenohBus(name, endpoints(bus_folder))


@asynccontextmanager
async def running(cls: type[Actor], name: str, make_bus: MakeBus, incarnation: int = 1,
                  rate: float = 1.0) -> AsyncIterator[Actor]:
    loop = asyncio.get_running_loop()
    clock = Clock(0.0, rate, loop.time)  # one for all actors
    actor = cls(Context(name, incarnation, clock, make_bus(name, incarnation)))
    task = asyncio.create_task(actor.run())
    await eventually(lambda: actor._dispatcher.progress > 0 or task.done() or bool(actor._timers))
    try:
        yield actor
    finally:
        actor.stop()
        await asyncio.wait_for(asyncio.gather(task, return_exceptions=True), 5)


@asynccontextmanager
async def talking(make_bus: MakeBus, reader: type[Actor] = Listener, incarnation: int = 1
                  ) -> AsyncIterator[tuple[Actor, Actor]]:
    """Run a reader, and a talker that it has heard of."""
    async with (running(reader, "listener", make_bus) as listener,
                running(Talker, "talker", make_bus, incarnation) as talker):
        await eventually(lambda: listener.peers == [("talker", incarnation)])
        yield listener, talker


async def test_a_message_is_handled_once_and_what_nobody_can_have_sent_is_counted(make_bus):
    async with talking(make_bus, incarnation=3) as (listener, talker):
        talker.publish(topics.POSE, m.Pose(1.0, 2.0, 0.5), stamp=0.25)
        await eventually(lambda: bool(listener.heard))
        message, header = listener.heard[0]
        assert message == m.Pose(1.0, 2.0, 0.5)
        assert (header.source, header.incarnation, header.stamp) == ("talker", 3, 0.25)
        twice = encode(Header("talker", 3, 5, 0.0), fm.Reset("RM1", "operator"))
        pose = encode(Header("talker", 3, 900, 0.0), m.Pose(0.0, 0.0, 0.0))
        no_text = twice.replace(b"talker", b"talk\xff\xff")
        ahead_s = talker.clock.now() + 3600.0
        ahead = [encode(Header("talker", 3, 6, stamp_s), fm.Reset("RM3", "future"))
                 for stamp_s in (ahead_s, math.inf, math.nan)]
        # On a key that Zenoh does not thin out when a burst finds its queue full.
        for payload in (twice, twice, b"", b"\xff\x00 garbage", b"\x91" * 100_000, pose, no_text,
                        *ahead):
            talker._bus.publish(ftm_topics.RESET, ftm_topics.RESET.at(), payload)
        talker.publish(ftm_topics.RESET, fm.Reset("RM2", "operator"))
        await eventually(lambda: len(listener.heard) == 3)
        assert [body.recovery for body, _ in listener.heard[1:]] == ["RM1", "RM2"]
        assert listener._rejected == 8


class Twice(Listener):
    """Has a second handler for a topic of its base class."""

    @on(topics.POSE)
    def second(self, message: m.Pose, _header: Header) -> None:
        self.heard.append((message.x_m, len(self.heard)))


async def test_each_handler_of_a_topic_hears_each_message_in_the_order_of_the_classes(make_bus):
    async with talking(make_bus, Twice) as (listener, talker):
        talker.publish(topics.POSE, m.Pose(3.0, 0.0, 0.0))
        await eventually(lambda: len(listener.heard) == 2)
        assert listener.heard[1] == (3.0, 1)


@pytest.mark.parametrize("forged", [1, 3, 77, 2 ** 53])
def test_an_incarnation_that_was_not_issued_last_makes_nobody_deaf_to_the_real_one(forged):
    taken, refused = [], []
    guard = ArrivalGuard(lambda: 10.0, register={"talker": 2}.get)
    receive = guard.receiver(topics.POSE, lambda _key, message: taken.append(message.incarnation),
                             lambda _key, reason: refused.append(reason))
    for life, source in ((forged, "talker"), (2, "talker"), (forged, "talker"), (5, "a tool")):
        receive("k", encode(Header(source, life, 1, 1.0), m.Pose(0.0, 0.0, 0.0)))
    assert taken == [2, 5]
    assert refused[0] == f"incarnation {forged} of talker, of which 2 was issued last"
    assert len(refused) == 2


def test_after_a_pause_a_source_is_not_believed_that_has_a_successor_which_was_not_heard_yet():
    now_s, register, taken, refused = [10.0], {"talker": 2}, [], []
    receive = ArrivalGuard(lambda: now_s[0], register=register.get).receiver(
        topics.POSE, lambda _key, message: taken.append(message.sequence),
        lambda _key, reason: refused.append(reason))

    def say(sequence: int, incarnation: int = 2) -> None:
        header = Header("talker", incarnation, sequence, now_s[0])
        receive("k", encode(header, m.Pose(0.0, 0.0, 0.0)))

    say(1)
    now_s[0] = 15.0
    say(2)
    register["talker"] = 1_000_001  # its host was lost
    now_s[0] = 17.0
    say(3)
    say(4)
    say(1, 1_000_001)
    assert taken == [1, 2, 1]
    assert refused == 2 * ["incarnation 2 of talker, of which 1000001 was issued last"]


@pytest.mark.parametrize(("given_s", "obeyed"), [(10.0, True), (9.31, True), (9.29, False),
                                                 (-1.0, False)])
def test_a_command_that_was_under_way_for_too_long_is_not_obeyed_and_a_state_is(given_s, obeyed):
    taken, refused = [], []
    guard = ArrivalGuard(lambda: 10.0, command_age_s=0.7)
    for topic, body in ((ftm_topics.RESPAWN, fm.RespawnRequest(1, "DM1", 1, "RM3")),
                        (topics.POSE, m.Pose(0.0, 0.0, 0.0))):
        guard.receiver(topic, lambda _key, message: taken.append(message.stamp),
                       lambda _key, reason: refused.append(reason))(
            "k", encode(Header("RM3", 1, 1, given_s), body))
    assert taken == [given_s] * (2 if obeyed else 1)
    assert refused == ([] if obeyed else [f"a command, given {10.0 - given_s:.2f} s ago"])


async def test_a_handler_that_raises_ends_its_actor_only(make_bus):
    victim = Listener(Context("listener", 1, Clock(0.0), make_bus("listener", 1)))
    task = asyncio.create_task(victim.run())
    async with running(Talker, "talker", make_bus) as talker:
        await eventually(lambda: bool(victim.peers))
        talker.publish(ftm_topics.RESET, fm.Reset("RM1", "poison"))
        with pytest.raises(RuntimeError, match="poisoned"):
            await asyncio.wait_for(task, 5)
        talker.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
        with pytest.raises(ValueError, match="outputs do not declare"):
            talker.publish(topics.SCAN, m.LaserScan(0.0, 0.1, 8.0, b""))


@pytest.mark.parametrize(("age_s", "number"), [(0.1, 2), (0.5, 1)])
async def test_what_a_newcomer_hears_of_before_is_each_topics_last_if_that_is_no_silence(
        make_bus, age_s, number):
    order = m.GoalOrder("m1", 0, m.Goal(1.0, 2.0, m.Mode.TAXI), True)
    slow = 0.05  # on a busy machine the newcomer takes a while
    async with (running(Listener, "witness", make_bus, rate=slow) as witness,
                running(Talker, "talker", make_bus, rate=slow) as former):
        await eventually(lambda: bool(witness.peers))
        now_s = former.clock.now()
        former.publish(topics.GOAL, order, stamp=now_s - 100.0)
        former.publish(topics.POSE, m.Pose(1.0, 0.0, 0.0), stamp=now_s - age_s - 0.01)
        former.publish(topics.POSE, m.Pose(2.0, 0.0, 0.0), stamp=now_s - age_s)
        former.publish(ftm_topics.RESET, fm.Reset("RM1", "you"))
        await eventually(lambda: {fm.Reset("RM1", "you"), m.Pose(2.0, 0.0, 0.0)} <= {
            body for body, _ in witness.heard})  # all of it is past the router
        async with running(Listener, "listener", make_bus, rate=slow) as newcomer:
            await eventually(lambda: len(newcomer.heard) >= number)
            former.publish(ftm_topics.RESET, fm.Reset("RM2", "you"))
            await eventually(lambda: len(newcomer.heard) > number)
            said = [body for body, _ in newcomer.heard]
            assert order in said
            assert [body for body in said if isinstance(body, m.Pose)] == [
                m.Pose(2.0, 0.0, 0.0)][:number - 1]
            assert said[-1] == fm.Reset("RM2", "you"), "a command is given once, to those present"


async def test_what_a_node_has_no_use_for_in_this_life_does_not_reach_it(make_bus):
    class Deaf(Listener):
        def listens(self, topic) -> bool:
            return topic is not topics.POSE

    async with talking(make_bus, Deaf) as (deaf, talker):
        talker.publish(topics.POSE, m.Pose(1.0, 2.0, 0.5))
        talker.publish(ftm_topics.RESET, fm.Reset("RM1", "you"))
        await eventually(lambda: bool(deaf.heard))
        assert [message for message, _ in deaf.heard] == [fm.Reset("RM1", "you")]


def test_no_actor_takes_a_name_that_the_base_needs_for_itself():
    """Python would let it happen in silence: a node's `_held` once stopped the node's mailbox."""

    def assigned(cls: type) -> set[str]:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
        return {node.attr for node in ast.walk(tree)
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
                and isinstance(node.value, ast.Name) and node.value.id == "self"}

    system = systems.load(None)
    classes = {base for node in system.actors() for base in load_class(node.actor).__mro__
               if issubclass(base, Actor) and base is not Actor}
    classes |= {Supervisor, load_class(Osmosis.observer)}
    assert len(classes) > 15
    own = assigned(Actor) | {name for base in (Actor, Declared) for name in vars(base)
                             if name.startswith("_") and not name.startswith("__")}
    own -= {"_handlers", "_periodic", "_with_heartbeat"}  # of each class its own
    taken = {cls.__name__: names for cls in classes if (names := assigned(cls) & own)}
    assert taken == {}


@pytest.mark.parametrize(("base", "name"), [
    (Actor, "clock"), (Actor, "publish"), (DetectionModule, "state"), (DetectionModule, "activate"),
    (RecoveryModule, "activated"), (RecoveryModule, "act")])
def test_a_handler_with_a_name_that_the_base_class_has_is_refused(base, name):
    """Before, the base class's value took its place, or it that of the base class, in silence."""
    with pytest.raises(TypeError, match=rf"^Own\.{name}: \w+ has this name already"):
        type("Own", (base,), {name: every(1.0)(lambda self: None)})


class Stopless(Actor):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.stop = False


async def test_an_attribute_that_hides_a_method_is_refused_before_the_node_works():
    node = Stopless(Context("own", 1, Clock(0.0), VirtualBus(Hub(), "own")))
    with pytest.raises(TypeError, match=r"Stopless\.stop: Actor has a method of this name"):
        await node.run()


# -- a repeated state is posted: it is sent when it changes, and once a second


PERIOD_S = 0.1
"""Default period of heartbeats."""


class Level(Message, frozen=True):
    """A level."""

    value: float


LEVEL = Topic("level", Level, Qos.STATE, 10, "", "A level.", resend_s=1)


class Gauge(Actor):
    """Publishes a level ten times a second."""

    outputs = (LEVEL,)
    value: ClassVar[float] = 1.0

    @every(0.1)
    def say(self):
        self.publish(LEVEL, Level(type(self).value))


class Reader(Actor):
    """Keeps the levels and heartbeats of the gauge, with their arrival times."""

    def on_start(self):
        self.levels, self.ages_s, self.beats = [], [], 0

    @classmethod
    def names(cls, topic, name, parameters):
        return ("gauge",)

    @on(LEVEL)
    def level(self, message, header):
        self.levels.append((self.clock.now(), message.value, header.stamp))
        self.ages_s.append(self.came_s(header) - header.stamp)

    @on(HEARTBEAT)
    def beat(self, _message, _header):
        self.beats += 1


@asynccontextmanager
async def postings():
    Gauge.value = 1.0
    async with VirtualSystem() as system:
        sent = system.overhear("gauge")
        reader = system.start("reader", Reader)
        system.start("gauge", Gauge)
        await asyncio.sleep(0.5)
        yield system, reader, sent


def count(sent, key):
    return sum(k == key for k, _ in sent)


@within(postings)
async def test_what_says_the_same_is_sent_once_a_second_and_a_change_at_once(given):
    _system, reader, sent = given
    sent.clear()
    reader.levels.clear()
    reader.beats = 0
    await asyncio.sleep(10.0)
    assert count(sent, "level") == pytest.approx(10, abs=1)
    assert count(sent, "heartbeat/gauge") == pytest.approx(2, abs=1)
    assert len(reader.levels) == pytest.approx(100, abs=2)
    assert reader.beats == pytest.approx(100, abs=2)
    assert all(now_s - stamp_s <= 2 * PERIOD_S for now_s, _, stamp_s in reader.levels)
    assert max(reader.ages_s) == pytest.approx(0.0)  # it came when it was posted
    stamps = [stamp_s for _, _, stamp_s in reader.levels]
    assert stamps == sorted(set(stamps))  # each was taken once, by whatever way it came
    sent.clear()
    reader.levels.clear()
    Gauge.value = 2.0
    await asyncio.sleep(0.25)
    assert count(sent, "level") == 1
    changed = next((now_s, stamp_s) for now_s, value, stamp_s in reader.levels if value == 2.0)
    assert changed[0] == pytest.approx(changed[1])


@within(VirtualSystem)
async def test_the_heart_beats_at_the_period_that_the_system_states(system):
    reader = system.start("reader", Reader)
    system.start("gauge", lambda context: Gauge(replace(context, heartbeat_period_s=3.0)))
    await asyncio.sleep(31.0)
    assert reader.beats == pytest.approx(10, abs=1)


@within(postings)
async def test_one_that_hangs_posts_no_more_and_one_that_goes_on_does_again(given):
    system, reader, _sent = given
    gauge = system.actors["gauge"]
    gauge.hold(True)
    await asyncio.sleep(2 * PERIOD_S)
    reader.beats = 0
    await asyncio.sleep(2.0)
    assert reader.beats == 0
    gauge.hold(False)
    await asyncio.sleep(2 * PERIOD_S)
    assert reader.beats >= 1
