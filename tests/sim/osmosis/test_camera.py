"""The picture of an airport's ground, for replays."""

from __future__ import annotations

import shapely

from rampart.actors.osmosis.airport.model import Airport, Building, StartPose, Surface
from rampart.sim.osmosis.camera import MARGIN_M, MAX_PIXELS, ground_image


def test_pavement_within_grass_and_grass_within_a_ring_are_drawn_as_what_they_are():
    ring, island = square(20).difference(square(10)), square(3)
    airport = Airport(
        "island", {}, (), ring.union(island), StartPose(15.0, 0.0, 0.0),
        (Surface("middle", "apron", island), Surface("ring", "taxiway", ring)),
        (Building("tower", 40.0, 0.0, 2.0, 2.0, 5.0), Building("hut", -40.0, 0.0, 2.0, 2.0, 5.0),
         Building("shed", 0.0, 40.0, 2.0, 2.0, 5.0), Building("barn", 0.0, -40.0, 2.0, 2.0, 5.0)))
    assert max(len(part.interiors) for part in
               shapely.get_parts(airport.prohibited_polygon(0.0))) == 1, "the ring is a hole in it"
    image = ground_image(airport)
    x0, _, _, y1 = airport.bounds_m
    colours = [image.getpixel((round((x - x0 + MARGIN_M) * 10), round((y1 + MARGIN_M) * 10)))
               for x in (0.0, 6.0, 15.0, 30.0)]
    assert [is_grey(colour) for colour in colours] == [True, False, True, False]


def test_a_large_airport_has_a_picture_of_its_ground_that_fits_into_a_texture():
    runway = shapely.box(0.0, 0.0, 4000.0, 45.0)
    image = ground_image(Airport("long", {}, (), runway, StartPose(5.0, 5.0, 0.0),
                                 (Surface("runway", "runway", runway),)))
    assert image.size[0] == MAX_PIXELS
    assert is_grey(image.getpixel((MAX_PIXELS // 2, image.size[1] // 2)))


def square(half_m: float) -> shapely.Polygon:
    return shapely.box(-half_m, -half_m, half_m, half_m)


def is_grey(colour: tuple[int, int, int]) -> bool:
    return max(colour) - min(colour) < 20
