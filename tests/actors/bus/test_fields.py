"""Fields of messages by name."""

from __future__ import annotations

import pytest

from rampart.actors.bus.fields import Field
from rampart.actors.ftm.messages import DetectionReport, DetectionState
from tests.tank import Level, Phase, Pump


@pytest.mark.parametrize(("message", "path", "value", "kind"), [
    (Level(1.5), "height_m", 1.5, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[1]", 1.0, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[-1]", 2.0, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[min]", 1.0, "number"),
    (Level(1.5, (3.0, 1.0, 2.0)), "cells[max]", 3.0, "number"),
    (Level(1.5), "cells[len]", 0, "number"),
    (Level(1.5), "cells[min]", None, "number"),
    (Level(1.5), "cells[7]", None, "number"),
    (Pump(Phase.FILLING), "phase", "filling", "text"),
    (Pump(Phase.IDLE, running=False), "running", False, "truth"),
    (DetectionReport(DetectionState.ACTIVE, "why", ("a", "b"), 1.0), "nodes[0]", "a", "text"),
])
def test_a_field_is_read(message, path, value, kind):
    field = Field(type(message), path)
    assert field(message) == value
    assert field.kind == kind


@pytest.mark.parametrize(("kind", "path", "words"), [
    (Level, "hieght_m", "hieght_m: Level has no field 'hieght_m'; did you mean height_m?"),
    (Level, "zzz", "zzz: Level has no field 'zzz'; known: height_m, cells, heading_rad"),
    (Level, "cells", "cells: not a number, a text or a truth value"),
    (Level, "height_m[0]", "height_m[0]: [0] of what is no list"),
    (Level, "height_m.x", "height_m.x: x of what has no fields"),
    (Level, "", "a field has to be named"),
    (Level, ".height_m", ".height_m: no path of a field, e.g. pose.x_m or ranges_m[0]"),
    (Level, "cells[one]", "cells[one]: no path of a field, e.g. pose.x_m or ranges_m[0]"),
])
def test_what_is_no_field_is_refused_in_one_line(kind, path, words):
    with pytest.raises(ValueError, match=r".") as caught:
        Field(kind, path)
    assert str(caught.value) == words
