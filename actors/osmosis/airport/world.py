"""The truth about an airport's lights, which only the simulator reads.

Controllers see nominal values (`Airport.lights`); what a light really gives is in the section
`[world]` of the same file and never reaches them.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from rampart.actors.osmosis.airport.model import Airport


class WorldTruth(msgspec.Struct, frozen=True):
    """Real intensity of each light as a share of its nominal one; lights not named have 1."""

    light_factors: Mapping[str, float] = {}

    def intensity_cd(self, airport: Airport) -> dict[str, float]:
        """Return the real intensity of every light by name, cd."""
        return {light.name: light.nominal_cd * self.light_factors.get(light.name, 1.0)
                for light in airport.lights}
