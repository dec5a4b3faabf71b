"""The drawing of a system for the page, and what its processes use."""

from __future__ import annotations

from itertools import combinations, pairwise

import msgspec
import pytest

from rampart.actors.ftm import messages as m
from rampart.actors.machine.process_usage import ProcessCount, UsageMeter
from rampart.actors.operator.processes import ProcessObserver
from rampart.actors.operator.system import BARRIER, MAX_BOXES, draw_system
from rampart.actors.supervision.process_title import RunProcess
from rampart.manager.spec.schema import EventSpec
from rampart.manager.spec.specification import parse_specification
from tests import system_file


def system(name: str):
    return parse_specification(system_file(name).read_text(encoding="utf-8"), name)


@pytest.mark.parametrize("name", ["osmosis", "paper", "cell"])
def test_boxes_lie_apart_within_the_drawing_and_lines_join_them_to_the_right(name):
    drawn = draw_system(system(name))
    for drawing in (drawn["tree"], drawn["order"]):
        for one, other in combinations(drawing.boxes, 2):
            assert (one.x + one.width < other.x or other.x + other.width < one.x
                    or one.y + one.height < other.y or other.y + other.height < one.y)
        for box in drawing.boxes:
            assert 0 <= box.x <= drawing.width - box.width
            assert 0 <= box.y <= drawing.height - box.height
    tree = drawn["tree"]
    at = {box.name: box for box in tree.boxes}
    for line in tree.lines:
        upper, lower = at[line.upper], at[line.lower]
        assert upper.x + upper.width < line.points[0][0] < line.points[-1][0] <= lower.x - BARRIER
        assert line.points[0][1] == pytest.approx(upper.y + upper.height / 2)
        assert lower.y <= line.points[-1][1] <= lower.y + lower.height
        assert all(x1 <= x2 for (x1, _), (x2, _) in pairwise(line.points))


def test_the_way_of_an_event_ends_at_the_first_barrier_above():
    way = {box.name: box.way for box in draw_system(system("osmosis"))["tree"].boxes}
    assert way["control_node_crash"] == ("command_not_updated",)
    assert way["command_out_of_bounds"] == (
        "command_calculation_error", "erroneous_command", "moving_inside_prohibited_area")
    assert way["moving_inside_prohibited_area"] == ()


def test_a_tree_that_nobody_could_read_is_not_drawn_and_the_page_says_so():
    spec = system("paper")
    leaf = next(event for event in spec.events if not event.of)
    more = tuple(EventSpec(f"more_{i}") for i in range(MAX_BOXES))
    events = tuple(
        msgspec.structs.replace(e, gate="or", of=tuple(x.name for x in more)) if e is leaf else e
        for e in spec.events)
    drawn = draw_system(msgspec.structs.replace(spec, events=(*events, *more)))
    assert drawn["tree"] is None
    assert drawn["order"] is not None
    assert drawn["note"] == (
        f"The fault tree has {len(events) + MAX_BOXES} events, too many to draw "
        f"(at most {MAX_BOXES}).")


# ---- processes -----------------------------------------------------------------------------------


class Kernel:
    """Processes that use half a core each."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.alive = {10, 11, 20, 30}
        self.found = [RunProcess(10, 7450, 5, ("hmi",), 1),
                      RunProcess(20, 7450, 5, ("pool",), 3),
                      RunProcess(30, 7450, 99, ("pool",), 1)]

    def count(self, pid: int) -> ProcessCount | None:
        return ProcessCount((self.now_s - 90) / 2, 50_000_000, 90.0) if pid in self.alive else None

    def find(self, _port: int) -> list[RunProcess]:
        return self.found

    def observer(self) -> ProcessObserver:
        return ProcessObserver(
            7450, 5, meter=UsageMeter(self.count, lambda: self.now_s), find=self.find,
            state=lambda pid: "S" if pid in self.alive else "X")


def table(**pids: int) -> m.NodeTable:
    return m.NodeTable(tuple(
        m.NodeInfo(name, "control", pid, m.NodeState.RUNNING, 1, 0) for name, pid in pids.items()))


def test_nodes_and_guards_are_looked_at_and_processes_of_another_run_are_not():
    kernel = Kernel()
    looked = kernel.observer().look(table(hmi=10, localization=11))
    assert looked["nodes"] == {
        name: {"cpu": 50.0, "mb": 50.0, "age_s": 10}
        for name in ("hmi", "localization", "pool")}
    assert [(g["name"], g["pid"], g["state"], g["restarts"]) for g in looked["guards"]] == [
        ("launch.py", 5, "crashed", 0), ("pool", 20, "running", 2)]


def test_a_dead_process_has_no_figures_and_without_a_table_nobody_is_taken_for_a_guard():
    kernel = Kernel()
    observer = kernel.observer()
    looked = observer.look(None)
    assert ([g["name"] for g in looked["guards"]], looked["nodes"]) == (["launch.py"], {})
    observer.look(table(hmi=10))
    kernel.alive = {20}
    kernel.now_s += 1
    assert set(observer.look(table(hmi=10, never=0))["nodes"]) == {"pool"}
