"""Fields of messages by name."""

from __future__ import annotations

import re
from typing import Annotated

import numpy as np
import pytest
from msgspec import Meta

from rampart import Actor, Message
from rampart.actors.bus.fields import Field
from rampart.actors.ftm.messages import DetectionReport, DetectionState
from rampart.testing import VirtualSystem
from tests.tank import LEVEL, TOPICS, Level, Phase, Pump
from tests.virtual_time import within


class Arm(Message):
    """Seven joints."""

    angles_rad: Annotated[tuple[float, ...], Meta(max_length=7)]


class Fixed(Message):
    """Three numbers and a text."""

    angles: tuple[float, float, float, str]


@pytest.mark.parametrize(("message", "path", "value", "kind"), [
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
    (Arm((0.5,) * 7), "angles_rad[-7]", 0.5, "number"),
    (Fixed((1.0, 2.0, 3.0, "x")), "angles[3]", "x", "text"),
])
def test_a_field_is_read(message, path, value, kind):
    field = Field(type(message), path)
    assert field(message) == value
    assert field.kind == kind


class Gauge(Actor):
    """What publishes a level."""

    outputs = (LEVEL,)


@pytest.mark.parametrize(("message", "where", "kind"), [
    (Level(np.float64(1.0)), "height_m", "numpy.float64"),
    (Level(1.0, (0.0, np.float32(1.0))), "cells[1]", "numpy.float32")])
@within(lambda: VirtualSystem(topics=TOPICS))
async def test_a_value_of_numpy_is_refused_by_topic_and_field(system, message, where, kind):
    with pytest.raises(
            TypeError, match=rf"^topic tank/level: \$\.{re.escape(where)}: .*{kind} "):
        system.start("gauge", Gauge).publish(LEVEL, message)


def test_an_item_that_a_list_lacks_is_named():
    field = Field(Level, "cells[7]")
    assert field.beyond(Level(1.5, (1.0, 2.0))) == "cells[7]: no item [7], the list has 2"
    assert field.beyond(Level(1.5, (1.0,) * 8)) == ""


@pytest.mark.parametrize(("kind", "path", "words"), [
    (Level, "hieght_m", "hieght_m: Level has no field 'hieght_m'; did you mean height_m?"),
    (Level, "cells", "cells: expected a number, a text or a truth value"),
    (Level, "height_m[0]", "height_m[0]: cannot take [0]: the value is not a list"),
    (Level, "height_m.x", "height_m.x: cannot take x: the value has no fields"),
    (Level, "", "expected the name of a field"),
    (Level, "cells[one]", "cells[one]: not a path of a field, such as pose.x_m or ranges_m[0]"),
    (Arm, "angles_rad[-8]", "angles_rad[-8]: [-8]: the list has at most 7 items, expected -7 to 6"),
    (Fixed, "angles[4]", "angles[4]: [4]: the list has at most 4 items, expected -4 to 3"),
])
def test_an_invalid_field_is_refused_in_one_line(kind, path, words):
    with pytest.raises(ValueError, match=r".") as caught:
        Field(kind, path)
    assert str(caught.value) == words
