"""The history of faults over runs: debounced, and never a reason for a run to stop."""

import sqlite3

import pytest

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm.history import (
    FILE,
    HEALED_S,
    Debounce,
    Fault,
    History,
    clear_history,
    read_history,
)
from rampart.actors.ftm.narrator import Line, Narrator


def detection(debounce, at_s, *nodes, name="DM7", active=True, reason="gone"):
    state = fm.DetectionState.ACTIVE if active else fm.DetectionState.IDLE
    debounce.take(fm.DetectionReport(state, reason, nodes, at_s), Header(name, 1, 1, at_s), at_s)


def decision(debounce, at_s, *active):
    debounce.take(fm.DecisionRecord(1, "safety-first", active, 1, (), (), (), at_s),
                  Header("ftm_manager", 1, 1, at_s), at_s)


def event(debounce, at_s, what):
    debounce.take(fm.ProcessEvent("pump", what, 7, 1, "", ""), Header("supervisor", 1, 1, at_s),
                  at_s)


def states(debounce, now_s):
    return [(f.mechanism, f.node, f.state, f.times) for f in debounce.changes(now_s)]


def test_a_detection_is_suspected_a_decision_confirms_it_and_time_heals_it():
    debounce = Debounce()
    detection(debounce, 1.0, "pump#1")
    assert states(debounce, 1.0) == [("DM7", "pump", "suspected", 1)]
    detection(debounce, 1.2, "pump#2")  # repeated, of its successor
    decision(debounce, 1.25)  # without a fault: confirms nothing
    assert states(debounce, 1.25) == []
    decision(debounce, 1.3, "FTM7")
    assert states(debounce, 1.3) == [("DM7", "pump", "confirmed", 0)]
    detection(debounce, 2.0, active=False)
    assert states(debounce, 2.0 + HEALED_S - 0.1) == []
    assert states(debounce, 2.0 + HEALED_S) == [("DM7", "pump", "healed", 0)]
    detection(debounce, 60.0, "pump")
    assert states(debounce, 60.0) == [("DM7", "pump", "suspected", 1)]


def test_each_failure_of_a_process_counts():
    debounce = Debounce()
    event(debounce, 1.0, "crashed")
    event(debounce, 1.1, "given up")
    assert states(debounce, 1.1) == [("supervisor", "pump", "confirmed", 1)]
    event(debounce, 1.2, "respawned")
    event(debounce, 1.3, "wedged")
    assert states(debounce, 1.3) == [("supervisor", "pump", "confirmed", 1)]
    event(debounce, 1.4, "respawned")
    assert states(debounce, float("inf")) == [("supervisor", "pump", "healed", 0)]


def fault(state="confirmed", times=1, **other):
    return Fault(**{"mechanism": "DM7", "node": "pump", "error": "gone", "state": state,
                    "times": times, **other})


def test_runs_add_up(tmp_path):
    for run, at_s in (("r1", 100.0), ("r2", 200.0)):
        history = History(tmp_path, run)
        history.put([fault()], at_s)
        assert clear_history(tmp_path) == 0  # it is confirmed
        history.put([fault("healed", 0)], at_s + 10)
        history.close()
    [row] = read_history(tmp_path)
    assert (row.first_s, row.last_s, row.times, row.run, row.state) == (
        100.0, 210.0, 2, "r2", "healed")
    assert clear_history(tmp_path) == 1
    assert read_history(tmp_path)[0].state == "cleared"


def test_a_run_without_a_fault_heals_it_unless_its_run_lives(tmp_path):
    for run in ("dead", "alive", "now"):
        history = History(tmp_path, run)
        history.put([fault(node=run)], 1.0)
        if run == "now":
            history.heal_others(["alive"])
        history.close()
    assert {f.node: f.state for f in read_history(tmp_path)} == {
        "dead": "healed", "alive": "confirmed", "now": "confirmed"}


NOT_A_DATABASE = b"this is no database, and long enough to be none" * 40


@pytest.mark.parametrize("damage", [
    lambda file: file.write_bytes(NOT_A_DATABASE),
    lambda file: file.write_bytes(file.read_bytes()[:4096] + b"\xff" * 4096),
    lambda file: (file.unlink(), sqlite3.connect(file).execute(
        "CREATE TABLE fault (other TEXT)").connection.close())])
def test_a_damaged_file_is_reported_in_one_line_and_never_raises(tmp_path, damage):
    history = History(tmp_path, "r1")
    history.put([fault()], 1.0)
    history.close()
    damage(tmp_path / FILE)
    is_set_aside = (tmp_path / FILE).read_bytes() == NOT_A_DATABASE
    if is_set_aside:
        with pytest.raises(ValueError, match="not a database"):
            read_history(tmp_path)
    again = History(tmp_path, "r2")
    again.put([fault()], 2.0)
    assert again.problem
    assert "\n" not in again.problem
    again.close()
    if is_set_aside:  # and a new history begins
        assert [(row.times, row.run) for row in read_history(tmp_path)] == [(1, "r2")]


def test_a_full_file_ends_the_history_with_one_line(tmp_path):
    history = History(tmp_path, "r1")
    history._data.execute("PRAGMA max_page_count=4")
    for number in range(1000):
        history.put([fault(node=f"n{number}", error="x" * 500)], 1.0)
    assert "full" in history.problem
    history.put([fault()], 2.0)  # nothing more is tried
    history.close()
    assert read_history(tmp_path)


def test_a_folder_that_is_missing_ends_the_history_with_one_line(tmp_path):
    history = History(tmp_path / "none", "r1")
    history.put([fault()], 1.0)
    assert "unable to open" in history.problem
    assert read_history(tmp_path / "none") == []
    assert clear_history(tmp_path / "none") == 0


def test_the_rows_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr("rampart.actors.ftm.history.MOST_ROWS", 10)
    history = History(tmp_path, "r1")
    for number in range(30):
        history.put([fault(node=f"n{number}")], float(number))
    history.close()
    assert [row.node for row in read_history(tmp_path)] == [f"n{n}" for n in range(29, 19, -1)]


# -- one line per event, the same for console, report, page and viewers


TITLES = {"DM1": "Prohibited area", "RM1": "Emergency stop", "FTM1": "Prohibited area"}


def told(*messages, source="DM1"):
    narrator = Narrator(TITLES)
    return [line for number, message in enumerate(messages)
            for line in narrator.describe(message, Header(source, 1, number, 0.0))]


def test_each_event_is_told_once_with_the_titles_of_what_it_names():
    idle, active = (fm.DetectionReport(state, "fence", (), 0.0) for state in (
        fm.DetectionState.IDLE, fm.DetectionState.ACTIVE))
    started, crashed, back, again = (fm.ProcessEvent("hmi", what, 7, 2, by, detail)
                                     for what, by, detail in (
        ("started", "", ""), ("crashed", "supervisor", "SIGKILL"), ("respawned", "RM4", ""),
        ("respawned", "RM4", "already")))
    decision = fm.DecisionRecord(3, "safety-first", ("FTM1",), 1, ("RM1",), (), (), 0.0)
    shadow = fm.ShadowRecord(3, "mission-first", ("FTM1",), 1, (), ())
    assert told(started, idle, active, active, crashed, decision, decision, shadow, back, again,
                idle, idle) == [
        Line("fault", "Prohibited area (DM1): fence"),
        Line("fault", "hmi crashed, incarnation 2: SIGKILL"),
        Line("fault", "decision 3: Emergency stop (RM1): Prohibited area (FTM1), because it is the "
                      "only active mechanism (block 1)."),
        Line("note", "in shadow mission-first would run nothing"),
        Line("clear", "hmi respawned by RM4, incarnation 2"),
        Line("clear", "Prohibited area (DM1): clear")]
