"""The shipped system loads; every way to get a spec wrong is refused in one line that helps.

Those of several hosts, and those with commands as nodes, likewise. The time budget is held
against a simulated drive.
"""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from rampart import SpecificationError, parse_specification
from rampart.actors.foreign.program import check_programs
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.hosts import Hosts
from rampart.actors.system.layout import Layout
from rampart.manager.spec import mobile_robot
from rampart.manager.spec.budget import check, find_false_alarms
from rampart.manager.spec.schema import Kind
from rampart.manager.spec.specification import check_change
from rampart.manager.spec.tables import Timing
from tests import CELL
from tests.documents.page import Page
from tests.manager.bench import PAPER, paper
from tests.tug import TUG, write_tug
from tests.two_hosts import two_hosts

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
    return message.removeprefix(f"{FILE}: ")


def test_the_shipped_system_is_the_papers():
    spec = paper()
    assert {m.name: (m.detect, m.recover) for m in spec.mechanisms} == {
        "FTM1": ("DM1", "RM1"), "FTM2": ("DM2", "RM2"), "FTM3": ("DM3", "RM2"),
        "FTM4": ("DM4", "RM3"), "FTM5": ("DM5", "RM4"), "FTM6": ("DM6", "RM5"),
        "FTM7": ("DM7", "RM4")}
    assert spec.strategy == "safety-first"
    assert [r.name for r in spec.recoveries if r.latched] == ["RM1"]
    assert spec.build_fault_tree().top == "moving_inside_prohibited_area"


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
    "$: not valid TOML": [("[robot]", "[robot")],
    "$.robot.widht_m = 0.614: unknown field; known:": [("width_m =", "widht_m =")],
    "$.timing.respawn_s = inf: expected a finite number": [("respawn_s = 0.4", "respawn_s = inf")],
    "node hmi: kind = 'supervision': unknown kind; known:": [
        (HMI, HMI.replace("non-control", "supervision"))],
    "node hmi: actor = 'rampart.actors.osmosis.page.hmi':": [
        ('"rampart.actors.osmosis.page.hmi:OsmosisHmi"', '"rampart.actors.osmosis.page.hmi"')],
    "$.ti`tle - at `$.robot = 'Runway": [
        ('title = "Runway light', '"ti`tle - at `$.robot" = "Runway light')],
    "= 'safety_pilot\\n': expected a name": [('name = "safety_pilot"', 'name = "safety_pilot\\n"')],
    "$: an integer with thousands of digits": [("width_m = 0.614", "width_m = " + "9" * 5000)],
    "$.robot.top_speed_mps = 1e+200: expected 0, or 1e-09 to": [
        ("top_speed_mps = 1.0", "top_speed_mps = 1e200")],
    "$.node[4]: required field 'name' is missing": [('name = "hmi"\n', "")],
    "999...: 999999999 of 1 inputs; expected 1 to 1": [
        ('detect = "DM3"', f'''detect = "{'9' * 5000} of (DM3)"''')],
    "detection DM2: parameters.timeout_s = 1000": [
        ('timeout_s = "command_timeout_s"', "timeout_s = 1" + "0" * 400)],
    "mechanism FTM3: detect = 'DM9': unknown detection": [('detect = "DM3"', 'detect = "DM9"')],
    "event moving_inside_prohibited_area: of[0] =": [
        (PROHIBITED, PROHIBITED.replace("erroneous_graph", "bad_luck"))],
    "$.order = 'braver': unknown order; known: safer": [('order = "safer" ', 'order = "braver" ')],
    "detection DM5: parameters.watch[1] = 'telly': unknown": [
        ('"hmi", "teleoperation"]', '"hmi", "telly"]')],
    "$: nested more than 32 deep": [("[layers]", f"[{'.'.join('a' * 50)}]")],
    "$.node[5].name = 'teleoperation': duplicate name,": [
        ('name = "hmi"', 'name = "teleoperation"')],
    "node hmi: process = 'pool': reserved": [('name = "hmi"', 'name = "hmi"\nprocess = "pool"')],
    "$.event[2].name = 'erroneous_graph': duplicate name,": [
        ('name = "actuator_failure"', 'name = "erroneous_graph"'),
        (PROHIBITED, PROHIBITED.replace(', "actuator_failure"', ""))],
    "$.mechanism[1].name = 'and': expected a name that is": [('name = "FTM2"', 'name = "and"')],
    "node hmi: respawn = 'RM8': unknown recovery module;": [(HMI, HMI.replace("RM4", "RM8"))],
    "detection DM2: parameters.timeout_s = 'soon': unknown": [
        ('timeout_s = "command_timeout_s"', 'timeout_s = "soon"')],
    "$.orders.safer.RM6 = 'RM6': unknown recovery module": [
        ('RM5 = ["RM3", "RM4"]', 'RM6 = ["RM3", "RM4"]')],
    "$.orders.safer.RM5[1] = 'RM3': duplicate": [('RM5 = ["RM3", "RM4"]', 'RM5 = ["RM3", "RM3"]')],
    "$.orders.safer.RM5 = 'RM3': expected a list": [('RM5 = ["RM3", "RM4"]', 'RM5 = "RM3"')],
    "detection DM3: within_s: missing": [('within_s = "control_period_s"', "")],
    "detection DM1: parameters.margin_m = True: expected a": [
        ("margin_m = 0.6", "margin_m = true")],
    "node simulator: kind = 'detection': expected in": [('kind = "world"', 'kind = "detection"')],
    "node ftm_manager: respawn = 'RM4': expected 'supervis": [
        ('kind = "manager"\nrespawn = "supervisor"', 'kind = "manager"\nrespawn = "RM4"')],
    "node ftm_manager: process = 'hmi': RM4 restarts hmi": [
        ('kind = "manager"', 'kind = "manager"\nprocess = "hmi"')],
    "nodes[1] = 'safety_pilot': it shares the process of the": [
        ('name = "safety_pilot"', 'name = "safety_pilot"\nprocess = "ftm_manager"'),
        (RM4, RM4 + '\nparameters = { nodes = ["hmi", "safety_pilot"] }')],
    "nodes[0] = 'safety_pilot': it shares the process of RM4": [
        ('name = "safety_pilot"', 'name = "safety_pilot"\nprocess = "RM4"'),
        (RM4, RM4 + '\nparameters = { nodes = ["safety_pilot"] }')],
    "$.node: no node is of kind 'manager', so no mechanism": [(MANAGER, "")],
    "node another: kind = 'manager': expected at most one": [
        (MANAGER, MANAGER + MANAGER.replace("ftm_manager", "another"))],
    "node ftm_manager: kind = 'control':": [('kind = "manager"', 'kind = "control"')],
    "node hmi: respawn = 'RM4': node 'hmi' is unreachable": [
        ('watch = ["hmi", "teleoperation"]', 'watch = ["teleoperation"]')],
    "detection DM3: unreachable": [('detect = "DM3"', 'detect = "DM2"')],
    "recovery RM5: unreachable": [('recover = "RM5"', 'recover = "RM2"')],
    "recovery RM5: needs = ['motion', 'safety_pilto']:": [
        ('needs = ["safety_pilot", "motion"]', 'needs = ["safety_pilto", "motion"]')],
    "recovery RM1: disables = ['motion', 'motoin']: 'motoin'": [
        ('disables = ["motion"]', 'disables = ["motion", "motoin"]')],
    "recovery RM5: disables = ['motion']: RM5 itself needs": [
        ('needs = ["safety_pilot", "motion"]',
         'needs = ["safety_pilot", "motion"]\ndisables = ["motion"]')],
    "event command_not_updated: of": [(STALE, STALE.replace('gate = "or"\n', ""))],
    "event erroneous_graph = 'erroneous_graph': unreachable": [
        (PROHIBITED, PROHIBITED.replace('"erroneous_graph", ', ""))],
    "mechanism FTM3: event = 'command_not_updated': FTM3": [
        ('event = "command_calculation_error"', 'event = "command_not_updated"')],
    "mechanism FTM2": [('event = "moving_inside_prohibited_area"', 'event = "actuator_failure"')],
    "cycle RM1 > RM5 > RM1": [('RM5 = ["RM3", "RM4"]', 'RM5 = ["RM3", "RM4", "RM1"]')],
    "$.orders.safer.RM3 = ['RM2']: contradicts the FTMTree:": [
        ('RM1 = ["RM2", "RM5"]\nRM2 = ["RM3", "RM4"]', "RM1 = ['RM5']\nRM3 = ['RM2']")],
    "recovery RM3: escalate_to = 'RM4': cycle RM3 > RM4 > RM3": [
        ('escalate_to = "RM2"', 'escalate_to = "RM4"'),
        ('kind = "masking"', 'kind = "masking"\nescalate_to = "RM3"')],
    "recovery RM2: escalate_to = 'RM4': RM2 is above it": [
        ('escalate_to = "RM1"            # a robot', 'escalate_to = "RM4" # a robot')],
    "RM1, the last resort, would have to wait for RM3": [
        ('claims = ["brakes"]', 'claims = ["brakes", "control_nodes"]')],
    "recovery RM1: excused_by = ['DM5']: expected only with": [
        ("latched = true ", 'excused_by = ["DM5"]\n# ')],
    "mechanism FTM2: explains = ['FTM2']: FTM2 itself": [
        ('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM2"]')],
    "mechanism FTM2: explains = ['FTM4']: FTM4 itself": [
        ('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM4"]'),
        ('detect = "DM4"', 'detect = "DM4"\nexplains = ["FTM5"]')],
    "mechanism FTM2: explains = ['FTM1']: FTM1 is the root": [
        ('detect = "DM2"', 'detect = "DM2"\nexplains = ["FTM1"]')],
    "$.timing: the time budget does not fit: FTM3 needs": [
        ('within_s = "control_period_s"', "within_s = 0.5")],
    "detection DM1: parameters.margin_m = 1.5: would raise": [("margin_m = 0.6", "margin_m = 1.5")],
    "$.timing.heartbeat_timeout_s = 0.2: would raise false": [
        ("arbitration_s = 0.05 ", "heartbeat_timeout_s = 0.2\narbitration_s = 0.05 ")],
    "$.robot.hardware_speed_mps = 0.3: expected at least": [
        ("hardware_speed_mps = 3.0", "hardware_speed_mps = 0.3")],
    "$.robot.corridor_clearance_m = 1.5: expected more than": [
        ("top_speed_mps = 1.0", "top_speed_mps = 2.5")],
    "mechanism FTM1: against = 'intrusion': DM1 needs": [("margin_m = 0.6, ", "")],
    "mechanism FTM1: against = 'parent': FTM1 is the root": [
        ('against = "intrusion"', 'against = "parent"')],
    "$.robot.stop_distance_m = 0.2: expected more than": [
        ("stop_distance_m = 0.8", "stop_distance_m = 0.2")],
    "$.robot.sensing_range_m = 0.7: expected more than": [
        ("sensing_range_m = 5.0", "sensing_range_m = 0.7")],
    "$.timing.release_hold_max_s = 10.0: expected at least": [
        ("release_hold_s = 0.5 ", "release_hold_s = 20.0 ")],
    "$.end.after_s = 0: expected a number > 0": [("[layers]", "[end]\nafter_s = 0\n[layers]")],
    "$.supervision.backoff_max_s = 2.0: expected at least": [
        ("[layers]", "[supervision]\nbackoff_s = 3.0\n[layers]")],
}


KEPT = ("checkpoints = false", "checkpoints = true")
REFUSED |= {words: [(f'name = "{name}"\n', f'name = "{name}"\n{fields}\n'), *kept]
            for words, name, fields, kept in (
    ("clears = 'sometimes'", "FTM2", 'clears = "sometimes"', [KEPT]),
    ("RM1 is latched; expected 'by operator' or 'never'", "FTM1", 'clears = "by itself"', [KEPT]),
    ("expected only if it clears by operator", "FTM2", 'cleared_by = "inject"', [KEPT]),
    ("expected 'drive' or 'inject'", "FTM2", 'cleared_by = "look"', [KEPT]),
    ("expected only if it clears", "FTM2", 'clears = "never"\nclear_after_s = 3', [KEPT]),
    ("expected a number, 0 or more", "FTM2", "clear_after_s = -1", [KEPT]),
    ("expected checkpoints = true in [layers]", "FTM2", 'clears = "never"', []))}


@pytest.mark.parametrize("words", REFUSED)
def test_refused(words):
    assert words in refusal(edit(*REFUSED[words]))


def test_what_is_wanting_altogether_is_refused_and_without_fault_tolerance_no_manager_is_needed():
    for begin, end, words in (
            ('[[mechanism]]\nname = "FTM1"', "# ---- Fault tree", "$.mechanism: missing"),
            ('[[event]]\nname = "moving_inside', "# ---- Orders", "unknown event; known: none")):
        head, _, rest = PAPER.partition(begin)
        assert words in refusal(head + rest[rest.index(end):])
    spec = parse_specification(edit((MANAGER, ""), ("ftm = true", "ftm = false")), FILE)
    assert {node.kind for node in spec.actors()} == {
        Kind.CONTROL, Kind.NON_CONTROL, Kind.PILOT, Kind.WORLD}


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


# -- systems of several hosts: what is refused, and what the link costs


ADDRESSES = {"robot": "192.168.7.1", "ground": "192.168.7.2"}
TEXT = two_hosts(ADDRESSES)
HOSTED = parse_specification(TEXT, "two.toml")
WHEN_LOST = Page("how-to/several-machines").of("toml")[1]
TWO = '[[host]]\nname = "ground"\naddress = "192.168.7.2"\n\n'


def test_the_first_host_s_names_are_those_of_a_system_of_one_machine():
    hosts = Hosts(HOSTED)
    assert hosts.supervisors == {"": "supervisor", "ground": "supervisor_ground"}
    assert hosts.guards_of("") == ("supervisor", "router_a", "router_b")
    assert hosts.home_of["hmi"] == "ground"
    assert hosts.home_of["DM1"] == ""
    assert hosts.dials(0, "tcp") == []
    assert hosts.listens(1, "tcp") == ["tcp/192.168.7.1:7461"]
    assert Hosts(HOSTED, "ground").dials(1, "tls") == ["tls/192.168.7.1:7461"]
    assert hosts.meeting_place() == ("192.168.7.1", 7462)
    spec = parse_specification(TEXT.replace("192.168.7.1", "fd00::1"), "two.toml")
    assert Hosts(spec).listens(0, "tcp") == ["tcp/[fd00::1]:7460"]


def test_a_module_beyond_the_link_has_so_much_less_time():
    alone = {b.name: b for b in check(parse_specification(
        two_hosts(ADDRESSES, on_ground=("hmi", "teleoperation", "DM5")), "near.toml"))}
    far = {b.name: b for b in check(HOSTED)}
    assert far["FTM10"].detection_s == pytest.approx(alone["FTM10"].detection_s + 0.3)
    assert far["FTM1"].detection_s == alone["FTM1"].detection_s


def test_the_mechanism_of_the_page_for_a_lost_link_fits_in_what_it_allows():
    text = TEXT.replace('"overload"]', '"overload", "link_lost"]').replace(
        "[[detection]]\n", f"{WHEN_LOST}\n[[detection]]\n", 1)
    lost, = (one for one in check(parse_specification(text, "lost.toml")) if one.name == "FTM15")
    assert (lost.time_left_s, lost.detection_s, lost.fits) == (10.0, 6.2, True)
    assert lost.hazard == "nobody watches the robot"


@pytest.mark.parametrize(("old", "new", "message"), [
    (TWO, "", "$.host: one machine needs no [[host]]; remove it, or add another one"),
    ('address = "192.168.7.2"', 'address = "ground.local"',
     "host ground: address = 'ground.local': expected an IP address such as '192.168.7.1'"),
    ('address = "192.168.7.2"', 'address = "192.168.7.1"\nport = 7462',
     "host ground: port = 7462: each host uses 3 ports, and robot has the same address and uses "
     "those from 7460"),
    ('name = "ground"\naddress', 'name = "robot"\naddress', "$.host[1].name = 'robot': duplicate"),
    ('name = "safety_pilot"', 'name = "safety_pilot"\nhost = "ground"',
     "node safety_pilot: host = 'ground': expected 'robot', the first host"),
    ('name = "DM3"', 'name = "DM3"\nhost = "ground"\nprocess = "RM1"',
     "recovery RM1: host = 'robot': expected 'ground', the host of DM3, which shares the process"),
    ('name = "DM7"', 'name = "DM7"\nhost = "ground"',
     "detection DM7: parameters.timeout_s = 0.44: expected at least 0.58 s, two heartbeats and "
     "[link] delay_s: DM7 watches localization over the link"),
    ('name = "DM1"', 'name = "DM1"\nhost = "ground"',
     "$.timing: the time budget does not fit: FTM1"),
    ('name = "DM9"', 'name = "supervisor_ground"', "supervisor_ground': duplicate name, reserved"),
])
def test_hosts_refused(old, new, message):
    assert old in TEXT
    with pytest.raises(SpecificationError) as caught:
        parse_specification(TEXT.replace(old, new, 1), "two.toml")
    assert message in str(caught.value)


def test_without_hosts_no_node_can_be_on_one():
    one = '[[host]]\nname = "robot"\naddress = "192.168.7.1"\n\n'
    text = TEXT.replace(TWO, "").replace(one, "")
    with pytest.raises(SpecificationError, match=r"host = 'ground': unknown host; known: none"):
        parse_specification(text, "one.toml")


# -- commands as nodes


COMMAND_NODE = "rampart.actors.foreign.command_node:CommandNode"
COMMAND = 'command = ["./wheels"]'
BEAT = "heartbeat = { notify = true, timeout_s = 0.5 }"
WRONG = [
    (COMMAND, f'{COMMAND}\nactor = "cart:VirtualWheels"', "wheels: command = .*: expected only"),
    ('actor = "cart:Driver"', "", "driver: actor: missing; expected actor = 'module:Class'"),
    ('actor = "cart:Driver"', 'actor = "cart:Driver"\nfolder = "x"', "driver: folder = .*: exp"),
    (COMMAND, "command = ['']", "wheels: command = .*: expected the name of a program"),
    (COMMAND, 'command = ["./wheels", "\\u0000"]', "wheels: command = .* null character"),
    (COMMAND, f'{COMMAND}\nenv = {{ "A=B" = "x" }}', "wheels: env.A=B = 'x': expected a name"),
    (BEAT, 'heartbeat = { key = "a", topic = "tug/wheels", timeout_s = 0.5 }',
     "wheels: heartbeat = .*: expected one of key = "),
    (BEAT, 'heartbeat = { topic = "tug/command", timeout_s = 0.5 }',
     "wheels: heartbeat.topic = 'tug/command': expected a topic that the node publishes"),
    (BEAT, 'heartbeat = { key = "a/**", timeout_s = 0.5 }', "wheels: heartbeat.key = .*: expected"),
    ('hears = ["tug/command"]', 'hears = ["tug/command", "tug/command"]', "wheels: hears = .*twi"),
    ('hears = ["tug/command"]', 'hears = ["detection/{name}"]', "wheels: hears = .*: exp"),
    ('stand_in = "cart:VirtualWheels"', "parameters = { radius_m = 0.1 }", "wheels: parameters: "),
    (f'{COMMAND}\nkind = "control"', f'{COMMAND}\nkind = "manager"', "wheels: comm.*: exp.* actor"),
]


@pytest.mark.parametrize(("old", "new", "line"), WRONG, ids=range(len(WRONG)))
def test_a_mistake_is_one_line_that_names_the_node(old, new, line):
    assert TUG.count(old) == 1
    assert re.match(line, refusal(TUG.replace(old, new)))


@pytest.fixture
def tug(tmp_path, monkeypatch):
    """Return what writes the system of the page, changed, and returns its plan."""
    write_tug(tmp_path, compiled=False)
    (tmp_path / "wheels").write_text("#!/bin/sh\n")
    (tmp_path / "wheels").chmod(0o755)
    monkeypatch.syspath_prepend(tmp_path)

    def write(old="", new="", **plan):
        (tmp_path / "tug.toml").write_text(TUG.replace(old, new))
        return RunPlan(system_file=str(tmp_path / "tug.toml"), **plan)

    return write


@pytest.mark.parametrize(("old", "new", "line"), [
    ("cart:VirtualWheels", "cart:Nobody", "stand_in = 'cart:Nobody': no such actor class; known: "),
    ("cart:Driver", COMMAND_NODE, f"actor = '{COMMAND_NODE}': expected command = "),
    ("stand_in", "parameters = { radius_m = 1 }\nstand_in", "radius_m = 1: unknown field"),
    ("cart:Driver", "rampart.actors.runtime.stub_node:StubNode",
     "hears 'tug/command', which nothing publishes"),
    ('hears = ["tug/command"]', 'hears = ["tug/comand"]', "'tug/comand'; the nearest")])
def test_a_stand_in_is_held_to_what_the_file_says_of_it_in_real_runs_too(tug, old, new, line):
    plan = tug(old, new)
    with pytest.raises(ValueError, match=line):
        Layout(plan, load_system(plan))


@pytest.mark.parametrize(("old", "new", "line"), [
    ("./wheels", "./none", "command = .*: no such file"),
    ("./wheels", "./cart.py", "command = .*cart.py is not executable; use chmod"),
    ("./wheels", "no-such-program", "command = .*: no program 'no-such-program' in PATH"),
    (COMMAND, f'{COMMAND}\nfolder = "none"', "folder = 'none': no such folder")])
def test_a_program_that_cannot_be_run_is_one_line(tug, old, new, line):
    plan = tug(old, new)
    with pytest.raises(SpecificationError, match=f"^{plan.system_file}: wheels: {line}"):
        check_programs(plan, load_system(plan))


def test_a_program_is_found_in_its_folder_and_in_path(tug, tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "wheels").rename(tmp_path / "bin" / "wheels")
    for command in ('["sh"]', '["/bin/sh"]', '["./wheels"]\nfolder = "bin"',
                    f'["wheels"]\nenv = {{ PATH = "{tmp_path}/bin" }}'):
        plan = tug(COMMAND, f"command = {command}")
        check_programs(plan, load_system(plan))


def test_in_virtual_time_the_stand_in_is_the_node_and_a_command_without_one_is_refused(tug):
    plan = tug('stand_in = "cart:VirtualWheels"', "", virtual=True)
    with pytest.raises(SpecificationError, match="virtual time has no processes"):
        load_system(plan)
    plan = tug(virtual=True)
    member = Layout(plan, load_system(plan)).members["wheels"]
    assert member.actor.__name__ == "VirtualWheels"


@pytest.mark.parametrize(("old", "new", "field"), [
    ("./wheels", "./other", "command"), (COMMAND, f'{COMMAND}\nfolder = "/tmp"', "folder"),
    (COMMAND, f'{COMMAND}\nenv = {{ LD_PRELOAD = "/tmp/x.so" }}', "env"),
    ('name = "wheels"', 'name = "others"', "others, wheels")])
def test_no_change_of_a_running_system_changes_what_is_executed(old, new, field):
    before = parse_specification(TUG, "tug.toml")
    after = parse_specification(TUG.replace(old, new), "tug.toml")
    check_change(before, before)
    with pytest.raises(ValueError, match=f"{field}(: a| = .* stays).* (keeps|while)"):
        check_change(before, after)


# -- the time budget: formulas against a simulated drive, derivation, what does not fit


SPEC = paper()
ROBOT = SPEC.robot


def with_timing(**values):
    return replace(SPEC, timing=replace(SPEC.timing, **values))


def drive_m(robot, waiting_s: float, acceleration_mps2: float) -> float:
    """Distance driven until standstill, step by step: wait with the error, then brake."""
    step_s, distance_m, speed_mps, time_s = 1e-4, 0.0, robot.top_speed_mps, 0.0
    fastest = max(robot.top_speed_mps, robot.hardware_speed_mps)
    while speed_mps > 0:
        rate = acceleration_mps2 if time_s < waiting_s else -robot.braking_mps2
        after = min(max(speed_mps + rate * step_s, 0.0), fastest)
        distance_m += (speed_mps + after) / 2 * step_s
        speed_mps, time_s = after, time_s + step_s
    return distance_m


@settings(max_examples=10, deadline=None)
@given(st.floats(0.3, 2.0), st.floats(0.5, 4.0), st.floats(0.5, 4.0), st.floats(3.0, 12.0))
def test_who_waits_as_long_as_it_may_stops_right_at_the_edge(speed, accel, brake, clearance):
    robot = replace(ROBOT, top_speed_mps=speed, acceleration_mps2=accel, braking_mps2=brake,
                    corridor_clearance_m=clearance + speed ** 2 / (2 * brake))
    for acceleration, waiting_s in ((accel, mobile_robot.time_to_runaway_s(robot)),
                                    (0.0, mobile_robot.time_to_drift_s(robot))):
        assert drive_m(robot, waiting_s, acceleration) == pytest.approx(
            robot.corridor_clearance_m, abs=5e-3)


def test_a_robot_that_cannot_even_brake_in_its_corridor_has_no_time():
    robot = replace(ROBOT, corridor_clearance_m=0.2)
    time_s = mobile_robot.time_to_runaway_s(robot)
    assert time_s == pytest.approx(mobile_robot.time_to_drift_s(robot))
    assert time_s < 0


def test_a_guard_that_is_switched_off_needs_no_time():
    layers = replace(SPEC.layers, safety_pilot_checks=False, dead_man=False, manager_watch=False,
                     ftm=False)
    assert [b.name for b in check(replace(SPEC, layers=layers))] == ["safety_pilot"]


def test_the_numbers_of_the_shipped_robot():
    assert mobile_robot.time_to_drift_s(ROBOT) == pytest.approx(1.25)
    assert mobile_robot.time_to_obstacle_s(ROBOT) == pytest.approx(0.55)
    assert mobile_robot.time_to_intrusion_s(ROBOT, 0.6) == pytest.approx(0.3)
    timing = SPEC.timing
    assert (timing.command_timeout_s, timing.localization_timeout_s, timing.manager_timeout_s,
            timing.detection_silence_timeout_s, timing.scan_timeout_s, timing.dead_man_timeout_s,
            timing.heartbeat_timeout_s) == (0.99, 0.99, 0.99, 0.99, 0.36, 0.405, 0.44)


def test_only_a_repair_pays_for_the_respawn_and_a_given_command_timeout_moves_the_heartbeat():
    assert {b.name: b.respawn_s for b in check(SPEC) if b.respawn_s} == {
        "FTM4": 0.4, "FTM5": 0.4, "FTM7": 0.4}
    timing = mobile_robot.derive_timeouts(ROBOT, replace(Timing(), command_timeout_s=0.9))
    assert (timing.command_timeout_s, round(timing.heartbeat_timeout_s, 6)) == (0.9, 0.35)
    timing = mobile_robot.derive_timeouts(replace(ROBOT, corridor_clearance_m=20.0), Timing())
    assert timing.heartbeat_timeout_s == 0.5, "at most five periods"


@given(speed=st.floats(0.2, 3.0), brake=st.floats(0.5, 5.0), clearance=st.floats(0.5, 10.0),
       stop=st.floats(0.3, 5.0))
def test_derived_timeouts_always_fit_whatever_the_robot(speed, brake, clearance, stop):
    """If there is time at all; otherwise they are so short that they are refused."""
    robot = replace(ROBOT, top_speed_mps=speed, braking_mps2=brake, stop_distance_m=stop,
                    corridor_clearance_m=clearance)
    spec = replace(SPEC, mobile=robot, timing=mobile_robot.derive_timeouts(robot, Timing()))
    detections = tuple(
        replace(d, within_s=timeout_s, parameters=d.parameters | {"timeout_s": timeout_s})
        if "timeout_s" in d.parameters else d
        for d in SPEC.detections
        for timeout_s in [getattr(spec.timing, {
            "DM2": "command_timeout_s", "DM6": "localization_timeout_s"}.get(
                d.name, "heartbeat_timeout_s"))])
    spec = replace(spec, detections=detections)
    if list(find_false_alarms(spec.timing)):
        return
    late = {b.name for b in check(spec) if not b.fits}
    assert late <= {"FTM1", "FTM3", "safety_pilot"}  # these have no timeout that could be derived


@pytest.mark.parametrize(("change", "late"), [
    ({"respawn_s": 0.401}, {"FTM4", "FTM5", "FTM7"}),
    ({"scan_timeout_s": 0.401}, {"blind_pilot"}),
    ({"dead_man_timeout_s": 0.451}, {"dead_man"}),
    ({"manager_timeout_s": 1.101}, {"manager_watch"}),
    ({"detection_silence_timeout_s": 1.101}, {"silent_detection"}),
    ({"actuation_s": 0.151}, {"FTM1", "FTM4", "FTM5", "FTM7", "blind_pilot", "dead_man"}),
])
def test_what_comes_too_late_is_named(change, late):
    assert late == {budget.name for budget in check(with_timing(**change)) if not budget.fits}


def test_all_timeouts_are_guarded_against_false_alarms_and_the_death_of_a_router():
    for field, least in {"heartbeat_timeout_s": 0.42, "command_timeout_s": 0.15,
                         "localization_timeout_s": 0.15, "scan_timeout_s": 0.3,
                         "dead_man_timeout_s": 0.3,
                         "manager_timeout_s": 0.3, "detection_silence_timeout_s": 0.6}.items():
        assert not list(find_false_alarms(with_timing(**{field: least}).timing))
        alarm = next(find_false_alarms(with_timing(**{field: least - 0.01}).timing))
        assert (alarm.path, alarm.value) == (f"$.timing.{field}", (least - 0.01,))
