"""The how-to pages for operators: their commands are accepted, their files agree with the code.

The commands of campaigns take minutes to hours; tests of runs and campaigns execute them on less.

Commands that need no run are executed. The others need a run, a second terminal, another machine or
a device; of these the options are parsed. Tests of each verb execute them on real runs.
"""

from __future__ import annotations

import re
import shlex

import pytest

from rampart.cli import run_options, systems
from rampart.cli.analyse import campaign_verb
from rampart.cli.main import build_parser, main
from rampart.cli.operate import kill_node
from rampart.cli.run import main as run_main
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.faults import PROCESS_FAULTS
from rampart.sim.faults.topic_faults import NONSENSE
from tests import system_file, two_hosts
from tests.documents.page import Page

HOW_TO = {name: Page(f"how-to/{name}") for name in (
    "operator-page", "terminal", "recordings", "several-machines", "credentials",
    "troubleshooting", "zero-velocity", "campaigns")}
COMMANDS = [(name, line) for name, page in HOW_TO.items() for line in page.commands]
ELSEWHERE = {"pip": "needs an index", "scp": "needs another machine",
             "make": "compiles what tests/stop compiles"}
ALONE = re.compile(r"rampart (keys|tokens|bag|doctor|service)\b")
"""Commands that need no run."""

PARSERS = {"run": lambda told: run_options.parse(told, "rampart run"),
           "campaign": campaign_verb.parse}
FAULTS = dict(re.findall(r"^\| (`.*?) \| .* \| (\w+) \|$",
                         HOW_TO["campaigns"].section("## Choose faults"), re.MULTILINE))


def words(line: str) -> list[str]:
    """Return a command without the variables in front of it."""
    return shlex.split(re.sub(r"^\w+=(\$\(.*?\)|\S*) ", "", line))


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_a_command_is_accepted(page, line):
    program, *arguments = words(line)
    if program == "kill-node":
        kill_node.build_parser().parse_args(arguments)
    elif page == "campaigns":
        assert program == "rampart"
        PARSERS[arguments.pop(0)](arguments)
    elif program == "rampart":
        build_parser().parse_args(arguments)
    elif program == "python":
        assert arguments.pop(0) == "launch.py"
        found = [word for word in arguments if word not in ("--system", "my.toml")]
        run_options.parse(found, "launch.py")
    else:
        assert program in ELSEWHERE, page


def follow(capsys, *pages: str) -> str:
    """Execute the commands of pages that need no run, in order, and return what they print."""
    told = []
    for page, line in COMMANDS:
        if page in pages and ALONE.match(line):
            code = main(words(line)[1:])
            out, err = capsys.readouterr()
            assert code == 0, f"{line}\n{out}{err}"
            told.append(out)
    return "".join(told)


def test_credentials_are_made_shared_renewed_and_revoked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.toml").write_text(two_hosts.two_hosts(
        {"robot": "192.168.7.1", "ground": "192.168.7.2"}))
    told = follow(capsys, "credentials")
    assert "keys for host ground" in told
    assert not (tmp_path / "keys" / "ada.pem").exists()
    assert (tmp_path / "robot-keys" / "DM5.pem").exists()  # it takes over from the ground station
    assert not (tmp_path / "ground-keys" / "safety_pilot.pem").exists()
    assert not (tmp_path / "robot-keys" / "authority.key").exists()


def test_tokens_are_issued_and_revoked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    follow(capsys, "operator-page")
    assert "anna" not in (tmp_path / "page.tokens").read_text(encoding="utf-8")


def test_a_recording_is_made_repaired_and_written_as_tables(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_main(["--system", str(system_file("cell")), "--virtual", "--duration", "3",
                     "--record", "run.mcap", "--report", "report"], "launch.py") == 0
    (tmp_path / "torn.mcap").write_bytes((tmp_path / "run.mcap").read_bytes())
    capsys.readouterr()
    assert "left behind: nothing" in follow(capsys, "recordings")
    assert list(tmp_path.glob("*/*.csv"))


def test_the_table_has_every_kind_of_fault_and_every_mode():
    groups = fault_groups(systems.load(None))
    assert set(FAULTS.values()) == groups.keys() - {"none", "several"}
    modes = {mode for names in FAULTS for mode in re.findall(r"`(\w+):", names)}
    assert modes == {name.partition(":")[0] for kind in ("topic", "reading", "process")
                     for name in groups[kind]} | set(NONSENSE) | set(PROCESS_FAULTS)
