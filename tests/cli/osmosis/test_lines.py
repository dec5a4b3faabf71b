"""What `rampart status` says of Osmosis."""

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.cli.osmosis.lines import OsmosisLines

WHEELS = (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("stopped", "brake", "words"), [
    (False, None, "driving"), (False, False, "driving"), (True, False, "STOPPED"),
    (False, True, "BRAKED"), (True, True, "BRAKED")])
def test_a_robot_that_is_braked_is_not_said_to_be_driving(stopped, brake, words):
    latest = {topics.PILOT_STATUS.key: m.PilotStatus(m.PilotMode.AUTO, stopped, "", 0)}
    if brake is not None:
        latest[topics.BASE_STATUS.key] = m.BaseStatus(brake, False, 0.0, WHEELS)
    lines = dict(OsmosisLines().status(lambda topic: latest.get(topic.key), {}, ()))
    assert lines["pilot"] == f"auto, {words}"
