"""Which mechanisms stand between causes and the top event."""

from rampart.manager.analysis.barriers import guard
from rampart.manager.model.fault_tree import Event, FaultTree
from tests.manager.bench import paper


def test_on_the_paper_s_tree_each_cause_has_the_barriers_above_it():
    found = {g.events: g.barriers for g in guard(paper(), [
        ("control_node_crash",), ("localization_node_crash",), ("command_calculation_error",),
        ("actuator_failure",), ("control_node_crash", "command_calculation_error")])}
    assert found == {
        ("control_node_crash",): ("FTM1", "FTM2", "FTM4"),
        ("localization_node_crash",): ("FTM1", "FTM6", "FTM7"),
        ("command_calculation_error",): ("FTM1", "FTM3"),
        ("actuator_failure",): ("FTM1",),
        # by two ways, each with a barrier of its own
        ("control_node_crash", "command_calculation_error"): ("FTM1",)}


def test_an_event_that_is_kept_from_occurring_does_not_spread():
    tree = FaultTree([Event("top", ("a", "g"), 2), Event("a"), Event("g", ("b", "c", "d"), 2),
                      Event("b"), Event("c"), Event("d")])
    assert "top" in tree.occurring(["a", "b", "c"])
    assert "top" not in tree.occurring(["a", "b", "c"], "g")
    assert "top" not in tree.occurring(["a", "b", "c"], "b")
    assert "top" in tree.occurring(["a", "b", "c", "d"], "b")
