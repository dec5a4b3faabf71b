"""Several declared sticks in a real Chromium."""

from __future__ import annotations

import pytest

from rampart.actors.operator.panels import Panel
from rampart.testing import eventually
from tests.actors.operator.page import show
from tests.actors.operator.test_page_operating import key
from tests.actors.operator.test_stick_panel import AT_REST, DRIVE, driven, rests
from tests.tank import Hand

pytestmark = [pytest.mark.page, pytest.mark.usefixtures("patient")]

LIFT = Panel(title="Lift", stick=("tank/level:height_m",), scale=(3.0,))


def of(panel: str, part: str) -> str:
    return f"$('[data-name=\"{panel}\"] {part}')"


def state(panel: str = "Drive") -> str:
    return f"{of(panel, '.stick-state')}.textContent"


async def test_of_two_sticks_each_has_its_keys_and_the_gamepad_is_the_first_one_s(world, tab):
    async with driven(world, DRIVE, LIFT) as (robot, hmi, _):
        await show(tab, hmi)
        await tab.until(f"{state()} === 'free'")
        await tab.value(f"{of('Lift', '.stick')}.focus()")
        await key(tab, "a", down=True)
        await rests(robot)
        assert await tab.value(state("Lift")) == "free"  # it has no such direction
        await key(tab, "w", down=True)
        await tab.until(f"{state('Lift')} === 'you drive'")
        assert robot.hands == [AT_REST]
        await key(tab, "w", down=False)
        await tab.value(
            "navigator.getGamepads = () => [{connected: true, axes: [0, -1], buttons:"
            " Array.from({length: 8}, (_, i) => ({pressed: window.held && i === 4}))}];"
            "dispatchEvent(new Event('gamepadconnected')); window.held = true")
        await eventually(lambda: robot.hands[-1] == Hand(0.25, 0.0, True))
        assert await tab.value(state("Lift")) == "free"
        await tab.value("window.held = false")
        await rests(robot)
