"""The specification: what is proved of it, and what is refused."""

import pytest
from flights import SYSTEM

from rampart import SpecificationError, parse_specification, verify

TEXT = SYSTEM.read_text(encoding="utf-8")


def test_every_property_of_the_arbitration_holds():
    spec = parse_specification(TEXT, SYSTEM.name)
    assert [p.name for p in verify(spec, ["guarded-repair"]).properties if not p.holds] == []


@pytest.mark.parametrize(("right", "wrong"), [
    ('recover = "R_HOVER"', 'recover = "R_STAND"'),
    ('R_LAND = ["R_RETURN"]', 'R_LAND = ["R_RETURN", "R_LEVEL"]'),
    ("dead_man_timeout_s = 0.4", "dead_man_timeout_s = -1.0"),
    ("respawn_s = 0.12", "respawn_s = 0.4")])
def test_what_does_not_fit_together_is_refused(right, wrong):
    assert right in TEXT
    with pytest.raises(SpecificationError):
        parse_specification(TEXT.replace(right, wrong), SYSTEM.name)
