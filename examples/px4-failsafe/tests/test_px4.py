"""The replay of PX4's failsafe tests: each decision, and what would be found if it were wrong."""

from pathlib import Path

import pytest
from px4.replay import STEPS

from rampart import parse_specification, verify
from rampart.testing import virtual_run

HERE = Path(__file__).parent.parent
TEXT = (HERE / "failsafe.toml").read_text(encoding="utf-8")


def test_each_step_ends_with_the_action_that_px4_expects_or_the_reason_is_written_down():
    done = virtual_run(HERE / "failsafe.toml")
    assert done.judgement.reasons == ()
    assert done.judgement.success
    assert done.judgement.safe
    others = [step for step in STEPS if step.rampart]
    assert len(others) == 2
    assert all(step.why for step in others)


@pytest.mark.parametrize(("right", "wrong"), [
    ('R_DESCEND = ["R_LAND"]\nR_LAND = ["R_RETURN_KEPT"]',
     'R_RETURN_KEPT = ["R_DESCEND"]\nR_DESCEND = ["R_LAND"]'),
    ('title = "Return, until the mode is changed"\n', 'title = "Return"\nenabled = false\n')])
def test_a_wrong_specification_is_judged_so(tmp_path, right, wrong):
    assert right in TEXT
    text = TEXT.replace(right, wrong)
    if "R_DESCEND" in right:
        text = text.replace('R_RETURN_KEPT = ["R_RETURN"]', 'R_LAND = ["R_RETURN"]')
    (tmp_path / "failsafe.toml").write_text(text)
    done = virtual_run(tmp_path / "failsafe.toml")
    assert not done.judgement.success


def test_every_property_of_the_arbitration_holds():
    found = verify(parse_specification(TEXT, "failsafe.toml"), ["guarded-repair"])
    assert len(found.properties) == 12
    assert all(found_one.holds for found_one in found.properties)
