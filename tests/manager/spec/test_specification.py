"""The shipped system loads; every way to get a spec wrong is refused in one line that helps."""

import ast
import copy
import sys
import tomllib
from datetime import date
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.manager.spec.schema import Kind
from rampart.manager.spec.specification import (
    SpecificationError,
    check_document,
    parse_specification,
)
from tests import CELL, ROOT, system_file
from tests.manager.bench import PAPER, paper

FILE = "systems/paper.toml"


def edit(*changes: tuple[str, str]) -> str:
    text = PAPER
    for old, new in changes:
        assert text.count(old) == 1, f"{old!r} occurs {text.count(old)} times"
        text = text.replace(old, new)
    return text


def refusal(text: str) -> str:
    with pytest.raises(SpecificationError) as caught:
        parse_specification(text, FILE)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{FILE}: ")
    return message


def test_the_shipped_system_is_the_papers():
    spec = paper()
    assert {m.name: (m.detect, m.recover) for m in spec.mechanisms} == {
        "FTM1": ("DM1", "RM1"), "FTM2": ("DM2", "RM2"), "FTM3": ("DM3", "RM2"),
        "FTM4": ("DM4", "RM3"), "FTM5": ("DM5", "RM4"), "FTM6": ("DM6", "RM5"),
        "FTM7": ("DM7", "RM4")}
    assert spec.strategy == "safety-first"
    assert [r.name for r in spec.recoveries if r.latched] == ["RM1"]
    assert spec.build_fault_tree().top == "moving_inside_prohibited_area"


def test_each_actor_has_a_process_of_its_own_unless_told_otherwise():
    assert dict.fromkeys(paper().processes(), 1) == {
        name: len(actors) for name, actors in paper().processes().items()}
    assert len(paper().actors()) == 9 + 7 + 5
    shared = parse_specification(edit((
        'actor = "rampart.actors.osmosis.page.hmi:OsmosisHmi"',
         'actor = "rampart.actors.osmosis.page.hmi:OsmosisHmi"\nprocess = "desk"'),
        ('name = "teleoperation"', 'name = "teleoperation"\nprocess = "desk"')), FILE)
    assert [n.name for n in shared.processes()["desk"]] == ["hmi", "teleoperation"]


def test_the_unprotected_baseline_has_no_fault_tolerance_actors():
    spec = parse_specification(edit(("ftm = true", "ftm = false")), FILE)
    kinds = {node.kind for node in spec.actors()}
    assert not kinds & {Kind.DETECTION, Kind.RECOVERY, Kind.MANAGER}
    assert len(spec.actors()) == 8


def test_parameters_may_name_a_timing_value():
    spec = paper()
    dm2 = next(d for d in spec.detections if d.name == "DM2")
    dm3 = next(d for d in spec.detections if d.name == "DM3")
    assert dm2.parameters["timeout_s"] == spec.timing.command_timeout_s == dm2.latency_s
    assert spec.timing.control_period_s == dm3.latency_s


def test_a_timing_value_that_is_given_is_kept():
    spec = parse_specification(edit((
        "arbitration_s = 0.05 ", "command_timeout_s = 1.05\narbitration_s = 0.05 ")), FILE)
    assert spec.timing.command_timeout_s == 1.05
    assert spec.timing.localization_timeout_s == paper().timing.localization_timeout_s


def test_gates_can_be_and_or_at_least():
    spec = parse_specification(edit((
        'gate = "or"\nof = ["control_node_crash"',
        'gate = { at_least = 2 }\nof = ["control_node_crash"'), (
        'gate = "or"\nof = ["localization_estimation_error"',
        'gate = "and"\nof = ["localization_estimation_error"')), FILE)
    required = {e.name: e.required for e in spec.events}
    assert tuple(required[name] for name in (
        "command_not_updated", "localization_error", "erroneous_command")) == (2, 2, 1)


@pytest.mark.parametrize(("within_s", "timeout_s", "longest", "soonest"), [
    (50.0, 0.64, 50.0, 0.64), (0.1, 0.64, 0.64, 0.1)])
def test_of_two_latencies_the_longer_counts_and_the_shorter_for_the_mechanism_below(
        within_s, timeout_s, longest, soonest):
    crash = next(d for d in paper().detections if d.name == "DM2")
    crash = msgspec.structs.replace(crash, within_s=within_s, parameters={"timeout_s": timeout_s})
    assert (crash.latency_s, crash.soonest_s) == (longest, soonest)


def test_a_latency_that_does_not_fit_is_refused_though_the_timeout_would():
    timeout = 'timeout_s = "command_timeout_s" }'
    assert "the time budget does not fit: FTM2 needs 50.150 s" in refusal(
        edit((timeout, f"{timeout}\nwithin_s = 50.0")))


def test_what_parameters_there_are_is_for_the_classes_to_say():
    spec = parse_specification(edit(
        ('topic = "control/command", ', 'topic = 3, hold_s = -1, anything = [true], ')), FILE)
    assert spec.detections[1].parameters["hold_s"] == -1


FTM2 = 'name = "FTM2"\ndetect = "DM2"\nrecover = "RM2"\nevent = "command_not_updated"\n'
HMI = ('name = "hmi"\nactor = "rampart.actors.osmosis.page.hmi:OsmosisHmi"\nkind = "non-control"\n'
       'respawn = "RM4"')
RM4 = 'claims = ["other_nodes"]'
MANAGER = """[[node]]
name = "ftm_manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"
respawn = "supervisor"
"""
PROHIBITED = 'of = ["erroneous_graph", "erroneous_command", "actuator_failure"]'
STALE = 'gate = "or"\nof = ["control_node_crash", "non_control_node_crash"]'

REFUSED = {
    "not TOML": ([("[robot]", "[robot")], ["$: not valid TOML", "line "]),
    # types and fields
    "wrong type": ([("length_m = 0.72", 'length_m = "long"')],
                   ["$.robot.length_m = 'long': expected a number > 0"]),
    "a table where a string belongs": ([('strategy = "safety-first"', "strategy = { x = 1 }")],
                                       ["$.strategy = {'x': 1}: expected a text"]),
    "unknown field": ([("width_m =", "widht_m =")],
                      ["$.robot.widht_m = 0.614: unknown field; known: length_m, width_m"]),
    "unknown top-level field": ([('title = "Runway light', 'tilte = "Runway light')],
                                ["$.tilte = 'Runway", "known: name, title"]),
    "missing field": ([("width_m = 0.614\n", "")],
                      ["$.robot: required field 'width_m' is missing"]),
    "missing table": ([("[robot]", "[layerz]")], ["$.layerz", "unknown field"]),
    "negative time": ([("heartbeat_period_s = 0.14", "heartbeat_period_s = -0.14")],
                      ["$.timing.heartbeat_period_s = -0.14: expected a number > 0"]),
    "zero timeout": ([("arbitration_s = 0.05 ", "command_timeout_s = 0\narbitration_s = 0.05 ")],
                     ["$.timing.command_timeout_s = 0", "> 0"]),
    "time that is not finite": ([("respawn_s = 0.4", "respawn_s = inf")],
                                ["$.timing.respawn_s = inf: expected a finite number"]),
    "nan in a list": ([('watch = ["localization"]', "watch = [nan]")],
                      ["detection DM7: parameters.watch[0] = nan"]),
    "unknown node kind": ([(HMI, HMI.replace("non-control", "operator"))],
                          ["node hmi: kind = 'operator': expected one of control, "
                           "non-control, pilot, manager, world"]),
    "a node that is the supervisor": ([(HMI, HMI.replace("non-control", "supervision"))],
                                      ["node hmi: kind = 'supervision': unknown kind; known: "
                                       "control, non-control, pilot, manager, world"]),
    "unknown recovery kind": ([('kind = "masking"', 'kind = "sideways"')],
                              ["recovery RM4: kind = 'sideways'", "forward, backward, masking"]),
    "unknown hazard": ([('against = "runaway"', 'against = "boredom"')],
                       ["mechanism FTM3: against = 'boredom'", "drift, runaway, intrusion, parent, "
                        "or { within_s = ..., hazard = '...' }"]),
    "a hazard that is a number": ([('against = "runaway"', "against = 0.6")],
                                  ["mechanism FTM3: against = 0.6: expected one of drift, ",
                                   "or { within_s = ..., hazard = '...' }"]),
    "unknown gate": ([(STALE, STALE.replace('"or"', '"xor"'))],
                     ["event command_not_updated: gate = 'xor': expected 'or', 'and' "
                      "or { at_least"]),
    "actor without class": ([('"rampart.actors.osmosis.page.hmi:OsmosisHmi"',
                               '"rampart.actors.osmosis.page.hmi"')],
                            ["node hmi: actor = 'rampart.actors.osmosis.page.hmi': expected "
                              "'module:Class'"]),
    "a name with a slash": ([('name = "hmi"', 'name = "h/mi"')],
                            ["$.node[4].name = 'h/mi': expected a name"]),
    "unknown field of a hazard in words": (
        [('against = "runaway"', 'against = { within_s = 5.0, hazard = "x", bogus = 1 }')],
        ["mechanism FTM3: against.bogus = 1: unknown field; known: within_s, hazard"]),
    "unknown field with a backtick": ([("width_m =", '"wid`th - at `$.x[9]`" =')],
                                      ["$.robot.wid`th - at `$.x[9]` = 0.614: unknown field"]),
    "unknown top-level field with a backtick": (
        [('title = "Runway light', '"ti`tle - at `$.robot" = "Runway light')],
        ["$.ti`tle - at `$.robot = 'Runway", "known: name, title"]),
    "a name with a newline": ([('name = "safety_pilot"', 'name = "safety_pilot\\n"')],
                              ["= 'safety_pilot\\n': expected a name"]),
    # magnitudes
    "a number of thousands of digits": ([("width_m = 0.614", "width_m = " + "9" * 5000)],
                                        ["$: an integer with thousands of digits"]),
    "the same in hexadecimal": ([("width_m = 0.614", "width_m = 0x" + "f" * 5000)],
                                ["$.robot.width_m = a value too large to show: expected"]),
    "a gate with thousands of digits": ([('detect = "DM3"', f'detect = "{"9" * 5000} of (DM3)"')],
                                        ["999...: 999999999 of 1 inputs; expected 1 to 1"]),
    "a timeout that no float holds": (
        [('timeout_s = "command_timeout_s"', "timeout_s = 1" + "0" * 400)],
        ["detection DM2: parameters.timeout_s = 1000", "...: expected an integer of at most 9223"]),
    "a speed whose square no float holds": (
        [("top_speed_mps = 1.0", "top_speed_mps = 1e200")],
        ["$.robot.top_speed_mps = 1e+200: out of all proportion; expected 1e-09 to 1e+09"]),
    "a brake that hardly brakes": ([("braking_mps2 = 2.0", "braking_mps2 = 1e-320")],
                                   ["$.robot.braking_mps2 = 1e-320: out of all proportion"]),
    "a clearance beyond the stars": (
        [("corridor_clearance_m = 1.5", "corridor_clearance_m = 1e306")],
        ["$.robot.corridor_clearance_m = 1e+306: out of all proportion"]),
    "tables without end": ([("[layers]", f"[{'.'.join('a' * 50)}]")],
                           ["$: nested more than 32 deep"]),
    # names
    "duplicate node": ([('name = "hmi"', 'name = "teleoperation"')],
                       ["$.node[5].name = 'teleoperation': duplicate name, already at $.node[4]"]),
    "node named like a module": ([('name = "hmi"', 'name = "DM1"')],
                                 ["$.detection[0].name = 'DM1': duplicate name"]),
    "reserved node name": ([('name = "hmi"', 'name = "supervisor"')],
                           ["$.node[4].name = 'supervisor': duplicate name, reserved"]),
    "reserved name of a router": ([('name = "hmi"', 'name = "router_b"')],
                                  ["$.node[4].name = 'router_b': duplicate name, reserved"]),
    "reserved process": ([('name = "hmi"', 'name = "hmi"\nprocess = "pool"')],
                         ["node hmi: process = 'pool': reserved"]),
    "duplicate mechanism": ([('name = "FTM2"', 'name = "FTM1"')],
                            ["$.mechanism[1].name = 'FTM1': duplicate name, already at "
                             "$.mechanism[0].name; nodes, detection and recovery modules and "
                             "mechanisms share one namespace"]),
    "duplicate event": ([('name = "actuator_failure"', 'name = "erroneous_graph"'),
                         (PROHIBITED, PROHIBITED.replace(', "actuator_failure"', ""))],
                        ["$.event[2].name = 'erroneous_graph': duplicate name, already at "
                         "$.event[1].name"]),
    "duplicate event that leaves a name dangling": (
        [('name = "actuator_failure"', 'name = "erroneous_graph"')],
        ["$.event[2].name = 'erroneous_graph': duplicate name, already at $.event[1].name"]),
    "mechanism named like a detection module": (
        [('name = "FTM2"', 'name = "DM2"')],
        ["$.mechanism[1].name = 'DM2': duplicate name, already at $.detection[1].name"]),
    "mechanism named like a word of gates": (
        [('name = "FTM2"', 'name = "and"')],
        ["$.mechanism[1].name = 'and': a word of gates, no name"]),
    "detection module that no gate can name": (
        [('name = "DM2"', 'name = "of"'), ('detect = "DM2"', 'detect = "of"')],
        ["$.detection[1].name = 'of': a word of gates, no name"]),
    "unknown detection module": ([('detect = "DM3"', 'detect = "DM9"')],
                                 ["mechanism FTM3: detect = 'DM9': unknown detection module; "
                                  "known: DM1, DM2"]),
    "unknown recovery module": ([('recover = "RM5"', 'recover = "RM9"')],
                                ["mechanism FTM6: recover = 'RM9': unknown recovery module; "
                                 "known: RM1"]),
    "mechanism on an unknown event": ([('event = "control_node_crash"', 'event = "meteorite"')],
                                      ["mechanism FTM4: event = 'meteorite': unknown event; "
                                       "known"]),
    "unknown watched node": ([('"hmi", "teleoperation"]', '"hmi", "telly"]')],
                             ["detection DM5: parameters.watch[1] = 'telly': unknown node; known"]),
    "watching nobody": ([('watch = ["localization"]', "watch = []")],
                        ["detection DM7: parameters.watch = []: expected a list of node names"]),
    "watching a node twice": ([('watch = ["hmi", "teleoperation"]', 'watch = ["hmi", "hmi"]')],
                              ["detection DM5: parameters.watch[1] = 'hmi': listed twice"]),
    "unknown respawner": ([(HMI, HMI.replace("RM4", "RM8"))],
                          ["node hmi: respawn = 'RM8': unknown recovery module; known: supervi"]),
    "unknown escalation": ([('escalate_to = "RM2"', 'escalate_to = "RM7"')],
                           ["recovery RM3: escalate_to = 'RM7': unknown recovery module"]),
    "unknown strategy": ([('strategy = "safety-first"', 'strategy = "fingers-crossed"')],
                         ["$.strategy = 'fingers-crossed': unknown strategy; known:", "safety-f"]),
    "unknown order": ([('order = "safer" ', 'order = "braver" ')],
                      ["$.order = 'braver': unknown order; known: safer"]),
    "unknown timing name": ([('timeout_s = "command_timeout_s"', 'timeout_s = "soon"')],
                            ["detection DM2: parameters.timeout_s = 'soon': unknown timing value",
                             "command_timeout_s"]),
    "unknown timing name as latency": ([('within_s = "control_period_s"', 'within_s = "soon"')],
                                       ["detection DM3: within_s = 'soon': unknown timing value"]),
    "unknown recovery in an order": ([('RM5 = ["RM3", "RM4"]', 'RM6 = ["RM3", "RM4"]')],
                                     ["$.orders.safer.RM6 = 'RM6': unknown recovery module"]),
    "unknown lower recovery in an order": ([('RM5 = ["RM3", "RM4"]', 'RM5 = ["RM3", "RM6"]')],
                                           ["$.orders.safer.RM5[1] = 'RM6': unknown recovery"]),
    "duplicate in an order": ([('RM5 = ["RM3", "RM4"]', 'RM5 = ["RM3", "RM3"]')],
                              ["$.orders.safer.RM5[1] = 'RM3': duplicate"]),
    # shapes of orders
    "order that is no table": ([("[orders.safer]", "[orders]")],
                               ["$.orders.RM1 = ['RM2', 'RM5']: expected a table"]),
    "orders that are no table": ([("[orders.safer]", '[[orders]]')],
                                 ["$.orders = [", "expected a table"]),
    "order with a wrong type": ([('RM5 = ["RM3", "RM4"]', 'RM5 = "RM3"')],
                                ["$.orders.safer.RM5 = 'RM3': expected a list"]),
    # detection
    "no latency": ([('within_s = "control_period_s"', "")],
                   ["detection DM3: within_s: missing"]),
    "negative parameter": ([("margin_m = 0.6", "margin_m = -0.6")],
                           ["detection DM1: parameters.margin_m = -0.6: expected a number > 0"]),
    "parameter of the wrong type": ([("margin_m = 0.6", "margin_m = true")],
                                    ["detection DM1: parameters.margin_m = True: expected a numb"]),
    # nodes
    "a module among the nodes": ([('kind = "world"', 'kind = "detection"')],
                                 ["node simulator: kind = 'detection': belongs into "
                                  "[[detection]]"]),
    "manager respawned by its own recovery": (
        [('kind = "manager"\nrespawn = "supervisor"', 'kind = "manager"\nrespawn = "RM4"')],
        ["node ftm_manager: respawn = 'RM4': the manager cannot command its own recovery"]),
    "manager in the process of a node that it recovers": (
        [('kind = "manager"', 'kind = "manager"\nprocess = "hmi"')],
        ["node ftm_manager: process = 'hmi': hmi lives there too and is brought back by RM4, "
         "ftm_manager "
         "by supervisor; who shares a process is brought back by the same"]),
    "node in the process of the manager": (
        [('name = "hmi"', 'name = "hmi"\nprocess = "ftm_manager"')],
        ["node ftm_manager: process = 'ftm_manager': hmi lives there too and is brought back by "
         "RM4"]),
    "nodes of one process with different recoveries": (
        [('name = "hmi"', 'name = "hmi"\nprocess = "graph_planner"')],
        ["node hmi: process = 'graph_planner': graph_planner lives there too and is brought back "
         "by RM3, hmi by RM4"]),
    "recovery module in a process that it ends": (
        [(RM4, RM4 + '\nprocess = "hmi"')],
        ["recovery RM4: process = 'hmi': hmi lives there too and is brought back by RM4, RM4 by "
         "supervisor"]),
    "recovery module told to respawn the manager's process": (
        [('name = "safety_pilot"', 'name = "safety_pilot"\nprocess = "ftm_manager"'),
         (RM4, RM4 + '\nparameters = { nodes = ["hmi", "safety_pilot"] }')],
        ["recovery RM4: parameters.nodes[1] = 'safety_pilot': the manager lives in its process, "
         "and cannot command its own recovery"]),
    "recovery module told to respawn its own process": (
        [('name = "safety_pilot"', 'name = "safety_pilot"\nprocess = "RM4"'),
         (RM4, RM4 + '\nparameters = { nodes = ["safety_pilot"] }')],
        ["recovery RM4: parameters.nodes[0] = 'safety_pilot': RM4 lives in its process, and would "
         "end itself"]),
    "no manager": ([(MANAGER, "")],
                   ["$.node: no node is of kind 'manager', so no mechanism would act; add one with "
                    "actor = 'rampart.manager.actor:FtmManager', or say ftm = false in [layers]"]),
    "two managers": ([(MANAGER, MANAGER + MANAGER.replace("ftm_manager", "another"))],
                     ["node another: kind = 'manager': ftm_manager is of this kind already; a "
                      "system "
                      "has one manager at most"]),
    "a manager of another kind": ([('kind = "manager"', 'kind = "control"')],
                                  ["node ftm_manager: kind = 'control': "
                                   "rampart.manager.actor:FtmManager "
                                   "has to be of kind 'manager'"]),
    "two pilots": ([('kind = "world"', 'kind = "pilot"')],
                   ["node simulator: kind = 'pilot': safety_pilot is of this kind already"]),
    "unreachable node": ([('watch = ["hmi", "teleoperation"]', 'watch = ["teleoperation"]')],
                         ["node hmi: respawn = 'RM4': node 'hmi' is unreachable for RM4"]),
    "unreachable detection module": ([('detect = "DM3"', 'detect = "DM2"')],
                                     ["detection DM3: unreachable"]),
    "unreachable recovery module": ([('recover = "RM5"', 'recover = "RM2"')],
                                    ["recovery RM5: unreachable"]),
    # recoveries
    "a need that nothing meets": ([('needs = ["safety_pilot", "motion"]',
                                    'needs = ["safety_pilto", "motion"]')],
                                  ["recovery RM5: needs = ['motion', 'safety_pilto']: "
                                   "'safety_pilto' is neither a node nor a resource that a recov",
                                   "known: actuation, brakes, ", "motion, "]),
    "a need that nobody can take away": ([('disables = ["motion"]', 'disables = ["motoin"]')],
                                         ["recovery RM5: needs = ['motion', 'safety_pilot']: "
                                          "'motion' is neither", "motoin"]),
    "disabling what nobody uses": ([('disables = ["motion"]', 'disables = ["motion", "motoin"]')],
                                   ["recovery RM1: disables = ['motion', 'motoin']: 'motoin' is "
                                    "neither", "nothing is disabled; known: ", "motion, "]),
    "a need that is a detection module": ([('needs = ["safety_pilot", "motion"]',
                                            'needs = ["DM3"]')],
                                          ["recovery RM5: needs = ['DM3']: 'DM3' is neither"]),
    "a recovery that disables what it needs": (
        [('needs = ["safety_pilot", "motion"]',
          'needs = ["safety_pilot", "motion"]\ndisables = ["motion"]')],
        ["recovery RM5: disables = ['motion']: RM5 itself needs 'motion'; leave it out of one"]),
    # fault tree
    "unknown input": ([(PROHIBITED, PROHIBITED.replace("erroneous_graph", "bad_luck"))],
                      ["event moving_inside_prohibited_area: of[0] = 'bad_luck': unknown event; "
                       "known: moving"]),
    "cycle of events": (
        [('name = "control_node_crash"\n',
          'name = "control_node_crash"\ngate = "or"\nof = ["erroneous_command"]\n')],
        ["event erroneous_command", "cycle erroneous_command > command_not_updated > "
         "control_node_crash > "
                       "erroneous_command"]),
    "empty gate": ([(STALE, 'gate = "or"')],
                   ["event command_not_updated = 'command_not_updated': gate without inputs"]),
    "empty and-gate": ([(STALE, 'gate = "and"\nof = []')],
                       ["event command_not_updated = 'command_not_updated': gate without inputs"]),
    "gate that cannot open": ([(STALE, STALE.replace('"or"', "{ at_least = 3 }"))],
                              ["event command_not_updated = 'command_not_updated': gate needs 3 "
                               "of 2"]),
    "gate that is always open": ([(STALE, STALE.replace('"or"', "{ at_least = 0 }"))],
                                 ["event command_not_updated: gate.at_least = 0: expected a "
                                  "whole number, 1 or more"]),
    "inputs without gate": ([(STALE, STALE.replace('gate = "or"\n', ""))],
                            ["event command_not_updated: of", "inputs without a gate"]),
    "unreachable event": ([(PROHIBITED, PROHIBITED.replace('"erroneous_graph", ', ""))],
                          ["event erroneous_graph = 'erroneous_graph': unreachable from the top "
                           "event"]),
    "two mechanisms on one event": (
        [('event = "command_calculation_error"', 'event = "command_not_updated"')],
        ["mechanism FTM3: event = 'command_not_updated': FTM3", "already holds FTM2"]),
    "several parents in the FTMTree": (
        [('of = ["localization_node_crash"]',
          'of = ["localization_node_crash", "control_node_crash"]')],
        ["mechanism FTM4: event = 'control_node_crash': FTM4: several parents", "FTM2, FTM6"]),
    "several roots of the FTMTree": (
        [('event = "moving_inside_prohibited_area"', 'event = "actuator_failure"')],
        ["mechanism FTM2", "roots: FTM1, FTM2"]),
    # order
    "cycle of recoveries": ([('RM5 = ["RM3", "RM4"]', 'RM5 = ["RM3", "RM4", "RM1"]')],
                            ["$.orders.safer.RM1", "cycle RM1 > RM5 > RM1"]),
    "recovery above itself": ([('RM5 = ["RM3", "RM4"]', 'RM5 = ["RM5"]')], ["cycle RM5 > RM5"]),
    "order that contradicts the tree": (
        [('RM1 = ["RM2", "RM5"]\nRM2 = ["RM3", "RM4"]', "RM1 = ['RM5']\nRM3 = ['RM2']")],
        ["$.orders.safer.RM3 = ['RM2']: contradicts the FTMTree: RM3 of FTM4 is above RM2 of "
         "FTM2"]),
    "cycle of escalations": (
        [('escalate_to = "RM2"', 'escalate_to = "RM4"'),
         ('kind = "masking"', 'kind = "masking"\nescalate_to = "RM3"')],
        ["recovery RM3: escalate_to = 'RM4': cycle RM3 > RM4 > RM3"]),
    "escalation to less": (
        [('escalate_to = "RM1"            # a robot', 'escalate_to = "RM4" # a robot')],
        ["recovery RM2: escalate_to = 'RM4': RM2 is above it"]),
    "a last resort that has to wait": (
        [('claims = ["brakes"]', 'claims = ["brakes", "control_nodes"]')],
        ["RM1, the last resort, would have to wait for RM3", "claims control_nodes"]),
    # what explains, and what is excused
    "excused by no detection module": (
        [("latched = true ", 'excused_by = ["DM77"]\nlatched = true ')],
        ["recovery RM1: excused_by[0] = 'DM77': unknown detection module; known: DM1"]),
    "excused, though it does not latch": (
        [("latched = true ", 'excused_by = ["DM5"]\n# ')],
        ["recovery RM1: excused_by = ['DM5']: only what is latched is excused"]),
    "explaining no mechanism": (
        [('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM77"]')],
        ["mechanism FTM2: explains[0] = 'FTM77': unknown mechanism; known: FTM1"]),
    "explaining itself": (
        [('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM2"]')],
        ["mechanism FTM2: explains = ['FTM2']: FTM2 itself explains others"]),
    "explaining each other": (
        [('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM4"]'),
         ('detect = "DM4"', 'detect = "DM4"\nexplains = ["FTM5"]')],
        ["mechanism FTM2: explains = ['FTM4']: FTM4 itself explains others"]),
    "explaining the last barrier": (
        [('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM1"]')],
        ["mechanism FTM2: explains = ['FTM1']: FTM1 is the root of the FTMTree; the last barrier"]),
    # time
    "bounds that are too slow": ([('within_s = "control_period_s"', "within_s = 0.5")],
                                 ["$.timing: the time budget does not fit: FTM3 needs 0.650 s",
                                  "of 0.435 s before the robot runs away"]),
    "a command timeout that is too long": (
        [("arbitration_s = 0.05 ", "command_timeout_s = 1.2\narbitration_s = 0.05 ")],
        ["does not fit: FTM2 needs 1.350 s (detection 1.200", "of 1.250 s"]),
    "a margin that is too small": ([("margin_m = 0.6", "margin_m = 0.5")],
                                   ["does not fit: FTM1 needs 0.250 s", "of 0.200 s"]),
    "a margin that the robot is always in": ([("margin_m = 0.6", "margin_m = 1.5")],
                                             ["detection DM1: parameters.margin_m = 1.5: would "
                                              "raise false alarms"]),
    "a heartbeat timeout that trips": (
        [("arbitration_s = 0.05 ", "heartbeat_timeout_s = 0.2\narbitration_s = 0.05 ")],
        ["$.timing.heartbeat_timeout_s = 0.2: would raise false alarms; at least 0.420 s"]),
    "a drive slower than its commands": (
        [("hardware_speed_mps = 3.0", "hardware_speed_mps = 0.3")],
        ["$.robot.hardware_speed_mps = 0.3: the drive cannot be slower than top_speed_mps = 1.0"]),
    "a respawn that is too slow": ([("respawn_s = 0.4", "respawn_s = 0.6")],
                                   ["$.timing.heartbeat_timeout_s", "would raise false alarms"]),
    "a robot that is too fast": (
        [("top_speed_mps = 1.0", "top_speed_mps = 2.5")],
        ["$.robot.corridor_clearance_m = 1.5: too little to brake in", "1.562 m"]),
    "intrusion without a margin": ([("margin_m = 0.6, ", "")],
                                   ["mechanism FTM1: against = 'intrusion': DM1 needs"]),
    "a root that races its parent": ([('against = "intrusion"', 'against = "parent"')],
                                     ["mechanism FTM1: against = 'parent': FTM1 is the root"]),
    "a stop distance that is too short": ([("stop_distance_m = 0.8", "stop_distance_m = 0.2")],
                                          ["$.robot.stop_distance_m = 0.2: too little to brake"]),
    "short-sighted robot": ([("sensing_range_m = 5.0", "sensing_range_m = 0.7")],
                            ["$.robot.sensing_range_m = 0.7: obstacles must be seen"]),
    "a hold above its bound": ([("release_hold_s = 0.5 ", "release_hold_s = 20.0 ")],
                               ["$.timing.release_hold_max_s = 10.0: must be no less"]),
    "a backoff above its bound": ([("[layers]", "[supervision]\nbackoff_s = 3.0\n[layers]")],
                                  ["$.supervision.backoff_max_s = 2.0: must be no less than "
                                   "backoff_s = 3"]),
    "attempts that come sooner and sooner": (
        [("[layers]", "[supervision]\nattempt_max_s = 5.0\n[layers]")],
        ["$.supervision.attempt_max_s = 5.0: must be no less than attempt_s = 10"]),
    "no restart at all": ([("[layers]", "[supervision]\nintensity = 0\n[layers]")],
                          ["$.supervision.intensity = 0: "]),
    "a window that is none": ([("[layers]", "[supervision]\nperiod_s = 0.0\n[layers]")],
                              ["$.supervision.period_s = 0.0: "]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    changes, fragments = REFUSED[case]
    message = refusal(edit(*changes))
    for fragment in fragments:
        assert fragment in message


def test_a_system_without_fault_tolerance_needs_no_manager():
    spec = parse_specification(edit((MANAGER, ""), ("ftm = true", "ftm = false")), FILE)
    assert not [node for node in spec.nodes if node.kind is Kind.MANAGER]


def test_the_manager_may_share_a_process_with_what_the_supervisor_brings_back():
    spec = parse_specification(
        edit(('kind = "manager"', 'kind = "manager"\nprocess = "DM3"')), FILE)
    assert [node.name for node in spec.processes()["DM3"]] == ["ftm_manager", "DM3"]


def test_a_byte_order_mark_is_no_part_of_the_text():
    assert parse_specification("\ufeff" + PAPER, FILE) == paper()


def test_without_a_robot_timeouts_are_five_periods_of_what_they_wait_for():
    cell = CELL.read_text(encoding="utf-8")
    before, _, rest = cell.partition("[timing]")
    left = rest.partition("# ---- Nodes")[2]
    said = "control_period_s = 0.1\nheartbeat_timeout_s = 0.3\nmanager_timeout_s = 0.7\n"
    timing = parse_specification(f"{before}[timing]\n{said}# {left}", FILE).timing
    assert (timing.heartbeat_timeout_s, timing.command_timeout_s, timing.manager_timeout_s,
            timing.detection_silence_timeout_s) == (0.3, 0.5, 0.7, 1.0)


def test_recoveries_without_any_mechanism_are_refused():
    head, _, rest = PAPER.partition('[[mechanism]]\nname = "FTM1"')
    text = head + rest[rest.index("# ---- Fault tree"):]
    assert "$.mechanism: missing" in refusal(text)


def test_no_event_at_all_is_refused():
    head, _, rest = PAPER.partition('[[event]]\nname = "moving_inside_prohibited_area"')
    text = head + rest[rest.index("# ---- Orders"):]
    assert "unknown event; known: none" in refusal(text)


def test_the_error_carries_its_parts():
    with pytest.raises(SpecificationError) as caught:
        parse_specification(edit(('detect = "DM3"', 'detect = "DM9"')), FILE)
    assert (caught.value.file, caught.value.path) == (FILE, "mechanism FTM3: detect")
    assert caught.value.problem.startswith("unknown detection module")


def test_a_spec_is_plain_data_that_can_be_sent_to_another_process():
    spec = paper()
    assert spec == msgspec.json.decode(msgspec.json.encode(spec), type=type(spec))


def test_the_core_of_the_manager_imports_nothing_but_itself_and_how_files_are_read():
    allowed = set(sys.stdlib_module_names) | {"msgspec", "oxidd", "defusedxml"}
    for path in (ROOT / "manager").rglob("*.py"):
        if path.name == "actor.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else \
                [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for module in modules:
                assert module.split(".")[0] in allowed or f"{module}.".startswith(
                    ("rampart.manager.", "rampart.files.")), path
                assert module != "rampart.manager.actor", path
            assert not {"time", "asyncio", "random"} & set(modules), path


SHIPPED = {name: tomllib.loads(system_file(name).read_text(encoding="utf-8"))
           for name in ("paper", "osmosis", "cell")}
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from([0, -1, 1e-320, 1e200, 1e306, 10 ** 400, date(2020, 1, 1),
                       "9" * 5000 + " of (DM1)", "not DM1", "(" * 99, "RM1 and RM2", "a\nb"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner,
                                                                max_size=3), max_leaves=4)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Return every container and key within a document."""
    inner = list(value.items() if isinstance(value, dict) else enumerate(value)
                 if isinstance(value, list) else ())
    return [(value, key) for key, _ in inner] + [p for _, v in inner for p in places(v)]


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(SHIPPED)), st.data())
def test_a_document_with_anything_anywhere_is_a_system_or_refused_in_one_line(name, data):
    document = copy.deepcopy(SHIPPED[name])
    for _ in range(data.draw(st.integers(1, 3))):
        known = places(document)
        at, key = known[data.draw(st.integers(0, len(known) - 1))]
        match data.draw(st.sampled_from(["anything", "another", "delete", "unknown", "nest"])):
            case "anything":
                at[key] = data.draw(VALUES)
            case "another":
                other, place = known[data.draw(st.integers(0, len(known) - 1))]
                at[key] = copy.deepcopy(other[place])
            case "delete":
                del at[key]
            case "unknown" if isinstance(at, dict):
                at[data.draw(st.text(max_size=8))] = data.draw(VALUES)
            case _:
                at[key] = data.draw(st.sampled_from([[at[key]], {"x": at[key]}]))
        if not document:
            break
    refused = ""
    try:
        check_document(document, FILE)
    except SpecificationError as error:
        refused = str(error)
    assert len(refused.splitlines()) <= 1
