"""A lane along x, 5 m wide, for modules that guard its edge."""

from shapely.geometry import box

from rampart.actors.osmosis.airport.model import Airport, StartPose

LANE = Airport("lane", {"a": (0.0, 0.0), "b": (40.0, 0.0)}, (("a", "b"),),
               box(-5.0, -2.5, 45.0, 2.5), StartPose(0.0, 0.0, 0.0))
