"""Commands as nodes in a system spec: every mistake is one line that names the node."""

import re

import pytest

from rampart import parse_specification
from rampart.actors.foreign.program import check_programs
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.manager.spec.specification import SpecificationError, check_change
from tests.tug import TUG, write_tug

COMMAND_NODE = "rampart.actors.foreign.command_node:CommandNode"


def refusal(text: str) -> str:
    with pytest.raises(SpecificationError) as refused:
        parse_specification(text, "tug.toml")
    line = str(refused.value)
    assert line.startswith("tug.toml: ")
    return line.removeprefix("tug.toml: ")


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
