"""The format of states, and the keeper that stands between a store and its node."""

from __future__ import annotations

import msgspec
import pytest

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES
from rampart.actors.runtime.checkpoint import (
    FAILED_IN_A_ROW,
    GENERATIONS,
    RETRY_S,
    SOON_S,
    CheckpointError,
    CheckpointStore,
    Keeper,
    MemoryCheckpoints,
    Record,
    StateError,
    StateFormat,
    SupersededError,
)


class Counter(msgspec.Struct, frozen=True):
    count: int
    step: int
    label: str = ""


COUNTER = StateFormat(
    Counter, version=3, objection=lambda state: "it is negative" if state.count < 0 else "")


def record(version: int, body: object, generation: int = 1) -> Record:
    return Record(1, generation, version, 0, msgspec.msgpack.encode(body))


class Desk:
    """A keeper, its clock, and what it has reported."""

    def __init__(self, store: CheckpointStore, *, expected: bool = False) -> None:
        self.now_s = 0.0
        self.told: list[str] = []
        self.keeper = Keeper(store, self.told.append, lambda: self.now_s, expected=expected)

    def count(self) -> int | None:
        found = self.keeper.kept(COUNTER)
        return found and found.count

    def keep(self, count: int) -> None:
        self.keeper.keep(COUNTER, Counter(count, 0))


class Broken(CheckpointStore):
    """A store that fails as long as it has an error."""

    def __init__(self, error: Exception) -> None:
        self.inner = MemoryCheckpoints([], 1)
        self.error: Exception | None = error
        self.attempts = 0

    def save(self, version, failures, state):
        self.attempts += 1
        if self.error:
            raise self.error
        self.inner.save(version, failures, state)

    def load(self):
        if self.error:
            raise self.error
        return self.inner.load()


# -- formats -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("version", "body", "why"), [
    (4, {"count": 5, "step": 1}, "version 4, expected 3"),
    (2, {"count": 5, "step": 1}, "version 2, expected 3"),
    (3, {"count": "many", "step": 1}, "count"),
    (3, {"count": -1, "step": 1}, "it is negative"),
    (3, [1, 2], "Counter"), (3, {"count": 5}, "step"),
])
def test_a_state_that_cannot_be_used_is_refused_in_one_line(version, body, why):
    with pytest.raises(StateError) as refused:
        COUNTER.decode(version, msgspec.msgpack.encode(body))
    assert COUNTER.decode(3, msgspec.msgpack.encode({"count": 5, "step": 1})) == Counter(5, 1)
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


# -- the keeper ----------------------------------------------------------------------------------


def test_a_state_is_saved_once_and_the_last_generations_are_kept():
    shelf: list[Record] = []
    desk = Desk(MemoryCheckpoints(shelf, 1))
    for count in (1, 1, 2, 2, 1, *range(2, 9)):
        desk.keep(count)
    assert [r.generation for r in shelf] == [10, 9, 8, 7][:GENERATIONS]
    assert desk.told == []


def test_the_first_process_expects_nothing_and_a_later_one_reports_that_nothing_was_found():
    first, later = Desk(MemoryCheckpoints([], 1)), Desk(MemoryCheckpoints([], 2), expected=True)
    assert first.count() is None
    assert later.count() is None
    assert first.told == []
    assert later.told == ["no checkpoint was found; starting without a checkpoint"]


def test_a_state_that_makes_no_sense_gives_way_to_the_one_before_in_one_line():
    shelf = [record(3, {"count": -1, "step": 0}, 9), record(4, {}, 8),
             record(3, {"count": 4, "step": 0}, 7)]
    desk = Desk(MemoryCheckpoints(shelf, 2), expected=True)
    assert desk.count() == 4
    assert len(desk.told) == 1
    assert "generation 9" in desk.told[0]
    assert "generation 8" in desk.told[0]


def test_a_state_that_is_too_large_is_refused_with_one_line_and_the_one_before_stays():
    desk = Desk(store := MemoryCheckpoints([], 1))
    desk.keep(1)
    for tick in range(20):
        desk.now_s = float(tick)
        desk.keeper.keep(COUNTER, Counter(2, 0, "x" * LARGEST_STATE_BYTES))
    assert len(desk.told) == 1
    assert str(LARGEST_STATE_BYTES) in desk.told[0]
    assert Desk(store).count() == 1


def test_a_broken_store_is_tried_ever_more_rarely_and_reported_once():
    desk = Desk(store := Broken(CheckpointError("disk full")))
    assert desk.count() is None
    for tick in range(1000):
        desk.now_s = tick / 10
        desk.keep(tick)
    assert 5 < store.attempts < 10
    assert desk.told == ["disk full; starting without a checkpoint",
                         "disk full; going on without checkpoints"]
    store.error = None
    desk.now_s += RETRY_S[1]
    desk.keep(1)
    desk.keep(2)
    assert desk.told[2:] == ["checkpoints are kept again"]
    assert len(store.inner.load().records) == 2


@pytest.mark.parametrize("error", [ValueError("what no one thought of"), RecursionError("deep")])
def test_a_store_that_raises_anything_ends_no_node(error):
    desk = Desk(Broken(error), expected=True)
    assert desk.count() is None
    desk.keep(1)
    desk.keeper.failed()
    assert all(str(error) in line for line in desk.told)


def test_a_superseded_process_is_told_once_and_saves_no_more():
    store = Broken(SupersededError("incarnation 1 was superseded"))
    desk = Desk(store)
    assert desk.count() is None
    for tick in range(100):
        desk.now_s = float(tick)
        desk.keep(tick)
    assert store.attempts == 0
    assert len(desk.told) == 1


def test_a_state_with_which_processes_fail_soon_is_given_up():
    shelf: list[Record] = []
    Desk(MemoryCheckpoints(shelf, 1)).keep(13)
    for incarnation in range(2, 2 + FAILED_IN_A_ROW):
        desk = Desk(MemoryCheckpoints(shelf, incarnation))
        assert desk.count() == 13
        desk.now_s = SOON_S / 2
        desk.keeper.failed()
    last = Desk(MemoryCheckpoints(shelf, 9), expected=True)
    assert last.count() is None
    assert len(last.told) == 1
    last.keep(14)
    assert Desk(MemoryCheckpoints(shelf, 10)).count() == 14  # and the count of failures is over


def test_processes_that_fail_late_or_are_killed_do_not_count_against_the_state():
    shelf: list[Record] = []
    Desk(MemoryCheckpoints(shelf, 1)).keep(13)
    for incarnation in range(2, 20):
        desk = Desk(MemoryCheckpoints(shelf, incarnation))
        assert desk.count() is not None
        if incarnation % 3:
            desk.now_s = SOON_S * 2
            desk.keep(incarnation)
            if incarnation % 2:
                desk.keeper.failed()
        else:
            desk.keeper.failed()
