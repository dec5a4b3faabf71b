"""Two hosts hold the newest states of shared nodes, in messages and files, whatever happens."""

import errno
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.bus.bounds import MANY, MAX_PAYLOAD_BYTES
from rampart.actors.bus.envelope import Header, encode
from rampart.actors.ftm.messages import LARGEST_STATE_BYTES, Checkpoints, KeptState
from rampart.actors.hosts import state_files
from rampart.actors.hosts.copies import Copies, Received
from rampart.actors.hosts.state_files import LOOK_S, StateFiles
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.checkpoint_file import FileCheckpoints, read
from rampart.testing import wait_until

HOMES = {"camera": "ground", "hmi": "ground", "drill": "moon"}
EPOCH = 1_000_000


def state(incarnation: int, generation: int, content: bytes = b"state") -> Record:
    return Record(incarnation, generation, 1, 0, content)


class Host:
    """One host: what it has on its disk, what it runs, and what it knows of issued incarnations."""

    def __init__(self, name: str, **runs: int) -> None:
        self.name = name
        self.runs = runs
        self.issued: dict[str, int] = dict.fromkeys(HOMES, 10 * EPOCH)
        self.disk: dict[str, Record] = {}
        self.problems: list[tuple[str, str]] = []
        self.copies = Copies("r", name, HOMES, lambda node: self.runs.get(node, 0),
                             lambda node: self.issued[node])
        for node in self.copies.nodes:
            self.copies.settle(node)

    def keep(self, node: str, record: Record) -> None:
        before = self.disk.get(node)
        assert before is None or record.age > before.age, "an older one in a newer one's place"
        self.disk[node] = record
        self.copies.note_kept(node, record)

    def receive(self, other: str, message: Checkpoints) -> Received:
        received = self.copies.receive(other, message)
        self.problems += received.problems
        for node, record in received.records:
            if node not in self.disk or record.age > self.disk[node].age:  # as a store has it
                self.keep(node, record)
        return received


@pytest.fixture
def robot():
    return Host("")


@pytest.fixture
def ground():
    return Host("ground", camera=1, hmi=1)


def held(node: str, record: Record, *, final: bool = False) -> KeptState:
    return KeptState(node, *record, issued=10 * EPOCH, final=final)


def exchange(robot: Host, ground: Host) -> None:
    """Both publish what they hold, and receive it."""
    ground.receive("", robot.copies.all())
    robot.receive("ground", ground.copies.all())


def test_a_message_has_all_since_everything_was_repeated_and_what_a_full_disk_lost_comes_again(
        robot, ground):
    ground.copies.all()
    ground.keep("camera", state(1, 1))
    ground.keep("hmi", state(1, 1))
    changes = ground.copies.changes()
    assert {kept.node for kept in changes.kept} == {"camera", "hmi"}
    newest = ground.copies.all()
    assert ground.copies.changes().kept == ()
    assert robot.copies.receive("ground", newest).records  # and the disk is full
    assert robot.receive("ground", newest).records
    assert robot.receive("ground", newest) == robot.receive("ground", changes) == Received()


def test_states_from_a_host_that_does_not_share_the_node_are_refused_and_reported(robot, ground):
    robot.receive("moon", Checkpoints("r", (held("camera", state(1, 7), final=True),)))
    robot.receive("ground", Checkpoints("r", (held("pilot", state(1, 7)),)))
    ground.keep("camera", state(1, 7))
    robot.receive("ground", msgspec.structs.replace(ground.copies.all(), run="last week's"))
    assert robot.disk == {}
    assert [who for who, _ in robot.problems] == ["camera", "pilot", "ground"]
    assert not robot.copies.is_caught_up({"camera": 0})  # nor is it taken for the last one
    assert robot.copies.is_caught_up({"valve": 7})  # it is not shared
    of_moon = Checkpoints("r", (held("drill", state(1, 7)),))
    assert ground.receive("", of_moon) == Received(), "it is for another host, so no problem"


def test_a_state_of_an_incarnation_that_is_not_known_to_be_issued_is_not_taken_yet(robot, ground):
    """Else one message with the highest number there is would shut out all real ones."""
    ground.keep("camera", state(2**53, 1))
    robot.receive("ground", ground.copies.all())
    assert robot.disk == {}
    ground = Host("ground", camera=2)
    ground.keep("camera", state(2, 1))
    robot.issued["camera"] = 1
    robot.receive("ground", ground.copies.all())
    assert robot.disk == {}
    robot.issued["camera"] = 2  # its table has arrived
    robot.receive("ground", ground.copies.all())
    assert robot.disk == {"camera": state(2, 1)}


def test_the_largest_states_of_all_nodes_come_one_by_one_and_fit_into_a_message(robot, ground):
    for node in ("camera", "hmi"):
        ground.keep(node, state(1, 1, b"x" * LARGEST_STATE_BYTES))
    for turn in range(2):
        message = ground.copies.all()
        assert len(encode(Header("supervisor_ground", 1, 1, 0.0), message)) < MAX_PAYLOAD_BYTES
        robot.receive("ground", message)
        assert len(robot.disk) == turn + 1
    kept = KeptState("a_name_of_twenty_chr", *state(2**53, 2**53, b""), 2**53, True)
    size = len(encode(Header("s", 1, 1, 0.0), Checkpoints("r", (kept,) * (MANY // 2))))
    assert size < MAX_PAYLOAD_BYTES - 3 * LARGEST_STATE_BYTES


def taken_over(robot: Host, ground: Host) -> None:
    """Have the camera run on the robot, from its state, while its own host cannot be reached."""
    exchange(robot, ground)
    ground.keep("camera", state(1, 10))
    exchange(robot, ground)
    robot.copies.lose("ground")
    ground.copies.lose("")
    robot.runs["camera"] = EPOCH + 1
    robot.keep("camera", state(EPOCH + 1, 11))


def test_a_node_that_is_given_back_waits_for_the_last_state_that_was_kept(robot, ground):
    robot.issued["camera"] = 1
    exchange(robot, ground)
    before = robot.copies.all()
    robot.issued["camera"] = 10 * EPOCH
    taken_over(robot, ground)
    issued = {"camera": EPOCH + 1}
    del robot.disk["camera"]  # perhaps it was set aside
    robot.copies.note_kept("camera", None)
    ground.keep("camera", state(1, 500))
    exchange(robot, ground)
    assert "camera" not in robot.disk, "it runs there, by a higher incarnation"
    robot.keep("camera", state(EPOCH + 1, 11))
    ground.receive("", before)  # it was under way all the time
    assert not ground.copies.is_caught_up(issued)
    ground.runs["camera"] = 0
    exchange(robot, ground)
    assert not ground.copies.is_caught_up(issued)  # it still runs there
    robot.copies.unsettle(["camera"])
    robot.runs["camera"] = 0
    exchange(robot, ground)
    assert not ground.copies.is_caught_up(issued)  # its process is being ended
    robot.keep("camera", state(EPOCH + 1, 12))
    robot.copies.settle("camera")
    last = robot.copies.all()
    ground.copies.receive("", last)
    assert not ground.copies.is_caught_up(issued)  # the last state is not on the disk
    ground.receive("", last)
    assert ground.disk["camera"] == state(EPOCH + 1, 12)
    assert ground.copies.is_caught_up(issued)


EVENTS = st.lists(st.one_of(
    st.tuples(st.just("keep"), st.sampled_from(["camera", "hmi"])),
    st.tuples(st.sampled_from(["robot publishes", "ground publishes"]), st.integers(0, 3)),
    st.tuples(st.sampled_from(["receive", "again"]), st.integers(0, 7)),
    st.tuples(st.sampled_from(["take over", "give back"]), st.just("camera"))), max_size=60)


@given(EVENTS)
def test_however_messages_are_lost_late_double_and_disordered_in_the_end_both_hold_the_newest(
        events):
    robot, ground = Host(""), Host("ground", camera=1, hmi=1)
    under_way: list[tuple[Host, str, Checkpoints]] = []
    epoch, generation = 0, 0
    for what, which in events:
        if what == "keep":
            generation += 1
            where = robot if robot.runs.get(which) else ground
            incarnation = where.runs.get(which) or 1
            if where.disk.get(which, state(0, 0)).age < (incarnation, generation):
                where.keep(which, state(incarnation, generation, b"%d" % generation))
        elif what.endswith("publishes"):
            sender, receiver = (robot, ground) if what == "robot publishes" else (ground, robot)
            under_way.append(
                (receiver, sender.name, sender.copies.changes() if which else sender.copies.all()))
        elif what in {"receive", "again"} and under_way:
            receiver, name, message = under_way[which % len(under_way)]
            receiver.receive(name, message)
            if what == "receive":
                under_way.remove((receiver, name, message))
        elif what == "take over" and not robot.runs.get("camera"):
            epoch += EPOCH
            robot.runs["camera"] = epoch + 1
        elif what == "give back" and robot.runs.get("camera"):
            ground.runs["camera"], robot.runs["camera"] = epoch + 2, 0
    newest = {node: max((host.disk[node].age for host in (robot, ground) if node in host.disk),
                        default=None) for node in ("camera", "hmi")}
    robot.runs.clear()
    ground.runs.clear()
    exchange(robot, ground)
    for node, age in newest.items():
        assert age is None or robot.disk[node].age == ground.disk[node].age == age
    assert not robot.problems and not ground.problems  # noqa: PT018


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "checkpoints"


@contextmanager
def store(folder: Path, incarnation: int = 1) -> Iterator[FileCheckpoints]:
    made = FileCheckpoints(folder, "camera", "r", incarnation)
    made.load()
    try:
        yield made
    finally:
        made.close()


class Watched:
    """The files of a camera, and the reports about them."""

    def __init__(self, folder: Path) -> None:
        self.reported: queue.SimpleQueue = queue.SimpleQueue()
        self.problems: list[tuple[str, str]] = []
        self.files = StateFiles(
            folder, "r", ["camera"],
            lambda *what: self.reported.put(what), lambda *what: self.problems.append(what))

    def next(self):
        return self.reported.get(timeout=10)


@pytest.fixture
def watched(folder):
    made = Watched(folder)
    made.files.start()
    yield made
    made.files.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "states of nodes"]


def test_the_last_of_many_is_always_seen_and_no_save_is_disturbed(folder, watched):
    """Also when it comes in the moment in which the one before is read."""
    with store(folder) as made:
        made.save(1, 0, b"first")
        assert watched.next() == ("camera", state(1, 1, b"first"), False)
        for number in range(2, 400):
            made.save(1, 0, b"%d" % number * 500)
            if number % 20 == 0:
                time.sleep(LOOK_S * (number % 3))
        wait_until(lambda: watched.next()[1].generation == 399, 10, "it was not seen")
        assert made.trouble() == ""
    assert watched.problems == []


def test_what_is_sent_is_kept_and_told_as_kept_and_nothing_older_is(folder, watched):
    watched.files.settle("camera")
    assert watched.next() == ("camera", None, True)
    watched.files.take("camera", state(1, 3))
    assert watched.next() == ("camera", state(1, 3), False)
    watched.files.take("camera", state(1, 2))
    watched.files.take("camera", state(1, 4))
    assert watched.next() == ("camera", state(1, 4), False)
    watched.files.take("camera", state(EPOCH + 1, 5))
    assert watched.next() == ("camera", state(EPOCH + 1, 5), False)
    watched.files.take("camera", state(1, 500))
    watched.files.settle("camera")
    assert watched.next() == ("camera", state(EPOCH + 1, 5), True)
    assert watched.problems == []
    with store(folder, 2 * EPOCH) as made:  # the process that replaces the lost one
        made.save(1, 0, b"own")
    assert read(folder, "camera", "r").records[:2] == (
        state(2 * EPOCH, 6, b"own"), state(EPOCH + 1, 5))


def test_a_damaged_file_is_told_once_and_what_comes_after_it_is_seen(folder, watched):
    folder.mkdir()
    (folder / "camera.1.1").write_bytes(b"no state" * 999)
    wait_until(lambda: watched.problems, 10, "it was not reported")
    time.sleep(5 * LOOK_S)
    [(node, problem)] = watched.problems
    assert node == "camera"
    assert "cannot be read for another host" in problem
    with store(folder, 2) as made:
        made.save(1, 0, b"anew")
        assert watched.next() == ("camera", state(2, 1, b"anew"), False)


def test_a_state_that_cannot_be_read_in_one_moment_is_read_in_the_next(folder, monkeypatch):
    with store(folder) as made:
        made.save(1, 0, b"kept")
    looks = []

    def failing(*what):
        looks.append(what)
        if len(looks) < 4:
            raise OSError(errno.EMFILE, "Too many open files")
        return read(*what)

    monkeypatch.setattr(state_files, "read", failing)
    made = Watched(folder)
    made.files.start()
    assert made.next() == ("camera", state(1, 1, b"kept"), False)
    made.files.close()
    [(_, problem)] = made.problems
    assert "Too many open files" in problem


def test_a_place_that_cannot_be_written_is_told(folder):
    folder.write_text("a file, not a folder")
    made = Watched(folder)
    made.files.start()
    made.files.take("camera", state(1, 3))
    wait_until(lambda: any("a state of another host is not kept" in problem
                           for _, problem in made.problems), 10, "it was not reported")
    made.files.close()
