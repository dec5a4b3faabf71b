"""The operator's page on an HMI in a real Chromium."""

from __future__ import annotations

from contextlib import asynccontextmanager

from tests.actors.operator.world import AIRPORT, SPEC, World, served

LIVE = "$('#link').textContent === 'live'"


async def show(tab, hmi, **look) -> None:
    """Show the page of an HMI."""
    await tab.show(f"http://{await served(hmi)}/", **look)
    await tab.until(LIVE)


@asynccontextmanager
async def page(world: World, tab, airport=AIRPORT, system=SPEC, **look):
    """Show the page of an HMI that knows the system and an airport."""
    async with world.hmi(system=system, airport=airport) as hmi:
        await show(tab, hmi, **look)
        await tab.until("$$('#tree .event').length > 0")
        yield hmi


def text(name: str) -> str:
    """Return an expression for the text of an element with an id."""
    return f"$('#{name}').textContent"


def events(kind: str) -> str:
    return (f"$$('#tree .event.{kind} .ftm').map((t) => t.textContent).join()")
