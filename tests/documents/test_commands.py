"""docs/reference/commands.md is made from the parsers, which describe every option."""

import re

from rampart.cli.commands_page import markdown
from tests import ROOT

DOCUMENT = ROOT / "docs/reference/commands.md"


def test_the_page_is_up_to_date(monkeypatch):
    monkeypatch.delenv("RAMPART_PORT", raising=False)
    assert DOCUMENT.read_text(encoding="utf-8") == f"{markdown().rstrip()}\n", (
        "write it: python -m rampart.cli.commands_page > docs/reference/commands.md")


def test_every_option_has_a_meaning_and_old_names_are_left_out():
    text = markdown()
    assert not re.findall(r"^\| `.*` \|\s*\|$", text, re.MULTILINE)
    headings = set(re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    assert {"rampart run", "rampart node list", "rampart campaign", "rampart mission"} <= headings
    assert not {"rampart table", "rampart trigger", "rampart metrics"} & headings
