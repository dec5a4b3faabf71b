"""Commands as nodes in a system spec: every mistake is one line that names the node."""

from __future__ import annotations

import pytest

from rampart.actors.foreign.program import check_programs
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.manager.spec.specification import (
    SpecificationError,
    check_change,
    parse_specification,
)
from tests.documents.test_foreign_nodes import TUG, write_tug

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
    (COMMAND, f'{COMMAND}\nactor = "cart:VirtualWheels"', "wheels: command = ['./wheels']: either "
     "actor or command is right; it has actor = 'cart:VirtualWheels'"),
    (COMMAND, "", "wheels: heartbeat = {'timeout_s': 0.5, 'key': '', 'notify': True, 'topic': ''}: "
     "of use with a command only, and the node has none"),
    ('actor = "cart:Driver"', "", "driver: actor: missing; say actor = 'module:Class' or command = "
     "['./program', ...]"),
    ('actor = "cart:Driver"', 'actor = "cart:Driver"\nfolder = "x"', "driver: folder = 'x': of use "
     "with a command only, and the node has none"),
    (COMMAND, "command = ['']", "wheels: command = ['']: the first is the program, and it has no "
     "name"),
    (COMMAND, 'command = ["./wheels", "\\u0000"]', r"wheels: command = ['./wheels', '\x00']: no "
     "text of it or its env or folder may have a character 0"),
    (COMMAND, f'{COMMAND}\nenv = {{ RAMPART_NODE = "x" }}', "wheels: env.RAMPART_NODE = 'x': no "
     "variable that can be set here; RAMPART_*, NOTIFY_SOCKET and WATCHDOG_* are set for it"),
    (COMMAND, f'{COMMAND}\nenv = {{ "A=B" = "x" }}', "wheels: env.A=B = 'x': no variable that can "
     "be set here; RAMPART_*, NOTIFY_SOCKET and WATCHDOG_* are set for it"),
    (BEAT, "heartbeat = { timeout_s = 0.5 }", "wheels: heartbeat = {'timeout_s': 0.5, 'key': '', "
     "'notify': False, 'topic': ''}: one of key = '...', notify = true, topic = '...' is right"),
    (BEAT, 'heartbeat = { key = "a", topic = "tug/wheels", timeout_s = 0.5 }', "wheels: heartbeat "
     "= {'timeout_s': 0.5, 'key': 'a', 'notify': False, 'topic': 'tug/wheels'}: one of key = "
     "'...', notify = true, topic = '...' is right"),
    (BEAT, 'heartbeat = { topic = "tug/command", timeout_s = 0.5 }', "wheels: heartbeat.topic = "
     "'tug/command': not one of the topics that it publishes; these are: tug/wheels"),
    (BEAT, 'heartbeat = { key = "a/**", timeout_s = 0.5 }', "wheels: heartbeat.key = 'a/**': "
     "expected a Zenoh key such as 'est/alive'"),
    ('hears = ["tug/command"]', 'hears = ["tug/command", "tug/command"]',
     "wheels: hears = 'tug/command': listed twice"),
    ('hears = ["tug/command"]', 'hears = ["detection/{name}"]',
     "wheels: hears = 'detection/{name}': name one member of the family"),
    ('stand_in = "cart:VirtualWheels"', "parameters = { radius_m = 0.1 }", "wheels: parameters: a "
     "command takes none; they are for the actor that stand_in names"),
    (f'{COMMAND}\nkind = "control"', f'{COMMAND}\nkind = "manager"', "wheels: command = "
     "['./wheels']: the manager has to be an actor"),
    (BEAT, f"{BEAT}\nlimits = {{ memory = 1 }}", "node wheels: limits.memory = 1: unknown field; "
     "known: memory_mb, processor_s, open_files, file_mb"),
    (BEAT, f"{BEAT}\nlimits = {{ open_files = 1 }}", "node wheels: limits.open_files = 1: expected "
     "a whole number, 8 or more, at most 1000000"),
    (BEAT, "heartbeat = { notify = true, timeout_s = 0 }", "node wheels: heartbeat.timeout_s = 0: "
     "expected a number > 0"),
    ("cart:VirtualWheels", "cart.VirtualWheels", "node wheels: stand_in = 'cart.VirtualWheels': "
     "expected "
     "'module:Class', e.g. 'rampart.actors.operator.hmi:Hmi'"),
]


@pytest.mark.parametrize(("old", "new", "line"), WRONG, ids=[new[:40] for _, new, _ in WRONG])
def test_a_mistake_is_one_line(old, new, line):
    assert TUG.count(old) == 1
    assert refusal(TUG.replace(old, new)) == line


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
    ("cart:VirtualWheels", "cart:Nobody", "node wheels: stand_in = 'cart:Nobody': no such actor "
     "class; known: Driver, VirtualWheels"),
    ("cart:Driver", COMMAND_NODE, f"node driver: actor = '{COMMAND_NODE}': say command = "
     "['./program', ...] instead"),
    ("stand_in", "parameters = { radius_m = 1 }\nstand_in", "node wheels: parameters.radius_m = 1: "
     "unknown field; known: none")])
def test_a_stand_in_is_held_to_what_the_file_says_of_it_in_real_runs_too(tug, old, new, line):
    plan = tug(old, new)
    with pytest.raises(ValueError, match="node") as refused:
        Layout(plan, load_system(plan))
    assert str(refused.value) == f"{plan.system_file}: {line}"


def test_what_only_the_stand_in_declares_is_a_topic(tug):
    plan = tug("cart:Driver", "rampart.actors.runtime.stub_node:StubNode")
    with pytest.raises(ValueError, match="hears 'tug/command', which nothing publishes"):
        Layout(plan, load_system(plan))


@pytest.mark.parametrize(("old", "new", "line"), [
    ("./wheels", "./none", "wheels: command = ['./none']: no such file: {folder}/none"),
    ("./wheels", "./cart.py", "wheels: command = ['./cart.py']: {folder}/cart.py is not "
     "executable; chmod +x makes it so"),
    ("./wheels", "no-such-program", "wheels: command = ['no-such-program']: no program "
     "'no-such-program' in PATH; one in the folder is './no-such-program'"),
    (COMMAND, f'{COMMAND}\nfolder = "none"', "wheels: folder = 'none': no such folder: "
     "{folder}/none")])
def test_a_program_that_cannot_be_run_is_one_line(tug, tmp_path, old, new, line):
    plan = tug(old, new)
    with pytest.raises(SpecificationError) as refused:
        check_programs(plan, load_system(plan))
    assert str(refused.value) == f"{plan.system_file}: " + line.format(folder=tmp_path)


def test_a_program_is_found_in_its_folder_and_in_path(tug, tmp_path):
    for old, new in (("", ""), ("./wheels", "sh"), ("./wheels", "/bin/sh")):
        plan = tug(old, new)
        check_programs(plan, load_system(plan))
    (tmp_path / "bin").mkdir()
    (tmp_path / "wheels").rename(tmp_path / "bin" / "wheels")
    plan = tug(COMMAND, f'{COMMAND}\nfolder = "bin"')
    check_programs(plan, load_system(plan))
    plan = tug(COMMAND, f'command = ["wheels"]\nenv = {{ PATH = "{tmp_path}/bin" }}')
    check_programs(plan, load_system(plan))


def test_in_virtual_time_a_command_without_stand_in_is_refused(tug):
    plan = tug('stand_in = "cart:VirtualWheels"', "", virtual=True)
    with pytest.raises(SpecificationError) as refused:
        load_system(plan)
    assert str(refused.value) == (
        f"{plan.system_file}: wheels: command = ['./wheels']: there are no processes in virtual "
        "time; name with stand_in = 'module:Class' the actor that plays it there")


def test_in_virtual_time_the_stand_in_is_the_node(tug):
    plan = tug(virtual=True)
    member = Layout(plan, load_system(plan)).members["wheels"]
    assert member.actor.__name__ == "VirtualWheels"


def test_a_topic_that_nobody_declares_is_one_line(tug):
    plan = tug('hears = ["tug/command"]', 'hears = ["tug/comand"]')
    with pytest.raises(ValueError, match="no actor has a topic") as refused:
        Layout(plan, load_system(plan))
    assert str(refused.value) == (f"{plan.system_file}: wheels: hears: no actor has a topic "
                                  "'tug/comand'; the nearest: tug/command")


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
