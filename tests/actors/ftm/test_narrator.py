"""One line per event, the same for console, report, page and viewers."""

from __future__ import annotations

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm.narrator import Line, Narrator

TITLES = {"DM1": "Prohibited area", "RM1": "Emergency stop", "FTM1": "Prohibited area"}


def told(*messages, source="DM1"):
    narrator = Narrator(TITLES)
    return [line for number, message in enumerate(messages)
            for line in narrator.describe(message, Header(source, 1, number, 0.0))]


def test_a_detection_is_told_when_it_begins_and_when_it_ends():
    idle, active = (fm.DetectionReport(state, "fence", (), 0.0) for state in (
        fm.DetectionState.IDLE, fm.DetectionState.ACTIVE))
    assert told(idle, active, active, idle, idle) == [
        Line("fault", "Prohibited area (DM1): fence"),
        Line("clear", "Prohibited area (DM1): clear")]


def test_processes_are_told_of_when_they_fail_and_come_back_and_not_of_their_start():
    def event(what, by="", detail=""):
        return fm.ProcessEvent("hmi", what, 7, 2, by, detail)

    assert told(event("started"), event("running"), event("crashed", "supervisor", "SIGKILL"),
                event("respawned", "RM4"), event("respawned", "RM4", "already"),
                event("adopted")) == [
        Line("fault", "hmi crashed, incarnation 2: SIGKILL"),
        Line("clear", "hmi respawned by RM4, incarnation 2")]


def test_a_decision_is_told_once_and_what_another_strategy_would_have_done():
    decision = fm.DecisionRecord(3, "safety-first", ("FTM1",), 1, ("RM1",), (), (), 0.0)
    shadow = fm.ShadowRecord(3, "mission-first", ("FTM1",), 1, (), ())
    assert told(decision, decision, shadow) == [
        Line("fault", "decision 3: Emergency stop (RM1): Prohibited area (FTM1), because it is the "
                      "only active mechanism (block 1)."),
        Line("note", "in shadow mission-first would run nothing")]
