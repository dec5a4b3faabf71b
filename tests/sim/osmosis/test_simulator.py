"""The simulator actor: topics, rates, stamps, and what it does with its inputs."""

from collections import Counter
from functools import partial

import numpy as np
import pytest

from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.runtime.actor import Header
from rampart.sim.osmosis.simulator import Simulator
from tests.sim.osmosis.bench import Bench

bench_at = partial(Bench, load_airport("vallombre"))


def test_every_topic_of_the_summit_xl_layer_and_the_world_comes_at_its_rate():
    bench = bench_at(upper_laser=True)
    bench.run(2.0)
    counts = Counter(key for key, _, _ in bench.sent)
    readings = [topic for topic in Simulator.outputs if topic is not ftm_topics.HOLDS]
    assert set(counts) == {topic.key for topic in readings}
    for topic in readings:
        assert counts[topic.key] == pytest.approx(2 * topic.rate_hz, abs=1)


def test_a_robot_with_one_laser_has_one_and_with_two_both_see_the_same_with_noise_of_their_own():
    one, two = bench_at(), bench_at(upper_laser=True)
    for bench in (one, two):
        bench.run(1.0)
    assert topics.UPPER_SCAN.key not in {key for key, _, _ in one.sent}
    assert one.last(topics.SCAN) == two.last(topics.SCAN)  # the second disturbs nothing
    lower, upper = (np.frombuffer(two.last(topic).ranges_f32, "<f4")
                    for topic in (topics.SCAN, topics.UPPER_SCAN))
    assert two.last(topics.SCAN).reference_m != two.last(topics.UPPER_SCAN).reference_m
    assert upper == pytest.approx(lower, abs=0.15)
    assert np.array_equal(upper >= 8.0, lower >= 8.0)


def test_commands_move_the_robot_and_the_brake_holds_it_until_the_last_who_holds_it_lets_go():
    bench = bench_at()
    start = bench.actor._world.pose
    bench.run(2.0, m.BaseCommand(0.5, 0.0))
    assert bench.last(topics.TRUTH).twist.linear_mps == pytest.approx(0.5, abs=0.02)
    assert bench.last(topics.ABSOLUTE_POSE).y_m < start[1] - 0.5  # it faces south
    for source, engaged, brakes in (
            ("RM1", True, True), ("RM7", False, True), ("RM7", True, True), ("RM1", False, True),
            ("RM1", False, True), ("RM7", False, False)):
        bench.actor.brake(m.BrakeCommand(engaged, "test"), Header(source, 1, 1, bench.now_s))
        bench.run(1.0, m.BaseCommand(0.5, 0.0))
        assert bench.last(topics.BASE_STATUS).brake_engaged is brakes
        assert (bench.last(topics.TRUTH).twist.linear_mps < 0.01) is brakes


def test_an_old_command_does_not_keep_the_dead_man_quiet():
    bench = bench_at()
    for _ in range(50):
        bench.run(0.02)
        bench.actor.command(m.BaseCommand(0.5, 0.0), bench.header(age_s=2.0))
    assert bench.last(topics.BASE_STATUS).dead_man_tripped


def test_obstacles_come_and_go_by_message_and_are_published_at_once():
    bench = bench_at(obstacles=2)
    bench.run(1.0)
    assert {o.name for o in bench.last(topics.OBSTACLES).obstacles} == {"crate", "drum"}
    order = m.ObstacleCommand("box", True, -27.0, 8.0, 0.3)
    bench.actor.obstacle(order, bench.header())
    assert order in bench.last(topics.OBSTACLES).obstacles
    bench.run(0.2)
    ranges = np.frombuffer(bench.last(topics.SCAN).ranges_f32, dtype="<f4")
    assert ranges.min() == pytest.approx(2.7, abs=0.1)
    bench.actor.obstacle(m.ObstacleCommand("box", False, 0, 0, 0), bench.header())
    assert "box" not in {o.name for o in bench.last(topics.OBSTACLES).obstacles}


def test_an_impossible_order_is_reported_and_changes_nothing():
    bench = bench_at()
    bench.actor.obstacle(m.ObstacleCommand("x", True, -27.0, 11.0, 0.3), bench.header())
    bench.actor.command(m.BaseCommand(float("nan"), 0.0), bench.header())
    assert [what for what, *_ in bench.complaints] == ["obstacle", "velocity command"]
    assert "on the robot" in bench.complaints[0][1]
    assert bench.actor._world.obstacles == ()


def test_held_up_it_publishes_fresh_readings_and_owns_up_to_the_loss():
    bench = bench_at()
    bench.run(1.1)
    assert bench.last(topics.TRUTH).real_time_factor == 1.0
    bench.sent.clear()
    bench.now_s += 30.0
    bench.actor.tick()
    assert min(stamp for _, _, stamp in bench.sent) > bench.now_s - 1.1
    bench.run(1.1)
    assert bench.last(topics.TRUTH).real_time_factor < 1.0 + 1e-9
    assert any(b.real_time_factor < 0.2 for k, b, _ in bench.sent if k == topics.TRUTH.key)
