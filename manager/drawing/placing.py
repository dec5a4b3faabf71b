"""Gives the boxes of a graph their coordinates, and the lines between them theirs.

A tidy tree (Reingold and Tilford 1981): a box stands one layer below the lowest of those above it,
subtrees stand side by side as near as their outlines allow, in the declared sequence, and what is
above stands centred over what is below. So nothing of a tree crosses, and lines go down, across
and down without touching those of others.

A box that several lead to belongs to the nearest box that all ways to it lead through, and stands
centred below that, on its own layer; the lines to it slant. One that passes layers on its way gets
a place of its own there, so that no line crosses a box. The same graph always gives the same
picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from graphlib import TopologicalSorter
from itertools import accumulate
from math import inf

import msgspec

GAP = 22.0
"""Between two boxes of a layer."""
LAYER_GAP = 34.0
"""Between two layers."""
TOP = ""
"""What all boxes belong to; it is not drawn."""

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


class _Block:
    """Boxes (by name) and passing lines (by the number of their edge), placed side by side."""

    def __init__(self, member: str | int, width: float, layers: Sequence[int]) -> None:
        self.x = {member: 0.0}
        self.left = dict.fromkeys(layers, -width / 2)
        self.right = dict.fromkeys(layers, width / 2)

    def take(self, other: _Block, wanted: float = -inf) -> None:
        """Take in another block, moved by `wanted`, or as much further right as it must be."""
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
        square: Draw the lines of a tree across and down, else straight.

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
    """Return the layer of each box, and all of them side by side."""
    layer, owner = {TOP: -1}, {TOP: TOP}
    owned: dict[str, dict[str | int, None]] = {name: {} for name in (TOP, *sizes)}

    def meet(one: str, other: str) -> str:
        """Return the nearest box that all ways to both lead through."""
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
