"""`topics.md` says what the code says."""

from __future__ import annotations

from pathlib import Path

from actors import topics
from toolbox import systems
from toolbox.topic_catalogue import markdown, uses

DOCUMENT = Path(__file__).resolve().parents[1] / "topics.md"


def test_topics_md_is_up_to_date():
    expected = markdown(systems.load(None))
    assert DOCUMENT.read_text(encoding="utf-8") == expected, (
        "topics.md is out of date; write it again: rampart topic list --markdown > topics.md")


def test_every_topic_that_a_node_reads_is_published_by_somebody():
    lonely = [use.topic.key for use in uses(systems.load(None))
              if use.readers and use.publishers == ("tools",)]
    assert lonely == [topics.OBSTACLE.key]


def test_ground_truth_is_read_by_no_node_of_the_controller():
    truth = next(u for u in uses(systems.load(None)) if u.topic is topics.TRUTH)
    assert truth.readers == ("observer",)
