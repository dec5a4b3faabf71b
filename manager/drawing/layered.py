"""Draws a directed acyclic graph in layers: who stands on which layer, and in what sequence.

The method is that of Sugiyama, Tagawa and Toda (1981), in its simplest form. A vertex stands one
layer below the lowest of those above it (longest path), an edge that passes a layer gets a bend
there, and the vertices of a layer are sorted by the mean position of their neighbours
(barycentre), downwards and upwards, as long as that takes crossings away. A tree starts without a
crossing and stays as it was declared. The same graph always gives the same picture.

`rampart.manager.drawing.placing` turns the sequence into coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from graphlib import TopologicalSorter
from itertools import pairwise

import msgspec

MAX_BENDS = 20_000
"""With more bends than these no picture is readable; long edges then go straight."""

SWEEPS = 12


class Layering(msgspec.Struct, frozen=True):
    """A graph sorted into layers.

    Vertices are numbers: those below `count` are the given names in their sequence, the others
    are bends.

    Attributes:
        count: How many vertices are no bends.
        layers: The vertices of each layer, from left to right; the top layer first.
        chains: For each edge the vertices along it. An edge that jumps a layer without a bend
            there has only its two ends.
    """

    count: int
    layers: tuple[tuple[int, ...], ...]
    chains: tuple[tuple[int, ...], ...]

    def links(self) -> tuple[list[list[int]], list[list[int]]]:
        """Return the neighbours of each vertex on the layer above, and on the layer below."""
        size = sum(map(len, self.layers))
        uppers: list[list[int]] = [[] for _ in range(size)]
        lowers: list[list[int]] = [[] for _ in range(size)]
        layer_of = {v: depth for depth, layer in enumerate(self.layers) for v in layer}
        for chain in self.chains:
            for upper, lower in pairwise(chain):
                if layer_of[lower] == layer_of[upper] + 1:
                    lowers[upper].append(lower)
                    uppers[lower].append(upper)
        return uppers, lowers


def arrange_in_layers(names: Sequence[str], edges: Sequence[tuple[str, str]]) -> Layering:
    """Sort a graph into layers.

    Args:
        names: All vertices; their sequence decides where nothing else does.
        edges: (upper, lower), each once.

    Raises:
        graphlib.CycleError: The graph is not acyclic.
    """
    number = {name: index for index, name in enumerate(names)}
    pairs = [(number[upper], number[lower]) for upper, lower in edges]
    depth = _depths(len(names), pairs)
    bends = sum(depth[lower] - depth[upper] - 1 for upper, lower in pairs)
    layers: list[list[int]] = [[] for _ in range(max(depth, default=-1) + 1)]
    for vertex, layer in enumerate(depth):
        layers[layer].append(vertex)
    chains: list[tuple[int, ...]] = []
    for upper, lower in pairs:
        chain = [upper]
        if bends <= MAX_BENDS:
            for layer in range(depth[upper] + 1, depth[lower]):
                chain.append(len(depth))
                layers[layer].append(len(depth))
                depth.append(layer)
        chains.append((*chain, lower))
    raw = Layering(len(names), tuple(map(tuple, layers)), tuple(chains))
    return msgspec.structs.replace(raw, layers=_sort_layers(raw))


def crossings(layers: Sequence[Sequence[int]], lowers: Sequence[Sequence[int]]) -> int:
    """Return how many pairs of links cross, with a Fenwick tree: n log n for n links."""
    total = 0
    for upper, lower in pairwise(layers):
        position = {vertex: index for index, vertex in enumerate(lower)}
        seen = [0] * (len(lower) + 1)
        drawn = 0
        for vertex in upper:
            ends = sorted(position[v] for v in lowers[vertex])
            for end in ends:  # those drawn before that end further right are crossed
                at, left = end + 1, 0
                while at:
                    left += seen[at]
                    at &= at - 1
                total += drawn - left
            for end in ends:
                at = end + 1
                while at < len(seen):
                    seen[at] += 1
                    at += at & -at
            drawn += len(ends)
    return total


def _depths(count: int, pairs: Sequence[tuple[int, int]]) -> list[int]:
    uppers: dict[int, list[int]] = {vertex: [] for vertex in range(count)}
    for upper, lower in pairs:
        uppers[lower].append(upper)
    depth = [0] * count
    for vertex in TopologicalSorter(uppers).static_order():
        depth[vertex] = max((depth[upper] + 1 for upper in uppers[vertex]), default=0)
    return depth


def _sort_layers(layering: Layering) -> tuple[tuple[int, ...], ...]:
    uppers, lowers = layering.links()
    layers = _depth_first(layering.layers, uppers, lowers)
    best, fewest = [list(layer) for layer in layers], crossings(layers, lowers)
    useless = 0
    for sweep in range(SWEEPS):
        if not fewest or useless == 4:
            break
        down = sweep % 2 == 0
        _sort_by_barycentre(layers if down else layers[::-1], uppers if down else lowers)
        found = crossings(layers, lowers)
        useless += 1
        if found < fewest:
            best, fewest, useless = [list(layer) for layer in layers], found, 0
    return tuple(map(tuple, best))


def _depth_first(given: Sequence[Sequence[int]], uppers: Sequence[Sequence[int]],
                 lowers: Sequence[Sequence[int]]) -> list[list[int]]:
    """Sort each layer by the sequence in which a walk down from the tops meets its vertices."""
    met: dict[int, None] = {}
    to_do = [vertex for layer in given for vertex in layer if not uppers[vertex]][::-1]
    while to_do:
        vertex = to_do.pop()
        if vertex not in met:
            met[vertex] = None
            to_do.extend(reversed(lowers[vertex]))
    rank = {vertex: index for index, vertex in enumerate(met)}
    return [sorted(layer, key=rank.__getitem__) for layer in given]


def _sort_by_barycentre(layers: Sequence[list[int]], neighbours: Sequence[Sequence[int]]) -> None:
    """Sort each layer but the first by the mean position of the neighbours on the one before."""
    for before, layer in pairwise(layers):
        position = {vertex: index for index, vertex in enumerate(before)}
        scale = len(before) / max(1, len(layer))  # a vertex without neighbours stays where it is
        means = {vertex: sum(position[v] for v in near) / len(near) if (near := neighbours[vertex])
                 else index * scale for index, vertex in enumerate(layer)}
        layer.sort(key=means.__getitem__)
