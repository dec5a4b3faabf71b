"""Placement as hosts are lost and return, never two of a node; how far their clocks are apart."""

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.bus.envelope import AHEAD_S
from rampart.actors.bus.run_folder import EPOCH, restarts_of
from rampart.actors.ftm.messages import NodeInfo, NodeState
from rampart.actors.hosts.clock_sync import DRIFT, ClockSync
from rampart.actors.hosts.placement import Changes, Home, Placement
from rampart.manager.spec.hosts import Link
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from tests.two_hosts import two_hosts

LINK = Link()
HOMES = {"pilot": Home("", ("pilot",)), "page": Home("ground", ("hmi",)),
         "modules": Home("ground", ("DM1", "DM2")), "world": Home("ground", ("world",), True)}
GUARDS = {"supervisor": "", "router_a": "", "supervisor_ground": "ground",
          "router_a_ground": "ground"}
LOST_S = LINK.lost_after_s + 0.01


def row(name: str, incarnation: int, host: str = "ground") -> NodeInfo:
    return NodeInfo(name, "detection", 1, NodeState.RUNNING, incarnation, 0, host=host)


LINES = {"cut": set(), "join": {"", "ground"}, "only the robot receives": {""},
         "only ground receives": {"ground"}}
"""Hosts that receive the other one, by event of the link."""


class Side(Placement):
    """What one supervisor decides, and the numbers that are issued as its host knows them."""

    def __init__(self, host: str, issued: Mapping[str, int] = MappingProxyType({}),
                 rate: float = 1.0) -> None:
        self.issued = dict(issued)
        super().__init__(host, HOMES, GUARDS, LINK, lambda node: self.issued.get(node, 0),
                         now_s=0.0, rate=rate)

    def take_table(self, host: str, rows: Iterable[NodeInfo], now_s: float
             ) -> tuple[list[NodeInfo], list[str]]:
        news, drop = super().take_table(host, rows, now_s)
        self.issued.update({row.name: row.incarnation for row in news})
        return news, drop

    def look(self, now_s: float, is_ready: Callable[[str], bool] = lambda _unit: True) -> Changes:
        changes = super().look(now_s, is_ready)
        for unit, above in changes.take:
            self.issued.update(dict.fromkeys(HOMES[unit].nodes, above + 1))
        return changes

    def restart(self, unit: str) -> None:
        """Issue the next numbers of a unit, if it runs here."""
        for node in HOMES[unit].nodes if unit in self.held else ():
            self.issued[node] += 1


def robot(issued: Mapping[str, int] = MappingProxyType({})) -> Side:
    made = Side("", issued)
    made.note_alive("ground", 0.0)
    return made


def test_a_host_that_starts_is_waited_for():
    made = Side("")
    made.excuse(1.0, 0.1)
    assert made.look(9.9) == Changes()
    assert made.look(10.1).lost == ("ground",)
    made = robot()
    made.excuse(5.0, 5.0)  # it stood still
    assert made.look(5.0 + LINK.lost_after_s) == Changes()
    assert made.look(5.0 + LOST_S).lost == ("ground",)
    assert Side("ground").look(100.0) == Changes(lost=("",))  # only the first takes over
    slow = Side("", rate=0.1)  # in slow motion it is waited for longer
    slow.note_alive("ground", 0.0)
    assert not slow.look(10 * LINK.lost_after_s).lost
    assert slow.look(10 * LINK.lost_after_s + 0.01).lost


def test_what_a_lost_host_ran_is_taken_over_with_incarnations_that_it_cannot_have_reached():
    made = robot({"hmi": 5 * EPOCH + 1})
    made.take_table("ground", [row("DM1", 3)], 0.1)
    assert made.rows() == [row("DM1", 3)]
    assert made.look(LINK.lost_after_s) == Changes()
    assert made.look(LOST_S) == Changes(
        lost=("ground",), take=(("page", 6 * EPOCH), ("modules", EPOCH)))
    assert made.held == {"pilot", "page", "modules"}
    assert made.rows() == []
    assert made.look(LOST_S + 1) == Changes()
    assert [restarts_of(n) for n in (0, 1, 4, EPOCH + 1, 2 * EPOCH + 3)] == [0, 0, 3, 1, 4]


def over_a_line(made: Placement, is_cut: Callable[[float], bool], until_s: float
                ) -> tuple[list[float], list[float]]:
    """Return when a unit of the other host was taken over, and when it was given back."""
    taken, back = list[float](), list[float]()
    for tick in range(int(20 * until_s)):
        now_s = tick / 20
        if not is_cut(now_s):
            publish_table(made, now_s)
        changes = made.look(now_s)
        taken += [now_s for unit, _ in changes.take if unit == "page"]
        back += [now_s for unit in changes.drop if unit == "page"]
    return taken, back


@pytest.mark.parametrize(("down_s", "up_s"), [(2.0, 5.5), (0.8, 3.0), (1.0, 20.0)])
def test_over_a_line_that_comes_and_goes_little_is_moved_and_in_the_end_it_is_given_back(
        down_s, up_s):
    period_s, over_s = down_s + up_s, 300.0
    taken, back = over_a_line(
        robot(), lambda now_s: now_s < over_s and now_s % period_s > up_s, 400.0)
    assert len(taken) == len(back) <= 5, "each time its modules have to detect all over again"
    assert all(b - a >= 4.0 for a, b in zip(taken, back, strict=True)), "before they can have"
    assert over_s < back[-1] < over_s + 61.0


def publish_table(made: Placement, now_s: float, *rows: NodeInfo) -> None:
    made.note_alive("ground", now_s)
    made.take_table("ground", rows, now_s)


def test_nothing_is_given_back_to_a_host_that_still_runs_its_own_process():
    made = robot()
    publish_table(made, 0.1, row("hmi", 1))
    made.look(LOST_S + 0.1)
    made.note_alive("ground", 6.0)
    made.note_alive("ground", 6.5)
    assert made.look(6.5) == Changes(back=("ground",))  # no table since
    publish_table(made, 6.7, row("hmi", 1))
    assert made.look(6.7) == Changes(drop=("modules",))
    modules = [("DM1", "ground", EPOCH + 1), ("DM2", "ground", EPOCH + 1)]
    assert made.given_back() == modules
    publish_table(made, 6.9, row("DM1", EPOCH + 2), row("DM2", EPOCH + 1))
    assert made.look(6.9) == Changes(drop=("page",))
    assert made.held == {"pilot"}
    assert made.given_back() == [("hmi", "ground", EPOCH + 1)], "the home runs what is not there"


def test_a_home_ends_its_superseded_process_and_starts_it_again_when_it_is_given_back():
    ground = Side("ground", {"hmi": 2})
    news, drop = ground.take_table("", [row("hmi", EPOCH + 1, "")], 1.0)
    assert [(row.name, row.incarnation) for row in news] == [("hmi", EPOCH + 1)]
    assert drop == ["page"]
    assert ground.look(1.1).take == ()
    ground.take_table("", [row("pilot", 1, "")], 1.2)
    assert ground.look(1.3).take == (("page", EPOCH + 1),)
    assert ground.held == {"page", "modules", "world"}
    ground.take_table("", [row("hmi", 2 * EPOCH, "ground")], 2.0)  # given back
    assert ground.look(2.1).take == (("page", 2 * EPOCH),)
    ground.take_table("", [row("hmi", 3 * EPOCH, "")], 3.0)
    ground.take_table("", [], 3.2)
    assert ground.look(5.0).take == (), "an old table"


def test_a_unit_of_another_home_that_runs_here_shows_that_its_host_is_lost():
    made = Side("")
    assert made.begin(["page"], lambda _node: False) == ["pilot", "page"]
    assert made.is_lost("ground")
    assert [unit for unit, _ in made.look(0.1).take] == ["modules"]


@pytest.mark.parametrize("name", ["pilot", "router_a", "supervisor", "observer",
                                  "stranger", "../x", "a\0b"])
def test_a_host_is_not_believed_about_what_is_no_node_and_no_guard_of_its_own(name):
    made = robot()
    own = row("router_a_ground", 7)
    assert made.take_table("ground", [row(name, 999), own], 1.0) == ([own], [])
    assert made.rows() == [own]


@given(st.lists(st.sampled_from([
    *LINES, "wait", "robot restarts a unit", "ground restarts a unit"]), max_size=40))
def test_however_the_link_comes_and_goes_in_the_end_each_runs_what_is_its_own(steps):
    """Two supervisors that exchange tables while they are joined; the issued numbers decide."""
    now_s, receives = 0.0, {"", "ground"}
    sides = {"": Side("", {"pilot": 1}),
             "ground": Side("ground", {"hmi": 1, "DM1": 1, "DM2": 1, "world": 1})}

    def pass_time(seconds: float) -> None:
        nonlocal now_s
        until_s = now_s + seconds
        while now_s < until_s:
            now_s += 0.1
            for own, side in sides.items():
                other = "ground" if own == "" else ""
                if other in receives:
                    sides[other].note_alive(own, now_s)
                    rows = [row(node, side.issued[node], own) for unit in side.held
                            for node in HOMES[unit].nodes]
                    rows += [row(node, highest, home) for node, home, highest in side.given_back()]
                    sides[other].take_table(own, rows, now_s)
                side.look(now_s)

    for step in (*steps, "join", "wait"):
        receives = LINES.get(step, receives)
        if step == "robot restarts a unit":
            sides[""].restart("page")
            sides[""].restart("pilot")
        if step == "ground restarts a unit":
            sides["ground"].restart("page")
        pass_time(75.0 if step == "wait" else 0.5)
    assert sides[""].held == {"pilot"}
    assert sides["ground"].held == {"page", "modules", "world"}
    for node in ("hmi", "DM1", "DM2"):
        assert sides["ground"].issued[node] >= sides[""].issued.get(node, 0)


def exchange(sync: ClockSync, at_s: float, ahead_s: float, there_s: float, back_s: float) -> None:
    sync.add_exchange(at_s, at_s + there_s + ahead_s, at_s + there_s + back_s)


@given(st.floats(-1e6, 1e6), st.lists(
    st.tuples(st.floats(1e-5, 5.0), st.floats(1e-5, 5.0)), min_size=1, max_size=80),
    st.floats(-DRIFT / 2, DRIFT / 2))
def test_the_true_offset_lies_within_the_bound(ahead_s, ways, drift):
    sync, now_s = ClockSync(), 0.0
    for there_s, back_s in ways:
        told_s = now_s + there_s
        sync.add_exchange(now_s, told_s + ahead_s + drift * told_s, told_s + back_s)
        now_s = told_s + back_s
        true_s = ahead_s + drift * now_s
        assert abs(sync.offset_s - true_s) <= sync.bound_s + 1e-6
        now_s += 0.25


def test_the_quickest_way_there_and_the_quickest_way_back_count_together():
    sync = ClockSync()
    exchange(sync, 0.0, 100.0, 0.001, 0.4)
    exchange(sync, 1.0, 100.0, 0.4, 0.001)
    for second in range(2, 300):
        exchange(sync, float(second), 100.0, 0.3, 0.3)
        if second == 50:
            assert sync.bound_s < 0.25  # on its way: it never jumps
    assert sync.offset_s == pytest.approx(100.0, abs=0.2)


@pytest.mark.parametrize("slow_way", [0, 1])
def test_a_way_that_becomes_quicker_does_not_leave_a_clock_that_readers_refuse(slow_way):
    sync = ClockSync(0.1)
    ways = [0.001, 0.001]
    ways[slow_way] = 0.5
    for turn in range(100):
        exchange(sync, turn / 4, 5.0, *ways)
    for turn in range(100, 104):
        exchange(sync, turn / 4, 5.0, 0.001, 0.001)
        assert abs(sync.offset_s - 5.0) <= AHEAD_S


def test_no_bound_of_two_clocks_is_accepted_that_readers_of_messages_do_not_tolerate():
    text = two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"})
    assert parse_specification(text, "two.toml").link.clock_s <= AHEAD_S
    with pytest.raises(SpecificationError, match=r"link.*clock_s = 2"):
        parse_specification(text.replace("[link]\n", "[link]\nclock_s = 2\n"), "two.toml")


def test_after_a_jump_of_a_clock_only_newer_exchanges_count():
    sync = ClockSync()
    assert sync.bound_at(0.0) == float("inf")
    for turn in range(20):
        exchange(sync, turn / 4, 5.0, 0.01, 0.01)
    assert sync.bound_at(100.0) > sync.bound_at(5.0) + 94.0 * DRIFT, "while there is no exchange"
    exchange(sync, 6.0, 7.0, 0.01, 0.01)
    assert sync.offset_s == pytest.approx(7.0, abs=0.01)
