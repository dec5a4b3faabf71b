"""docs/reference/commands.md and topics.md are made from the code, which describes everything."""

import dataclasses
import re

import pytest

from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.system.layout import published_keys
from rampart.actors.system.topics import own_topics, system_topics
from rampart.cli import commands_page, systems
from rampart.cli.look.topic_verbs import markdown, uses
from tests import CELL, ROOT, porter_actors
from tests.porter_actors import AXLE, LOAD, write_porter_system

COMMANDS = ROOT / "docs/reference/commands.md"


def test_the_page_is_up_to_date(monkeypatch):
    monkeypatch.delenv("RAMPART_PORT", raising=False)
    assert COMMANDS.read_text(encoding="utf-8") == f"{commands_page.markdown().rstrip()}\n", (
        "write it: python -m rampart.cli.commands_page > docs/reference/commands.md")


def test_every_option_has_a_meaning_every_verb_an_example_and_old_names_are_left_out():
    text = commands_page.markdown()
    for name, _, said in (part.partition("\n")
                          for part in re.split(r"^#{3,} ", text, flags=re.MULTILINE)[1:-1]):
        assert " ".join(name.split()[:2]) in said.partition("examples:")[2], name
        assert not said.lstrip().startswith(("|", "```text\nexamples:")), f"describe {name}"
    assert not re.findall(r"^\| `.*` \|\s*\|$", text, re.MULTILINE)
    headings = set(re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    assert {"rampart run", "rampart node list", "rampart campaign", "rampart mission"} <= headings
    assert not {"rampart table", "rampart trigger", "rampart metrics"} & headings


TOPICS = ROOT / "topics.md"


def test_topics_md_is_up_to_date():
    expected = markdown(systems.load(None))
    assert TOPICS.read_text(encoding="utf-8") == expected, (
        "topics.md is out of date; write it: rampart topic list osmosis --markdown > topics.md")


def test_every_topic_that_a_node_reads_is_published_by_somebody():
    lonely = [use.topic.key for use in uses(systems.load(None))
              if use.readers and use.publishers == ("tools",)]
    ends = ftm_topics.PROGRAM_END.key  # of commands, of which this system has none
    assert sorted(lonely) == sorted([topics.WAY_OUT.key, topics.OBSTACLE.key, ends])
    truth = next(use for use in uses(systems.load(None)) if use.topic is topics.TRUTH)
    assert truth.readers == ("observer",), "no node of the controller reads the ground truth"


def test_the_topics_of_a_robot_s_own_actors_follow_the_common_ones(tmp_path):
    spec = systems.load(str(write_porter_system(tmp_path)))
    assert system_topics(systems.load(str(CELL))) == ftm_topics.ALL
    assert own_topics(spec) == system_topics(spec)[-2:] == (LOAD, AXLE)
    assert set(topics.ALL) <= set(system_topics(spec))
    assert set(published_keys(spec)) >= {"porter/load", "porter/axle/front", "porter/axle/rear"}


@pytest.mark.parametrize(("changes", "words"), [
    ({"type": dict}, "topic 'porter/load': type = <class 'dict'>: must be derived from "),
    ({"key": "a/{name}/{name}"}, "topic 'a/{name}/{name}': expected at most one {name}"),
])
def test_a_topic_that_makes_no_sense_is_refused_by_actor_and_key(tmp_path, monkeypatch, changes,
                                                                 words):
    spec = systems.load(str(write_porter_system(tmp_path)))
    monkeypatch.setattr(porter_actors.Platform, "outputs", (dataclasses.replace(LOAD, **changes),))
    with pytest.raises(ValueError, match=r"^actor = 'tests.porter_actors:Platform': ") as caught:
        system_topics(spec)
    assert words in str(caught.value)
