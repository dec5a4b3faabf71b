"""The gateway in virtual time: what it passes on, and what it does not."""

import asyncio
import json
import tempfile
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from rampart.actors.bus.topics import DIAGNOSTIC
from rampart.actors.ros2.ros_nodes import GRAPH, RosGraphReport
from rampart.actors.ros2.stand_in import StandIn
from rampart.actors.ros2.translation.types import SHIPPED
from rampart.actors.ros2.wire import Qos
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.testing import Ear, VirtualSystem
from tests.virtual_time import within

SYSTEM = """
name = "guarded"
title = "A robot in ROS 2"

[[node]]
name = "gateway"
actor = "rampart.actors.ros2.gateway:Gateway"
kind = "non-control"
respawn = "R_RESTART"

[[node]]
name = "driver"
actor = "tests.actors.ros2.robot:Driver"
kind = "control"
respawn = "R_RESTART"

[[node]]
name = "base"
actor = "tests.actors.ros2.robot:Base"
kind = "world"

[[node]]
name = "manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"

[[detection]]
name = "D_CRASH"
title = "A node has crashed"
actor = "rampart.actors.detection.watchdog:Watchdog"
parameters = { watch = ["driver", "gateway"], timeout_s = "heartbeat_timeout_s" }

[[recovery]]
name = "R_RESTART"
title = "Restart it"
actor = "rampart.actors.recovery.respawn:Respawn"
kind = "masking"

[[mechanism]]
name = "M_CRASH"
detect = "D_CRASH"
recover = "R_RESTART"
event = "stands"
against = { within_s = 5.0, hazard = "the robot stands" }

[[event]]
name = "stands"
gate = "or"
of = ["crash", "missing"]

[[event]]
name = "crash"

[[event]]
name = "missing"

[orders.safer]

[[ros2]]
subscribe = "/odom"
type = "nav_msgs/msg/Odometry"
to = "base/odometry"
frame = "odom"

[[ros2]]
publish = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
from = "base/wanted"
stop_after_s = 0.2
"""


def configured(more="", **parameters):
    """Return the system with parameters of its gateway; `more` is TOML."""
    given = [f"{name} = {json.dumps(value)}" for name, value in parameters.items()]
    actor = 'actor = "rampart.actors.ros2.gateway:Gateway"\n'
    return SYSTEM.replace(actor, f"{actor}parameters = {{ {', '.join(given)}{more} }}\n")


def beside_foreign(**parameters):
    """Return the system for a base that another implementation plays: a node calls its service."""
    return configured(**parameters).replace(
        'robot:Base"\nkind = "world"', 'robot:Asker"\nkind = "control"') + SERVICE


@asynccontextmanager
async def loaded(text):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "guarded.toml")
        path.write_text(text)
        async with VirtualSystem.load(path) as system:
            yield system


SERVICE = """
[[ros2]]
call = "/base/shut"
type = "std_srvs/srv/SetBool"
from = "base/shut"
to = "base/is_shut"
within_s = 0.5
"""


def beside(more="", base=SYSTEM):
    """Run a test in virtual time with a system beside ROS 2, which is its first argument."""
    return within(lambda: loaded(base + more))


def refusal(tmp_path, text):
    """Return the line with which a system is refused before anything runs."""
    path = tmp_path / "guarded.toml"
    path.write_text(text)
    plan = RunPlan(system_file=str(path))
    with pytest.raises(ValueError, match=r"guarded\.toml: [^\n]+\Z") as raised:
        Layout(plan, load_system(plan))
    return str(raised.value)


def start(system, *names):
    """Start nodes, and return them."""
    return [system.start_node(name) for name in names]


def watched(system):
    """Start the gateway; return it, what it passes on of /odom, and its diagnostics."""
    gateway = system.start_node("gateway")
    return (gateway, system.hear(gateway.chosen_topic("base/odometry")),
            system.hear(DIAGNOSTIC, "gateway"))


@beside()
async def test_messages_pass_both_ways_and_zeros_when_the_system_falls_silent(system):
    gateway, odometry, _ = watched(system)
    base, _ = start(system, "base", "driver")
    await asyncio.sleep(2.0)
    assert len(base.heard) == pytest.approx(39, abs=2)
    assert set(base.heard) == {0.5}
    assert len(odometry) == pytest.approx(39, abs=2)
    last = odometry[-1].message
    assert (last.x_m, last.linear_mps) == (pytest.approx(base.x_m), 0.5)
    await system.kill("driver")
    await asyncio.sleep(0.35)
    assert base.heard[-1] == 0.0
    await asyncio.sleep(10.0)
    await system.stop(gateway.name)  # it has nothing to cancel
    await asyncio.sleep(0.5)
    assert base.heard.count(0.0) == 20


@beside(base=SYSTEM.replace("stop_after_s = 0.2", "rate_hz = 5").replace(
    'frame = "odom"', 'frame = "odom"\nrate_hz = 5'))
async def test_a_table_passes_at_most_its_rate_and_without_stop_after_s_no_zero_ends_it(system):
    _, odometry, _ = watched(system)
    base, _ = start(system, "base", "driver")
    await asyncio.sleep(2.0)
    assert len(base.heard) == pytest.approx(10, abs=1)
    assert len(odometry) == pytest.approx(10, abs=1)
    await system.stop("gateway")
    await asyncio.sleep(0.5)
    assert base.heard[-1] == 0.5


@beside()
async def test_at_an_orderly_end_ros_2_gets_one_last_zero(system):
    base, *_ = start(system, "base", "gateway", "driver")
    await asyncio.sleep(1.0)
    assert base.heard[-1] == 0.5
    await system.stop("gateway")
    await asyncio.sleep(0.5)
    assert (base.heard.count(0.0), base.heard[-1]) == (1, 0.0)


@beside()
async def test_a_second_publisher_is_refused_and_one_that_is_silent_is_said_to_be_killed(system):
    _, odometry, told = watched(system)
    base = system.start_node("base")
    await asyncio.sleep(0.5)
    other = base.publisher("/odom", "nav_msgs/msg/Odometry")
    message = base.types.blank("nav_msgs/msg/Odometry")
    message.header.frame_id, message.pose.pose.position.x = "odom", 99.0
    other(message)
    await asyncio.sleep(1.0)
    base.say_odometry = lambda _message: None
    await asyncio.sleep(0.3)
    other(message)
    await asyncio.sleep(0.1)
    assert [one.message.reason.partition("base; ")[2] for one in told] == [
        "only the first one is passed on", "the first one is silent, probably a killed one, which "
        "is in the graph until its lease ends; the other is passed on after 1 s"]
    assert 99.0 not in {heard.message.x_m for heard in odometry}
    await asyncio.sleep(1.0)
    other(message)
    await asyncio.sleep(0.1)
    assert odometry[-1].message.x_m == 99.0


@beside()
async def test_a_topic_that_no_node_publishes_is_reported_once_and_named_until_it_comes(system):
    gateway, odometry, told = watched(system)
    graph = system.hear(GRAPH, "gateway")
    await asyncio.sleep(4.0)
    assert graph[-1].message.problems == ()  # the nodes of ROS 2 may still be starting
    await asyncio.sleep(4.0)
    why = "no node publishes it in domain 0; `rampart ros2 check` looks for the cause"
    assert graph[-1].message.problems == (f"/odom: {why}",)
    assert [(one.message.offender, one.message.reason) for one in told] == [("/odom", why)]
    gateway.graph.changed = lambda _token, _alive: None  # as with a rule that denies liveliness
    system.start_node("base")
    await asyncio.sleep(1.5)
    assert odometry
    assert graph[-1].message.problems == ()


@beside(base=SYSTEM.replace('frame = "odom"\n', 'frame = "odom"\npublisher = "/robot/base"\n'))
async def test_messages_of_another_node_than_the_named_one_never_pass(system):
    _, odometry, told = watched(system)
    graph = system.hear(GRAPH, "gateway")
    stranger = system.start("stranger", StandIn)
    await system.settle()
    say = stranger.publisher("/odom", "nav_msgs/msg/Odometry")
    for _ in range(60):  # it is the only publisher
        say(stranger.types.blank("nav_msgs/msg/Odometry"))
        await asyncio.sleep(0.05)
    assert not odometry
    assert graph[-1].message.refused > 30
    assert "published by /stranger; expected /robot/base" in told[-1].message.reason
    for _ in range(2):  # another id, the same name
        system.start_node("base")
        await asyncio.sleep(1.0)
        assert "/odom: /stranger publishes; only messages of /robot/base are passed on" in (
            graph[-1].message.problems)
        await system.kill("base")
        count = len(odometry)
        await asyncio.sleep(3.0)  # longer than the silence after which another one may take over
        assert len(odometry) == count > 15
        odometry.clear()


def asked(system, gateway, key, **fields):
    topic = gateway.chosen_topic(key)
    system.say(topic, msgspec.convert(fields, topic.type), source="driver")


CALL = """
[[node]]
name = "asker"
actor = "tests.actors.ros2.robot:Asker"
kind = "control"
parameters = { topic = "base/shut" }
""" + SERVICE


@beside(CALL)
async def test_a_service_is_called_and_its_answer_or_that_there_is_none_is_told(system):
    base = system.start_node("base")
    gateway = system.start_node("gateway")
    answers = system.hear(gateway.chosen_topic("base/is_shut"))
    await asyncio.sleep(0.1)
    asked(system, gateway, "base/shut", data=True)
    asked(system, gateway, "base/shut", data=True)  # while the first is under way
    await asyncio.sleep(0.2)
    asked(system, gateway, "base/shut", data=False)
    await asyncio.sleep(0.2)
    assert [(heard.message.done, heard.message.success, heard.message.message)
            for heard in answers] == [
                (True, True, "shut"), (True, False, "it has to be open")]
    assert base.shut == 2
    refused, told = [], system.hear(DIAGNOSTIC, "base")
    ask = gateway.node.client("/base/shut", "std_srvs/srv/SetBool")
    ask(b"nonsense", 0.2, lambda answer, why: refused.append((answer, why)))
    await asyncio.sleep(0.3)
    assert refused == [(None, "no server answers")]
    assert "begins with 6e 6f 6e 73" in told[0].message.reason
    await system.kill("base")
    asked(system, gateway, "base/shut", data=True)
    await asyncio.sleep(0.6)
    last = answers[-1].message
    assert (last.done, last.success, last.why) == (False, None, "no server answers")


GOAL = """
[[node]]
name = "asker"
actor = "tests.actors.ros2.robot:Asker"
kind = "control"
parameters = { topic = "nav/goal" }

[[ros2]]
goal = "/navigate_to_pose"
type = "nav2_msgs/action/NavigateToPose"
from = "nav/goal"
to = "nav/state"
frame = "map"
fields = { "pose.header.frame_id" = "'map'", "pose.pose.position.x" = "pose.pose.position.x" }
"""


@beside(GOAL)
async def test_an_action_is_given_a_goal_and_says_how_it_goes(system):
    base = system.start_node("base")
    gateway = system.start_node("gateway")
    states = system.hear(gateway.chosen_topic("nav/state"))
    await asyncio.sleep(0.1)
    topic = gateway.chosen_topic("nav/goal")
    goal = msgspec.to_builtins(topic.type())
    for x in (2.0, -2.0):
        goal["pose"]["pose"]["position"]["x"] = x
        asked(system, gateway, "nav/goal", **goal)
        await asyncio.sleep(0.3)
    await system.kill("base")
    asked(system, gateway, "nav/goal", **goal)
    await asyncio.sleep(1.5)
    assert [(heard.message.number, heard.message.phase) for heard in states] == [
        (1, "sent"), (1, "accepted"), (1, "succeeded"), (2, "sent"), (2, "rejected"),
        (3, "sent"), (3, "unanswered")]
    assert len(set(base.goals)) == 2


@pytest.mark.parametrize(("key", "what", "told"), [
    ("nav/goal", {}, ("phase", "rejected")), ("base/shut", {"data": True}, ("done", False))])
@beside(GOAL + CALL.replace("asker", "shutter"))
async def test_a_goal_or_request_that_comes_late_is_not_executed(system, key, what, told):
    """One that has waited for a hanging gateway, or for a stop to end, is out of date."""
    base = system.start_node("base")
    gateway = system.start_node("gateway")
    answers = system.hear(gateway.chosen_topic({"nav/goal": "nav/state"}.get(key, "base/is_shut")))
    await asyncio.sleep(0.1)
    topic = gateway.chosen_topic(key)
    system.say(topic, msgspec.convert(what, topic.type),
               stamp_s=system.clock.now() - 1.1)
    await asyncio.sleep(0.5)
    assert (base.goals, base.shut) == ([], 0)
    (answer,) = answers
    assert getattr(answer.message, told[0]) == told[1]
    assert answer.message.why.startswith("request of tester: 1.1 s old; expected at most")


@pytest.mark.parametrize(("offset_s", "words"), [
    (30.0, "its stamp is 30 s ahead of the wall clock"), (-7200.0, "is hours behind"),
    (-1.7e9, "if it is simulated time, the gateway needs clock = 'ros'")])
@beside()
async def test_a_stamp_that_cannot_be_true_is_refused_and_told(system, offset_s, words):
    _, odometry, told = watched(system)
    base = system.start_node("base")
    base.offset_ns = int(offset_s * 1e9)
    await asyncio.sleep(1.0)
    assert odometry == []
    assert words in told[0].message.reason
    assert told[0].message.offender == "/odom"
    base.offset_ns = -400_000_000
    await asyncio.sleep(0.5)
    last = odometry[-1]
    assert last.header.stamp == pytest.approx(system.clock.now() - 0.4, abs=0.06)


@beside()
async def test_what_is_no_message_or_no_rotation_is_refused_counted_and_told_once_a_second(system):
    gateway, odometry, told = watched(system)
    graph = system.hear(GRAPH, "gateway")
    base = system.start_node("base")
    await asyncio.sleep(1.0)
    say = base.say_odometry

    def turned(message):
        message.pose.pose.orientation.w = 2.0
        say(message)

    base.say_odometry = turned
    await asyncio.sleep(0.1)
    heard = len(odometry)
    await asyncio.sleep(3.0)
    assert len(odometry) == heard  # the topic falls silent
    assert graph[-1].message.refused == pytest.approx(60, abs=25)
    reasons = [one.message.reason for one in told if one.message.offender == "/odom"]
    assert "pose.pose.orientation = (x 0, y 0, z 0, w 2)" in reasons[0]
    assert len(reasons) <= 4
    key = next(one.key for one in gateway.graph.of("MS") if one.topic == "/odom")
    await system.kill("base")
    await asyncio.sleep(1.1)
    gateway._side.publisher(key, Qos())(b"\0\1\0\0nonsense", None)
    await asyncio.sleep(1.1)
    assert any("no attachment" in one.message.reason for one in told)


@beside(base=configured(interfaces=[str(SHIPPED / "humble")]))
async def test_definitions_that_replace_others_are_told_at_the_start(system):
    told = system.hear(DIAGNOSTIC, "gateway")
    system.start_node("gateway")
    await asyncio.sleep(0.5)
    words = {one.message.offender: one.message.reason for one in told}
    assert "replaces the one of jazzy" in words["nav2_msgs/action/NavigateToPose_Result"]


@beside(base=configured(clock="ros"))
async def test_with_a_clock_of_ros_2_its_stamps_are_simulated_time(system):
    _, odometry, told = watched(system)
    base = system.start_node("base")
    system.start_node("driver")
    await asyncio.sleep(1.0)
    assert odometry == []
    assert base.heard == []
    assert "no message has come on /clock" in told[0].message.reason
    tick = base.publisher("/clock", "rosgraph_msgs/msg/Clock", Qos(reliable=False))
    message = base.types.blank("rosgraph_msgs/msg/Clock")
    base.offset_ns = 100 * 10**9 - base.wall_ns()
    for _ in range(20):
        now_ns = base.wall_ns()
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
        tick(message)
        await asyncio.sleep(0.05)
    assert len(odometry) > 15
    assert odometry[-1].header.stamp == pytest.approx(system.clock.now(), abs=0.15)
    assert base.heard[-1] == 0.5


WATCH = """
[[detection]]
name = "D_ROS"
title = "A node of ROS 2 is missing, or the gateway is bypassed"
actor = "rampart.actors.ros2.ros_nodes:RosNodes"
within_s = 0.5
parameters = { gateway = "gateway", nodes = ["/robot/base"], alone = true, suspects = ["base"] }

[[recovery]]
name = "R_BASE"
title = "Restart the base"
actor = "rampart.actors.recovery.respawn:Respawn"
kind = "masking"
parameters = { nodes = ["base"] }

[[mechanism]]
name = "M_ROS"
detect = "D_ROS"
recover = "R_BASE"
event = "missing"
against = { within_s = 5.0, hazard = "the robot stands" }
"""


@beside(WATCH)
async def test_a_node_that_is_gone_and_a_publisher_past_the_gateway_are_detected(system):
    ear = system.start("ear", Ear)
    system.start_node("gateway")
    system.start_node("base")
    module = system.start_node("D_ROS")
    graph = system.hear(GRAPH, "gateway")
    await asyncio.sleep(1.5)
    assert ear.states[-1] == "idle"
    assert set(graph[-1].message.nodes) == {"/rampart", "/robot/base"}
    await system.kill("base")
    await asyncio.sleep(0.2)
    assert ear.states[-1] == "active"
    assert (module._report.reason, module._report.nodes) == (
        "/robot/base: not in the graph of ROS 2", ("base#1",))
    assert set(graph[-1].message.nodes) == {"/rampart"}
    base = system.start_node("base")
    await asyncio.sleep(1.0)
    assert ear.states[-1] == "idle"
    base.publisher("/cmd_vel", "geometry_msgs/msg/Twist")
    await asyncio.sleep(0.5)
    assert graph[-1].message.bypassed == 1
    assert graph[-1].message.problems[0] == "/cmd_vel: /robot/base publishes besides /rampart"
    assert ear.states[-1] == "active"


@beside(WATCH)
async def test_without_a_router_the_nodes_are_unknown_and_none_is_accused(system):
    ear = system.start("ear", Ear)
    module = system.start_node("D_ROS")

    async def told(seconds, *nodes, linked=True):
        for _ in range(round(seconds / 0.1)):
            system.say(GRAPH, RosGraphReport(linked, nodes, (), 0, ()), "gateway")
            await asyncio.sleep(0.1)
        return ear.states[-1], module._report.reason, module._report.nodes

    assert (await told(0.5, linked=False))[0] == "idle"  # there may be none yet
    assert (await told(0.5, "/robot/base"))[0] == "idle"
    assert await told(0.5, linked=False) == (
        "active", "gateway has no router of ROS 2: the nodes are unknown", ())
    assert (await told(2.0))[0] == "idle"  # a new router, which the node has not found yet
    assert (await told(0.5, "/robot/base"))[0] == "idle"
    assert await told(0.5) == ("active", "/robot/base: not in the graph of ROS 2", ("base",))


@pytest.mark.parametrize(("more", "why"), [
    ('subscribe = "/a"\ntype = "std_msgs/msg/Bool"', "to = 'key' of a topic of the system"),
    ('type = "std_msgs/msg/Bool"\nto = "a"', "one of subscribe, publish, call, goal"),
    ('subscribe = "/a"\npublish = "/b"\ntype = "std_msgs/msg/Bool"\nto = "a"',
     "found subscribe and publish"),
    ('subscribe = "/a"\ntype = "std_msgs/Bool"\nto = "a"', "ros2[2].type"),
    ('call = "/a"\ntype = "std_msgs/msg/Bool"\nfrom = "a"\nto = "b"', "package/srv/Name"),
    ('subscribe = "/odom"\ntype = "std_msgs/msg/Bool"\nto = "a"', "is in ros2[0] already"),
    ('subscribe = "/a"\ntype = "std_msgs/msg/Bool"\nto = "a"\ngateway = "x"',
     "unknown gateway; known: gateway"),
    ('publish = "/a"\ntype = "std_msgs/msg/Bool"\nfrom = "base/wanted"\npublisher = "/b"',
     "ros2[2].publisher"),
    ('subscribe = "/a"\ntype = "std_msgs/msg/Boole"\nto = "a"',
     "gateway: ros2 /a: type 'std_msgs/msg/Boole' is not known to jazzy"),
    ('publish = "/a"\ntype = "std_msgs/msg/Bool"\nfrom = "a"', "no actor has a topic 'a'"),
    ('publish = "/a"\ntype = "std_msgs/msg/Bool"\nfrom = "base/wanted"',
     "ros2 /a: fields: no field of std_msgs/msg/Bool has a value"),
    ('subscribe = "/a"\ntype = "std_msgs/msg/Bool"\nto = "a"\nanswer = { ok = true }',
     "ros2[2].answer"),
    ('subscribe = "/a"\ntype = "std_msgs/msg/Bool"\nto = "a"\nbeside = "b"', "ros2[2].beside"),
])
def test_a_table_that_cannot_be_is_refused_before_anything_runs(tmp_path, more, why):
    assert why in refusal(tmp_path, f"{SYSTEM}[[ros2]]\n{more}\n")
