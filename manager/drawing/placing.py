"""Gives the boxes of a layered graph their coordinates, and the lines between them theirs.

*Boxes.* Each layer keeps its sequence and its distances. Under that condition the boxes of a layer
are put as near as possible (least squares) to the middle of their neighbours, layer by layer,
downwards and upwards, and upwards once more, so that what is above stands centred over what is
below. With the distances subtracted this is isotonic regression, which pooling adjacent violators
solves exactly in one pass.

*Lines.* Straight from box to box, or square: down, across in a lane between the layers, down.
Lines of different origin never share a lane where they would touch, so that nobody takes them for
joined.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping, Sequence
from itertools import pairwise

import msgspec

from rampart.manager.drawing.layered import Layering, arrange_in_layers

SWEEPS = 24
GAP = 22.0
"""Between two boxes of a layer."""
BEND_GAP = 9.0
"""Between a bend and its neighbour."""
PORT = 10.0
"""Between two lines that end at one box."""
LANE = 9.0
"""Between two lanes of lines."""
SLANT = 4.0
"""A line that has to go no further across than this leans over instead."""
LAYER_GAP = 34.0
"""Between two layers, besides lanes."""

Point = tuple[float, float]


class Place(msgspec.Struct, frozen=True):
    """Where a box is: its corner at the upper left and its size; y grows downwards."""

    left: float
    top: float
    width: float
    height: float

    @property
    def x(self) -> float:
        """Of the centre line."""
        return self.left + self.width / 2

    @property
    def bottom(self) -> float:
        """The y of the lower edge."""
        return self.top + self.height


class Placing(msgspec.Struct, frozen=True):
    """Coordinates of a graph, from 0 to `width` and `height`.

    Attributes:
        places: Of each name.
        lines: For each edge, in the given sequence, the points of its line.
        width: Of all.
        height: Of all.
    """

    places: dict[str, Place]
    lines: tuple[tuple[Point, ...], ...]
    width: float
    height: float


def place(sizes: Mapping[str, tuple[float, float]], edges: Sequence[tuple[str, str]], *,
          square: bool) -> Placing:
    """Place boxes.

    Args:
        sizes: Width and height of each box.
        edges: (upper, lower), each once.
        square: Draw lines across and down, and let those that end at one box end side by side;
            else straight, all to the middle.
    """
    names = tuple(sizes)
    layering = arrange_in_layers(names, edges)
    total = sum(map(len, layering.layers))
    widths = [sizes[names[v]][0] if v < layering.count else 0.0 for v in range(total)]
    x = _columns(layering, widths)
    left = min((x[v] - widths[v] / 2 for v in range(total)), default=0.0)
    x = [value - left for value in x]
    ports = _ports(layering, x, widths) if square else {}
    ends = _ends(layering, x, ports) if square else {}
    lanes = [_lanes(layer, x, ends) for layer in layering.layers]
    tops: list[float] = []
    bottoms: list[float] = []
    y = 0.0
    for layer, lane in zip(layering.layers, lanes, strict=True):
        tops.append(y)
        bottoms.append(y + max((sizes[names[v]][1] for v in layer if v < layering.count),
                               default=0.0))
        y = bottoms[-1] + LAYER_GAP + LANE * max(lane.values(), default=0)
    depth = {v: index for index, layer in enumerate(layering.layers) for v in layer}
    places = {name: Place(x[v] - widths[v] / 2, tops[depth[v]], *sizes[name])
              for v, name in enumerate(names)}
    lines: list[tuple[Point, ...]] = []
    for number, chain in enumerate(layering.chains):
        points = [(x[chain[0]], places[names[chain[0]]].bottom)]
        for upper, lower in pairwise(chain):
            end = ports.get((number, lower), x[lower])
            if square and end != points[-1][0]:
                across = bottoms[depth[lower] - 1] + LAYER_GAP / 2 \
                    + LANE * lanes[depth[lower] - 1].get(upper, 0)
                points.append((points[-1][0], across))
                if abs(end - points[-1][0]) > SLANT:
                    points.append((end, across))
            points.append((end, tops[depth[lower]]))
            if lower >= layering.count:
                points.append((end, bottoms[depth[lower]]))
        lines.append(tuple(points))
    return Placing(places, tuple(lines),
                   max((p.left + p.width for p in places.values()), default=0.0),
                   bottoms[-1] if bottoms else 0.0)


def _columns(layering: Layering, widths: Sequence[float]) -> list[float]:
    """Return the x of each vertex's centre."""
    uppers, lowers = layering.links()
    x = [0.0] * len(widths)
    offsets = []
    for layer in layering.layers:
        at, offset = 0.0, []
        for before, vertex in zip((None, *layer), layer, strict=False):
            if before is not None:
                bend = max(before, vertex) >= layering.count
                at += (widths[before] + widths[vertex]) / 2 + (BEND_GAP if bend else GAP)
            offset.append(at)
            x[vertex] = at
        offsets.append(offset)
        middle = at / 2
        for vertex in layer:
            x[vertex] -= middle
    layers = list(zip(layering.layers, offsets, strict=True))
    for sweep in range(SWEEPS + 1):
        down = sweep % 2 == 1
        neighbours = uppers if down else lowers
        for layer, offset in layers if down else layers[::-1]:
            wanted = [_middle([x[v] for v in neighbours[vertex]]) if neighbours[vertex]
                      else x[vertex] for vertex in layer]
            # A bend weighs more than a box: a long line should be straight.
            weights = [6.0 if vertex >= layering.count else 1.0 if neighbours[vertex] else 0.1
                       for vertex in layer]
            fitted = _isotonic([w - o for w, o in zip(wanted, offset, strict=True)], weights)
            for vertex, value, o in zip(layer, fitted, offset, strict=True):
                x[vertex] = round(value + o, 2)
    return x


def _middle(values: Sequence[float]) -> float:
    """Return the middle of some values, or the one next to it if that makes a line straight."""
    middle = (min(values) + max(values)) / 2
    nearest = min(values, key=lambda value: abs(value - middle))
    return nearest if abs(nearest - middle) <= SLANT else middle


def _isotonic(wanted: Sequence[float], weights: Sequence[float]) -> list[float]:
    """Return the non-decreasing values nearest to the wanted ones (weighted least squares)."""
    pools: list[tuple[float, float, int]] = []  # mean, weight, how many
    for value, weight in zip(wanted, weights, strict=True):
        pool = (value, weight, 1)
        while pools and pools[-1][0] > pool[0]:
            mean, heavy, count = pools.pop()
            total = heavy + pool[1]
            pool = ((mean * heavy + pool[0] * pool[1]) / total, total, count + pool[2])
        pools.append(pool)
    return [mean for mean, _, count in pools for _ in range(count)]


def _ports(layering: Layering, x: Sequence[float],
           widths: Sequence[float]) -> dict[tuple[int, int], float]:
    """Return the x at which each edge (its number, its lower end) arrives, where several do."""
    arriving: dict[int, list[int]] = {}
    for number, chain in enumerate(layering.chains):
        arriving.setdefault(chain[-1], []).append(number)
    ports = {}
    for lower, numbers in arriving.items():
        if len(numbers) > 1:
            numbers.sort(key=lambda n: (x[layering.chains[n][-2]], n))
            step = min(PORT, 0.8 * widths[lower] / (len(numbers) - 1))
            for index, number in enumerate(numbers):
                ports[number, lower] = round(
                    x[lower] + (index - (len(numbers) - 1) / 2) * step, 2)
    return ports


def _ends(layering: Layering, x: Sequence[float],
          ports: Mapping[tuple[int, int], float]) -> dict[int, list[float]]:
    """Return, for each vertex, the x at which its lines arrive further down."""
    ends: dict[int, list[float]] = {}
    for number, chain in enumerate(layering.chains):
        for upper, lower in pairwise(chain):
            ends.setdefault(upper, []).append(ports.get((number, lower), x[lower]))
    return ends


def _lanes(layer: Sequence[int], x: Sequence[float],
           ends: Mapping[int, Sequence[float]]) -> dict[int, int]:
    """Return the lane, counted downwards from 0, in which the lines of each vertex go across."""
    spans = {upper: (min(*ends[upper], x[upper]), max(*ends[upper], x[upper]))
             for upper in layer if upper in ends and any(e != x[upper] for e in ends[upper])}
    # A line that comes down on another's origin must go across below it.
    origin = {x[upper]: upper for upper in spans}
    above = {upper: {origin[end] for end in ends[upper] if end in origin} - {upper}
             for upper in spans}
    lanes: dict[int, int] = {}
    taken: list[list[tuple[float, float]]] = []
    waiting = sorted(spans, key=lambda v: (spans[v], v), reverse=True)
    asked: set[int] = set()
    while waiting:
        upper = waiting[-1]
        first = [v for v in sorted(above[upper]) if v not in lanes and v not in asked]
        if first and upper not in asked:
            asked.add(upper)  # once only: two that come down on each other cannot both be right
            waiting += first
            continue
        waiting.pop()
        if upper not in lanes:
            lane = max((lanes[v] + 1 for v in above[upper] if v in lanes), default=0)
            while lane < len(taken) and not _is_free(taken[lane], spans[upper]):
                lane += 1
            taken += [[] for _ in range(lane + 1 - len(taken))]
            taken[lane].insert(bisect(taken[lane], spans[upper]), spans[upper])
            lanes[upper] = lane
    return lanes


def _is_free(taken: Sequence[tuple[float, float]], span: tuple[float, float]) -> bool:
    """Tell whether a span touches none of a lane's, which are sorted and apart."""
    at = bisect(taken, span)
    return ((at == 0 or taken[at - 1][1] + LANE <= span[0])
            and (at == len(taken) or span[1] + LANE <= taken[at][0]))
