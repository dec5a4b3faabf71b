"""`rampart-stop`: zero whatever its sender does."""

import itertools
import math
import signal
import stat
import subprocess
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.foreign.velocity_link import frame
from tests.stop.stopper import PERIOD_MS, TIMEOUT_MS, compiled, running

ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("stop"))


@pytest.fixture
def stopper(program, sockets):
    with running(program, Path(sockets)) as stopper:
        yield stopper


def test_it_hands_on_each_component_and_is_zero_before_and_after(stopper):
    assert stopper.now().velocity == ZERO
    stopper.send(0.5, -0.25, 1.5)
    assert stopper.now().velocity == (0.5, -0.25, 1.5)
    time.sleep(TIMEOUT_MS / 1e3)
    assert stopper.now().velocity == ZERO


def test_its_own_frames_are_in_sequence_one_per_period(stopper):
    frames = [stopper.next() for _ in range(50)]
    assert {f.session for f in frames} == {frames[0].session}
    assert [f.sequence for f in frames] == list(range(frames[0].sequence, frames[0].sequence + 50))
    assert all(a.stamp_ns < b.stamp_ns for a, b in itertools.pairwise(frames))
    periods = (frames[-1].stamp_ns - frames[0].stamp_ns) / (PERIOD_MS * 1e6)
    assert periods >= 48, "no burst, also after a pause of the machine"


def test_a_velocity_out_of_bounds_is_zero_at_once_and_the_next_good_one_counts(stopper):
    for wrong in ((math.nan, 0, 0), (0, math.nan, 0), (0, 0, math.nan), (math.inf, 0, 0),
                  (0, 0, -math.inf), (1.001, 0, 0), (-1.001, 0, 0), (0.8, 0.8, 0), (0, 0, 2.001),
                  (0, 0, -2.001), (1e200, 0, 0)):
        stopper.send(-1.0, 0.0, -2.0)  # the bounds themselves are allowed
        assert stopper.now().velocity == (-1.0, 0.0, -2.0)
        stopper.send(*wrong)
        assert stopper.now().velocity == ZERO


@pytest.mark.parametrize("send", [
    lambda stopper, _age_s, first: stopper.raw(first),
    # with new numbers, and the stamp that it had: the age counts from there, not from the arrival
    lambda stopper, age_s, _first: stopper.send(0.5, age_s=age_s)], ids=["repeated", "numbered"])
def test_an_old_velocity_that_is_sent_on_and_on_is_not_renewed(stopper, send):
    begun_s, first = time.monotonic(), stopper.send(0.5)
    while (age_s := time.monotonic() - begun_s) < 1.5 * TIMEOUT_MS / 1e3:
        send(stopper, age_s, first)
        time.sleep(PERIOD_MS / 1e3)
    assert stopper.speed == 0.0


def test_an_older_frame_and_a_stamp_that_is_old_or_ahead_are_refused(stopper):
    stopper.send(0.5, age_s=1.5 * TIMEOUT_MS / 1e3)
    assert stopper.speed == 0.0
    stopper.send(0.5, age_s=-0.2)
    assert stopper.speed == 0.0
    stopper.send(0.5)
    stopper.send(0.9, age_s=0.1)
    assert stopper.speed == 0.5, "a stamp goes back: the frame before counts"
    stopper.send(0.9, sequence=1)
    assert stopper.speed == 0.5


def test_a_successor_counts_at_once_and_its_predecessor_no_more(stopper):
    old = stopper.session
    stopper.send(0.5)
    stopper.session, stopper.sequence = time.monotonic_ns(), 0
    stopper.send(0.25)
    assert stopper.speed == 0.25
    stopper.send(0.75, session=old, sequence=1000)
    assert stopper.speed == 0.25
    stopper.send(0.75, session=time.monotonic_ns() + 10**12)
    assert stopper.speed == 0.25, "a session of the future would lock out every sender"


def test_a_damaged_frame_is_refused(stopper):
    for damage in (lambda data: data[:-1], lambda data: data + b"\0", lambda _data: b"",
                   lambda data: data * 20, lambda data: b"RPV2" + data[4:],
                   lambda data: data[:40] + b"\x7f" + data[41:]):
        stopper.send(0.5)
        stopper.sequence += 1
        stopper.raw(damage(frame(
            stopper.session, stopper.sequence, time.monotonic_ns(), (0.9, 0, 0))))
        assert stopper.speed == 0.5
    assert stopper.process.poll() is None


def test_no_datagram_ends_it_or_moves_the_robot(program, sockets):
    bound = (1.0, 1.0, 2.0)
    with running(program, Path(sockets)) as stopper:
        @given(st.binary(max_size=80) | st.tuples(
            st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1),
            st.tuples(st.floats(), st.floats(), st.floats())))
        def any_datagram(content):
            stopper.raw(content if isinstance(content, bytes) else frame(*content))
            velocity = stopper.next().velocity
            assert all(abs(v) <= most for v, most in zip(velocity, bound, strict=True))

        any_datagram()
        stopper.session = time.monotonic_ns()
        stopper.send(0.5)
        assert stopper.speed == 0.5


def test_a_flood_does_not_delay_the_output(stopper):
    stopper.send(0.5)
    begun, first = time.monotonic(), stopper.now()
    count = 0
    while time.monotonic() - begun < 3 * TIMEOUT_MS / 1e3:
        stopper.raw(b"flood")
        count += 1
    last = stopper.now()
    assert count > 100
    assert last.velocity == ZERO
    periods = (last.stamp_ns - first.stamp_ns) / (PERIOD_MS * 1e6)
    assert last.sequence - first.sequence > periods / 4


def test_it_is_stopped_for_a_while_and_hands_nothing_old_on(stopper):
    stopper.send(0.5)
    assert stopper.speed == 0.5
    stopper.process.send_signal(signal.SIGSTOP)
    stopper.send(0.75)
    time.sleep(1.5 * TIMEOUT_MS / 1e3)
    stopper.process.send_signal(signal.SIGCONT)
    assert stopper.speed == 0.0


def test_it_ends_with_a_zero(stopper):
    stopper.send(0.5)
    assert stopper.speed == 0.5
    stopper.process.send_signal(signal.SIGTERM)
    assert stopper.process.wait(10) == 0
    assert stopper.received()[-1].velocity == ZERO
    assert not stopper.into.exists()


def test_its_socket_is_for_its_user_only_and_that_of_a_killed_one_is_no_obstacle(program, sockets):
    folder = Path(sockets)
    with running(program, folder) as stopper:
        assert stat.S_IMODE(stopper.into.stat().st_mode) == 0o600
    (folder / "base").unlink()
    assert stopper.into.exists(), "it was killed"
    with running(program, folder) as stopper:
        stopper.send(0.5)
        assert stopper.speed == 0.5


@pytest.mark.parametrize(("arguments", "code", "words"), [
    ((), 2, "usage"), (("in", "out", "300", "20", "1"), 2, "usage"),
    (("in", "out", "x", "20", "1", "1"), 2, "x: expected"),
    (("in", "out", "300", "20", "-1", "1"), 2, "-1: expected"),
    (("a" * 108, "out", "300", "20", "1", "1"), 2, "expected a path"),
    (("nowhere/in", "out", "300", "20", "1", "1"), 1, "nowhere/in: cannot be created"),
    (("file", "out", "300", "20", "1", "1"), 1, "file: ")])
def test_wrong_arguments_are_one_line_and_a_file_in_the_place_of_its_socket_stays(
        program, tmp_path, arguments, code, words):
    (tmp_path / "file").write_text("precious")
    done = subprocess.run([program, *arguments], cwd=tmp_path, capture_output=True, text=True,
                          timeout=10, check=False)
    assert done.returncode == code
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert (tmp_path / "file").read_text() == "precious"
