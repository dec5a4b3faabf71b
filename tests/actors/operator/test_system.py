"""The drawing of a system for the page, and what its processes use."""

from __future__ import annotations

from itertools import combinations

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
    at = {box.name: box for box in drawn["tree"].boxes}
    for line in drawn["tree"].lines:
        upper, lower = at[line.upper], at[line.lower]
        assert upper.x + upper.width < line.points[0][0] < line.points[-1][0] <= lower.x - BARRIER
        assert lower.y <= line.points[-1][1] <= lower.y + lower.height


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


def test_nodes_and_guards_that_exist_are_measured_and_processes_of_another_run_are_not():
    alive, now_s = {10, 11, 20, 30}, 100.0

    def count(pid: int) -> ProcessCount | None:
        return ProcessCount((now_s - 90) / 2, 50_000_000, 90.0) if pid in alive else None

    def table(**pids: int) -> m.NodeTable:
        return m.NodeTable(tuple(m.NodeInfo(name, "control", pid, m.NodeState.RUNNING, 1, 0)
                                 for name, pid in pids.items()))

    observer = ProcessObserver(
        7450, 5, meter=UsageMeter(count, lambda: now_s), find=lambda _port: [
            RunProcess(10, 7450, 5, ("hmi",), 1), RunProcess(20, 7450, 5, ("pool",), 3),
            RunProcess(30, 7450, 99, ("pool",), 1)],
        state=lambda pid: "S" if pid in alive else "X")
    looked = observer.look(None)  # without a table no process is taken for a guard
    assert ([g["name"] for g in looked["guards"]], looked["nodes"]) == (["launch.py"], {})
    looked = observer.look(table(hmi=10, localization=11))
    assert looked["nodes"] == {name: {"cpu": 50.0, "mb": 50.0, "age_s": 10}
                               for name in ("hmi", "localization", "pool")}
    assert [(g["name"], g["pid"], g["state"], g["restarts"]) for g in looked["guards"]] == [
        ("launch.py", 5, "crashed", 0), ("pool", 20, "running", 2)]
    alive, now_s = {20}, 101.0
    assert set(observer.look(table(hmi=10, never=0))["nodes"]) == {"pool"}
