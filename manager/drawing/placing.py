"""Places the boxes of a graph, and the lines between them.

The layout is a tidy tree (Reingold and Tilford 1981). A box is one layer below its lowest parent.
Subtrees are side by side in declared sequence, as close as their outlines allow, and a parent is
centred above its children. So no lines of a tree cross or touch.

A box with several parents is centred below the nearest box that all paths to it pass; the lines to
it slant. A line that passes layers gets its own place in each, so that it crosses no box. The same
graph always gives the same picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from graphlib import TopologicalSorter
from itertools import accumulate
from math import inf

import msgspec

GAP = 22.0
"""Distance between two boxes of a layer."""
LAYER_GAP = 34.0
"""Distance between two layers."""
TOP = ""
"""Root of all boxes, which is not drawn."""

Point = tuple[float, float]


class Place(msgspec.Struct, frozen=True):
    """Upper left corner and size of a box; y grows downwards."""

    left: float
    top: float
    width: float
    height: float

    @property
    def x(self) -> float:
        """The x of the centre line."""
        return self.left + self.width / 2

    @property
    def bottom(self) -> float:
        """The y of the lower edge."""
        return self.top + self.height


class Placing(msgspec.Struct, frozen=True):
    """Coordinates of a graph, from 0 to `width` and `height`.

    `places` has each box by its name, `lines` the points of the line of each edge.
    """

    places: dict[str, Place]
    lines: tuple[tuple[Point, ...], ...]
    width: float
    height: float


class _Block:
    """Boxes (by name) and passing lines (by the number of their edge), placed side by side."""

    def __init__(self, member: str | int, width: float, layers: Sequence[int]) -> None:
        self.x = {member: 0.0}
        self.left = dict.fromkeys(layers, -width / 2)
        self.right = dict.fromkeys(layers, width / 2)

    def take(self, other: _Block, wanted: float = -inf) -> None:
        """Add another block, moved right by `wanted` or as much more as it needs."""
        shift = max(wanted, *(self.right[layer] + GAP - left for layer, left in other.left.items()
                              if layer in self.right), -inf)
        self.x |= {member: x + shift for member, x in other.x.items()}
        for layer, left in other.left.items():
            self.left.setdefault(layer, left + shift)
            self.right[layer] = other.right[layer] + shift


def place(sizes: Mapping[str, tuple[float, float]], edges: Sequence[tuple[str, str]], *,
          square: bool) -> Placing:
    """Place boxes.

    Args:
        sizes: Width and height of each box.
        edges: (upper, lower), each once; their sequence is that of the boxes of a layer.
        square: Draw the lines of a tree rectangular, else straight.

    Raises:
        graphlib.CycleError: The graph is not acyclic.
    """
    uppers: dict[str, list[str]] = {name: [] for name in sizes}
    for upper, lower in edges:
        uppers[lower].append(upper)
    layer, block = _arrange(sizes, edges, uppers)
    left = min(block.left.values())
    x = {member: round(x - left, 2) for member, x in block.x.items()}
    tall = [0.0] * (1 + max(layer.values()))
    for name, (_, height) in sizes.items():
        tall[layer[name]] = max(tall[layer[name]], height)
    tops = list(accumulate(tall, lambda top, height: top + height + LAYER_GAP, initial=0.0))
    places = {name: Place(x[name] - width / 2, tops[layer[name]], width, height)
              for name, (width, height) in sizes.items()}
    lines = []
    for number, (upper, lower) in enumerate(edges):
        start, end = x[upper], x[lower]
        lane = tops[layer[upper] + 1] - LAYER_GAP / 2
        points = [(start, places[upper].bottom)]
        if number in x:
            past = x[number]
            points += [(start, lane), (past, lane), (past, tops[layer[lower]] - LAYER_GAP)]
        elif square and len(uppers[lower]) == 1:
            points += [(start, lane), (end, lane)]
        else:
            points.append((start, lane - LAYER_GAP / 2))
        lines.append(tuple(dict.fromkeys((*points, (end, tops[layer[lower]])))))
    return Placing(places, tuple(lines), max(block.right.values()) - left, max(
        tops[-1] - LAYER_GAP, 0.0))


def _arrange(sizes: Mapping[str, tuple[float, float]], edges: Sequence[tuple[str, str]],
             uppers: Mapping[str, Sequence[str]]) -> tuple[dict[str, int], _Block]:
    """Return the layer of each box, and the block of all boxes."""
    layer, owner = {TOP: -1}, {TOP: TOP}
    owned: dict[str, dict[str | int, None]] = {name: {} for name in (TOP, *sizes)}

    def meet(one: str, other: str) -> str:
        """Return the nearest box that all paths to both boxes pass."""
        while one != other:
            one, other = sorted((one, other), key=layer.__getitem__)
            other = owner[other]
        return one

    downwards = tuple(TopologicalSorter(uppers).static_order())
    for name in downwards:
        layer[name] = 1 + max((layer[upper] for upper in uppers[name]), default=-1)
        owner[name] = reduce(meet, uppers[name] or (TOP,))
    owned[TOP].update(dict.fromkeys(name for name in sizes if not uppers[name]))
    for number, (upper, lower) in enumerate(edges):
        owned[owner[lower]][lower] = None
        if layer[lower] > layer[upper] + 1:
            owned[upper][number] = None
    blocks: dict[str | int, _Block] = {}
    for name in (*reversed(downwards), TOP):
        rows: dict[int, _Block] = {}
        for member in owned[name]:
            first = layer[name] + 1
            if isinstance(member, int):
                block = _Block(member, 0.0, range(first, layer[edges[member][1]]))
            else:
                first, block = layer[member], blocks.pop(member)
            if rows.setdefault(first, block) is not block:
                rows[first].take(block)
        whole = blocks[name] = _Block(name, sizes.get(name, (0.0, 0.0))[0], (layer[name],))
        for first, row in sorted(rows.items()):
            whole.take(row, -(row.left[first] + row.right[first]) / 2)
    return layer, blocks[TOP]
