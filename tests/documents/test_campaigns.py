"""docs/how-to/campaigns.md: its commands are accepted, its faults are those of the default system.

The commands take minutes to hours, so only one is executed; tests of runs and campaigns execute
the others on less. `make campaign` is one of them.
"""

import re
import shlex

import pytest

from rampart.cli import run_options, systems
from rampart.cli.analyse import campaign_verb
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.faults import PROCESS_FAULTS
from rampart.sim.faults.topic_faults import NONSENSE
from tests.documents.page import Page

PAGE = Page("how-to/campaigns")
FAULTS = dict(re.findall(r"^\| (`.*?) \| .* \| (\w+) \|$",
                         PAGE.section("## Choose faults"), re.MULTILINE))


@pytest.mark.parametrize("line", PAGE.commands)
def test_a_command_is_accepted(line):
    rampart, verb, *arguments = shlex.split(line)
    assert rampart == "rampart"
    parse = {"run": lambda: run_options.parse(arguments, "rampart run"),
             "campaign": lambda: campaign_verb.parse(arguments)}[verb]
    assert parse()


def test_the_table_has_every_kind_of_fault_and_every_mode():
    groups = fault_groups(systems.load(None))
    assert set(FAULTS.values()) == groups.keys() - {"none", "several"}
    modes = {mode for names in FAULTS for mode in re.findall(r"`(\w+):", names)}
    assert modes == {name.partition(":")[0] for kind in ("topic", "reading", "process")
                     for name in groups[kind]} | set(NONSENSE) | set(PROCESS_FAULTS)
