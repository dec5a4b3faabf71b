"""The verbs of `rampart` against living actors over real Zenoh."""

from __future__ import annotations

import asyncio
import json
import math
import re
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.messages import MissionPhase
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.fault_watch import Order
from rampart.actors.runtime.run_context import RunContext
from rampart.cli import systems
from rampart.cli.main import main
from rampart.cli.run_picture import RunPicture, draw
from rampart.cli.session import connect
from tests.porter_actors import AXLE, LOAD, Axle, Load, write_porter_system

RATE = 5.0


class Everything(Actor):
    """Publishes what verbs look at; one node that plays them all."""

    outputs = (topics.POSE, topics.ROUTE, topics.MISSION_STATUS, topics.PILOT_STATUS,
               ftm_topics.MANAGER_STATUS, ftm_topics.NODES, topics.OBSTACLES,
               ftm_topics.DETECTION, LOAD, AXLE, ftm_topics.HOLDS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.latched: tuple[str, ...] = ("RM1",)
        self.obstinate = False
        self.refusal = ""
        self.holders: tuple[str, ...] = ()
        self.obstacles: dict[str, m.ObstacleCommand] = {}
        self.resets = 0
        self.orders: list[bm.Injection] = []
        self.actuator_faults: list[m.ActuatorFault] = []
        self.time_s = 0.0

    @every(0.1)
    def states(self) -> None:
        self.time_s += 0.1
        self.publish(topics.POSE, m.Pose(1.0, self.time_s, 0.0))
        self.publish(LOAD, Load(20.0))
        for axle in ("simulator", "front"):  # one is the name of the node
            self.publish(AXLE, Axle(3.0), name=axle)
        self.publish(topics.MISSION_STATUS, m.MissionStatus(
            "1", "AB", m.MissionPhase.RUNNING, 0, (m.Goal(0.0, 0.0, m.Mode.TAXI),), (), (), ""))
        self.publish(topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.STOP, True, "RM2", 0))
        self.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus(
            ("FTM1",), (), self.latched, self.latched, "safety-first", 1))
        self.publish(ftm_topics.NODES, fm.NodeTable((
            fm.NodeInfo("hmi", "non-control", 42, fm.NodeState.CRASHED, 3, 2),
            fm.NodeInfo("DM1", "detection", 43, fm.NodeState.RUNNING, 1, 0))))
        self.list_obstacles()
        if self.holders:
            self.publish(ftm_topics.HOLDS, fm.Holds("brake", self.holders))

    @on(topics.ACTUATOR_FAULT)
    def actuator(self, message: m.ActuatorFault, _header: Header) -> None:
        def tell(affected: int, *, finished: bool) -> None:
            self.publish(bus_topics.INJECTION_REPORT, bm.InjectionReport(
                message.injection, self.name, affected, finished, ""))

        self.actuator_faults.append(message)
        if message.duration_s == 0:
            tell(0, finished=True)
            return
        tell(1, finished=False)
        if math.isfinite(message.duration_s):
            self.call_later(message.duration_s, lambda: tell(40, finished=True))

    def list_obstacles(self) -> None:
        self.publish(topics.OBSTACLES, m.ObstacleList(tuple(self.obstacles.values())))

    @on(ftm_topics.RESET)
    def reset(self, message: fm.Reset, _header: Header) -> None:
        self.resets += 1
        if self.refusal:
            self.report_diagnostic(fm.RESET_REFUSED, self.refusal, message.recovery)
        elif not self.obstinate:
            self.latched = ()
            self.holders = tuple(name for name in self.holders if name != message.recovery)
            self.publish(ftm_topics.HOLDS, fm.Holds("brake", self.holders))

    @on(topics.OBSTACLE)
    def obstacle(self, message: m.ObstacleCommand, header: Header) -> None:
        if message.radius_m > 5:
            self.report_diagnostic("obstacle", "too big", header.source)
        elif message.present:
            self.obstacles[message.name] = message
        else:
            del self.obstacles[message.name]

    def _on_injection(self, order: bm.Injection, _header: Header) -> None:
        self.orders.append(order)
        super()._on_injection(order, _header)


class Bystander(Actor):
    """Another node, so that commands have more than one receiver."""


class Run:
    """Calls the toolbox in a thread, as the shell would in a process."""

    def __init__(self, node: Actor, bus: ZenohBus, info: RunInfo, capsys) -> None:
        self.node = node
        self.info = info
        self.bus = bus
        self.capsys = capsys

    async def call(self, *arguments: str) -> tuple[int, str, str]:
        code = await asyncio.to_thread(main, list(arguments))
        captured = self.capsys.readouterr()
        return code, captured.out, captured.err

    async def out(self, *arguments: str) -> str:
        code, out, err = await self.call(*arguments)
        assert code == 0, err
        return out

    async def err(self, code: int, *arguments: str) -> str:
        found, _, err = await self.call(*arguments)
        assert found == code
        return err


@asynccontextmanager
async def running(monkeypatch, capsys, folder, *nodes):
    """Run nodes on a bus: name, class and fields of the context; yields a `Run` with the first."""
    loop = asyncio.get_running_loop()
    clock = Clock(loop.time(), RATE, loop.time)
    info = RunInfo(1, 7450, RATE, clock.source_time(0.0), str(systems.DEFAULT), folder,
                   tuple(name for name, *_ in nodes), "r1", 0, "test run", plan={"mission": "AB"})
    monkeypatch.setattr("rampart.cli.session.find_run", lambda _port: info)
    monkeypatch.setattr("rampart.actors.bus.run_info.find_runs", list)  # those of others
    async with AsyncExitStack() as stack:
        started = []
        for name, kind, more in nodes:
            bus = ZenohBus(name, endpoints(folder))
            node = kind(Context(name, 1, clock, bus, **more))
            stack.push_async_callback(asyncio.wait_for, asyncio.create_task(node.run()), 5)
            stack.callback(node.stop)
            started.append((node, bus))
        await asyncio.sleep(0.1)
        yield Run(*started[0], info, capsys)


@pytest.fixture
async def run(monkeypatch, capsys, bus_folder):
    async with running(monkeypatch, capsys, bus_folder, ("simulator", Everything, {}),
                       ("DM1", Bystander, {})) as made:
        yield made


async def test_status_shows_the_run_at_a_glance_and_as_json(run):
    out = await run.out("status")
    assert "test run" in out
    assert "mission   AB running, step 1 of 1, 0 lights measured" in out
    assert "pilot     stop, STOPPED: RM2" in out
    assert "manager   safety-first, decision 1; ACTIVE FTM1; recovery RM1; latched RM1" in out
    assert "nodes     1 of 2 running, 2 restarts; hmi crashed" in out
    for name in ("FTM1", "RM1"):
        assert f"clearing  {name} clears by operator (role drive) once its error is gone" in out
    out = await run.out("status", "--json")
    status = json.loads(out)
    assert (status["mission"]["phase"], status["pilot"]["mode"]) == ("running", "stop")
    assert status["manager"]["latched"] == ["RM1"]
    assert status["time_s"] > 0
    assert re.search(r"hmi +non-control +42 +crashed +3 +2", await run.out("node", "list"))
    out = await run.out("node", "list", "--json")
    assert json.loads(out)[0] == {"name": "hmi", "kind": "non-control", "pid": 42,
                                  "state": "crashed", "incarnation": 3, "restarts": 2}


async def test_status_shows_nothing_that_the_system_has_not(run, monkeypatch):
    publish = run.node.publish
    monkeypatch.setattr(run.node, "publish", lambda topic, *rest, **more: None if topic in (
        topics.MISSION_STATUS, topics.PILOT_STATUS, ftm_topics.MANAGER_STATUS
        ) else publish(topic, *rest, **more))
    run.info.plan["mission"] = ""
    out = await run.out("status")
    assert "nodes     1 of 2 running" in out
    for word in ("mission", "pilot", "manager", "silent"):
        assert word not in out
    run.info.plan["mission"] = "AB"
    out = await run.out("status")
    assert "mission   silent" in out


async def test_a_viewer_is_refused_before_anything_else_is_checked(run, monkeypatch):
    monkeypatch.setattr("rampart.cli.session.tools_credentials", lambda _run: (None, "viewer"))
    run.node.latched = ()
    for verb in (("reset", "RM1"), ("reset", "rampart-4711"), ("obstacle", "remove", "crate")):
        err = await run.err(2, *verb)
        assert "viewer" in err


NO_TEXT = b"\x95\xa1\xff\x01\x01\xcb" + bytes(8) + b"\x90"


@pytest.mark.parametrize("garbage", [b"\xc1garbage", NO_TEXT])
async def test_echo_shows_garbage_as_such_with_the_reason(run, garbage):
    async def spoil() -> None:
        while True:
            run.bus.publish(topics.ROUTE, topics.ROUTE.at(), garbage)
            await asyncio.sleep(0.02)

    spoiler = asyncio.create_task(spoil())
    out = await run.out("topic", "echo", "plan/route", "-n", "1")
    assert out.startswith(f"garbage plan/route {len(garbage)} bytes, not a Route: ")
    out = await run.out("topic", "echo", "plan/route", "-n", "1", "--json")
    spoiler.cancel()
    assert json.loads(out)["garbage"] == garbage.hex()


async def test_a_silent_topic_is_said_to_be_silent(run):
    code, out, err = await run.call("topic", "echo", "plan/route", "--duration", "0.2")
    assert (code, out) == (1, "")
    assert err == "rampart: no message on plan/route within 0.2 s\n"


@pytest.mark.parametrize("verb", ["echo", "hz"])
async def test_echo_and_hz_end_with_the_run(run, monkeypatch, verb):
    looks = iter([False, False])
    monkeypatch.setattr("rampart.cli.look.topic_verbs.is_over", lambda _run: next(looks, True))
    code, out, err = await run.call("topic", verb, "localization/pose")
    assert code == 0
    assert "localization/pose" in out
    assert err == "rampart: the run has ended: test run (port 7450)\n"


async def test_hz_measures_in_simulated_time(run):
    out = await run.out("topic", "hz", "localization/pose", "--duration", "1.5")
    name, rate_hz, unit = out.splitlines()[-1].split()
    assert (name, unit) == ("localization/pose:", "Hz")
    assert 5 < float(rate_hz) < 15


async def test_topics_of_the_robot_s_own_are_heard_counted_and_disturbed(
        run, capsys, monkeypatch, tmp_path):
    own = msgspec.structs.replace(run.info, system_file=str(write_porter_system(tmp_path)))
    monkeypatch.setattr("rampart.cli.look.topic_verbs.find_run", lambda _port: own)
    monkeypatch.setattr("rampart.cli.session.find_run", lambda _port: own)
    code, out, _ = await run.call("topic", "echo", "porter/axle/*", "-n", "4")
    assert (code, {line.split(" ", 1)[1] for line in out.splitlines()}) == (
        0, {f"simulator#1 porter/axle/{name} [3.0]" for name in ("front", "simulator")})
    out = await run.out("inject", "zero:porter/load", "--duration", "1", "--json")
    assert json.loads(out)["effective"] is True
    rates_hz = (await pictured()).rates()
    assert rates_hz[LOAD.key] == pytest.approx(rates_hz[topics.POSE.key], rel=0.3)
    assert rates_hz[AXLE.key] == pytest.approx(2 * rates_hz[LOAD.key], rel=0.3)
    assert capsys.readouterr().err == ""
    spec = tmp_path / "porter.toml"
    monkeypatch.setattr("rampart.cli.session.find_run", lambda _port: msgspec.structs.replace(
        own, system_file=str(spec)))
    spec.write_text(Path(own.system_file).read_text().replace(
        "tests.porter_actors:", "elsewhere.porter:"))
    picture = await pictured()
    assert picture.rates()[topics.POSE.key] > 0
    err, = capsys.readouterr().err.splitlines()
    assert "elsewhere.porter" in err
    assert err.endswith("; only topics of the engine are counted")


async def pictured() -> RunPicture:
    """Return what `rampart top` and `rampart live metrics` have of a run."""
    picture = RunPicture()
    async with connect() as session:
        draw(session, picture)
        for _ in range(8):
            picture.sample(session.clock.now())
            await asyncio.sleep(0.1)
    return picture


async def test_an_injection_acts_and_tells_how_many_messages_it_affected(run):
    out = await run.out("inject", "localization-not-updated", "--duration", "2", "--json")
    told = json.loads(out)
    assert told["effective"] is True
    (injection,) = told["injections"]
    assert injection["nodes"] == ["simulator"]
    assert injection["finished"] is True
    assert 10 < injection["affected"] < 30
    assert len(run.node.orders) == 1, "copies of an order must not reach the actor"


async def test_a_fault_of_the_robot_s_own_is_carried_out_by_its_node(run):
    code, out, _ = await run.call("inject", "stuck-wheel:rear-left", "--duration", "1")
    assert (code, out) == (0, "stuck-wheel:rear-left: in force at simulator for 1 s\n"
                              "stuck-wheel:rear-left: over, 40 ticks changed\n")
    (ordered,) = run.node.actuator_faults
    assert (ordered.wheel, ordered.duration_s) == ("rear left", 1.0)
    code, out, _ = await run.call("inject", "brake-failure", "--duration", "inf", "--json")
    told = json.loads(out)
    assert (code, told["effective"], told["fault"]) == (0, True, "brake-failure")
    (one,) = told["injections"]
    assert (one["topic"], one["mode"], one["duration_s"], one["finished"]) == (
        "world/actuator_fault", None, None, False)


async def test_a_fault_without_end_goes_on_when_the_verb_returns(run):
    out = await run.out("inject", "stuck:localization/pose", "--duration", "inf")
    assert "takes effect, and continues" in out
    out = await run.out("topic", "echo", "localization/pose", "-n", "3", "--json")
    assert len({json.loads(line)["message"]["y_m"] for line in out.splitlines()}) == 1


@pytest.mark.parametrize(("arguments", "code", "words"), [
    (["inject", "command-not-updated", "--duration", "1"], 1,
     "no effect: no node publishes control/command in this run"),
    (["inject", "wrong-graph", "--duration", "1"], 1,
     "no effect: simulator published no message on plan/route that it changed within 1 s"),
    (["inject", "drop:detection/DM9", "--duration", "1"], 2,
     "unknown node 'DM9'"),
    (["topic", "echo", "detection/DM9"], 2, "unknown node 'DM9'; known: simulator, DM1")])
async def test_what_has_no_effect_says_so_and_fails(run, arguments, code, words):
    found, _, err = await run.call(*arguments)
    assert found == code
    assert words in err


async def test_a_permanent_fault_without_effect_is_ended_and_said_to_have_none(run):
    err = await run.err(1, "inject", "drop:plan/route", "--duration", "inf")
    assert "no effect: simulator published no message on plan/route" in err
    assert run.node.orders[-1].duration_s == 0.0


async def test_a_fault_that_does_not_fit_its_messages_is_refused_by_the_node(run, monkeypatch):
    unfit = bm.Injection("i1", "localization/pose", "restamp", 1.0)
    monkeypatch.setattr("rampart.cli.operate.inject_verb.orders_of", lambda _: (
        "restamp", (Order(bus_topics.INJECT, unfit),)))
    err = await run.err(1, "inject", "restamp")
    assert "no effect: refused by simulator: stamp_s = 0" in err


async def test_reset_releases_a_latched_recovery_once_or_says_why_not(run):
    run.node.refusal = "FTM1 never clears; only a new run ends it"
    assert "RM1 was not released: FTM1 never clears" in await run.err(1, "reset", "RM1")
    run.node.refusal, run.node.obstinate = "", True
    assert await run.err(1, "reset", "RM1") == "rampart: RM1 was not released; active: FTM1\n"
    run.node.obstinate, run.node.resets = False, 0
    assert await run.out("reset", "RM1") == "RM1 released\n"
    assert run.node.resets == 1
    err = await run.err(1, "reset", "RM1")
    assert err == "rampart: no effect: RM1 is not latched; latched: none\n"
    err = await run.err(2, "reset", "RM9")
    assert "unknown recovery 'RM9'; known: RM1, RM2" in err


async def test_status_names_who_holds_the_brake_and_reset_lets_go_in_its_place(run):
    run.node.holders = ("x\x1b", "y")
    out = await run.out("status")
    assert "held      brake by x\\u001b, not a recovery module of this system" in out
    out = await run.out("status", "--json")
    assert json.loads(out)["holders"] == {"x\x1b": ["brake"], "y": ["brake"]}
    err = await run.err(2, "reset", "z")
    assert err.endswith(", x\\u001b, y\n")
    assert await run.out("reset", "y") == "y released: brake\n"
    run.node.obstinate = True
    err = await run.err(1, "reset", "x\x1b")
    assert "still holds brake" in err


async def test_obstacles_come_move_and_go(run):
    await run.out("obstacle", "add", "crate", "-1", "2.5")
    await run.out("obstacle", "add", "crate", "3", "2.5")
    out = await run.out("obstacle", "list", "--json")
    assert json.loads(out) == [{"name": "crate", "x_m": 3.0, "y_m": 2.5, "radius_m": 0.4}]
    wide = ("obstacle", "add", "crate", "3", "2.5", "--radius", "1")
    await run.out(*wide)
    assert run.node.obstacles["crate"].radius_m == 1.0
    err = await run.err(2, "obstacle", "remove", "box")
    assert err == "rampart: unknown obstacle 'box'; known: crate\n"
    await run.out("obstacle", "remove", "crate")
    assert run.node.obstacles == {}
    err = await run.err(1, "obstacle", "add", "moon", "1", "2", "--radius", "9")
    assert err == "rampart: no effect: too big\n"


GOALS = (m.Goal(1.0, 2.0, m.Mode.TAXI), m.Goal(3.0, 4.0, m.Mode.TAXI))
REQUEST = m.MissionRequest("r1/first", "AB", GOALS)


class Planner(Actor):
    """Stands for the rest: it tells the first route, so that home is known."""

    outputs = (topics.MISSION_REQUEST, topics.ROUTE, ftm_topics.MANAGER_STATUS)


@pytest.fixture
async def mission_run(monkeypatch, capsys, bus_folder):
    on_map = RunContext(application=Osmosis.on_map(load_airport("vallombre")))
    async with running(monkeypatch, capsys, bus_folder,
                       ("mission_manager", MissionManager,
                        {"parameters": {"held_by": ["RM2"]}, "run": on_map}),
                       ("planner", Planner, {"run": on_map})) as made:
        yield made


def begin(run: Run) -> None:
    """Have the Mission Manager under way, with a home to return to."""
    run.node.request(REQUEST, None)
    run.node.route(m.Route("r1/first", 0, m.Mode.TAXI, True, ((0.0, 0.0), (1.0, 2.0)), ""), None)


async def test_an_order_reaches_the_mission_once_with_its_reason(mission_run):
    begin(mission_run)
    told = json.loads(await mission_run.out("mission", "replan", "--json"))
    assert (told["accepted"], told["plan"], mission_run.node.state.plan) == (True, 1, 1)
    assert told["mission"].items() >= {"mission_id": "r1/first", "name": "AB", "phase": "running",
                                       "goals": 2}.items()
    out = await mission_run.out("mission", "pause", "--reason", "runway in use")
    assert out == ("pause obeyed; mission AB paused, step 1 of 2, 0 lights measured: "
                   "operator: runway in use\n")
    assert mission_run.node.state.phase is MissionPhase.PAUSED


async def test_an_order_that_makes_no_sense_is_refused_with_the_reason_and_exit_code_1(mission_run):
    error = await mission_run.err(1, "mission", "pause")
    assert error == "rampart: pause refused: no mission is under way\n"
    begin(mission_run)
    code, out, _ = await mission_run.call("mission", "resume", "--json")
    told = json.loads(out)
    assert (code, told["accepted"]) == (1, False)
    assert told["reason"] == "the mission is not paused but running"


async def test_without_an_answer_the_verb_says_so(mission_run, monkeypatch):
    monkeypatch.setattr(MissionManager, "publish", lambda *_: None)
    monkeypatch.setattr("rampart.cli.osmosis.mission_verb._ANSWER_S", 0.5)
    code, out, err = await mission_run.call("mission", "pause")
    assert (code, out) == (1, "")
    assert err == "rampart: no effect: the Mission Manager did not answer within 0.5 s\n"
