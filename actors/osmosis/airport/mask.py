"""From an image whose red pixels are prohibited to the area where the robot may be.

The authors' samples are JPEGs: within a block (8 pixels) of an edge the red value rings about the
threshold, so that the bare rule would add teeth of a metre and more to the pavement. In a JPEG a
pixel that is plainly red therefore counts as red too. Lone pixels are outvoted by their
neighbours, and islands and holes of a few pixels are dropped. What lies outside the image is
prohibited.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import shapely
from PIL import Image
from shapely.geometry import MultiPolygon, Polygon

from rampart.actors.osmosis.airport.errors import AirportError, readable
from rampart.files.reading import read_bytes

RED_THRESHOLD = 250
"""A pixel with R above this is prohibited (authors' code)."""

PLAINLY_RED = 128
"""In a JPEG, a red value this much above green and blue is red blurred by compression."""

SPECK_PIXELS = 12
"""Islands and holes smaller than this are compression noise."""

MAX_IMAGE_BYTES = 32 << 20
MAX_PIXELS = 1 << 24
"""4,096 x 4,096; at the authors' scale 790 m x 890 m. The authors' own image has 0.6 million."""

MAX_BOXES = 20_000
"""Rectangles into which the pavement falls; a slanted edge makes one for each row of pixels."""


class MaskScale(msgspec.Struct, frozen=True):
    """Pixel column = columns_per_m * (x - left_m); row = rows_per_m * (top_m - y).

    The defaults are the authors': 5.2 * (x + 80) and 4.6 * (80 - y).
    """

    columns_per_m: float = 5.2
    rows_per_m: float = 4.6
    left_m: float = -80.0
    top_m: float = 80.0

    def __post_init__(self) -> None:
        if not (self.columns_per_m > 0 and self.rows_per_m > 0):
            raise AirportError(
                f"mask scale: pixels per metre: ({self.columns_per_m:g}, {self.rows_per_m:g}): "
                "both must be positive")


def allowed_area(path: Path, scale: MaskScale) -> Any:
    """Return the area that is not red as a shapely (multi)polygon in `map`, m.

    Raises:
        AirportError: not an image, or all of it prohibited.
    """
    pixels, lossy = _decoded(path)
    prohibited = pixels[:, :, 0] > RED_THRESHOLD
    if lossy:
        others = pixels[:, :, 1:].max(axis=2)
        prohibited |= (pixels[:, :, 0] > others) & (pixels[:, :, 0] - others > PLAINLY_RED)
    allowed = _without_lone_pixels(~prohibited)
    if not allowed.any():
        raise AirportError(f"{path}: area image: all of it red: pavement must not be red")
    boxes = _boxes(allowed)
    if boxes is None:
        raise AirportError(f"{path}: area image: its pavement falls into more than {MAX_BOXES} "
                           "rectangles: give areas with straight edges, without noise")
    area = shapely.unary_union(_rectangles(boxes, scale))
    pixel_m = max(1 / scale.columns_per_m, 1 / scale.rows_per_m)
    speck_m2 = SPECK_PIXELS / (scale.columns_per_m * scale.rows_per_m)
    return _without_specks(shapely.simplify(area, pixel_m).buffer(0), speck_m2)


def _decoded(path: Path) -> tuple[npt.NDArray[np.uint8], bool]:
    """Return the image as rows x columns x RGB, and whether it was compressed with loss."""
    with readable(path, "give a smaller one", "area image"):
        data = read_bytes(path, MAX_IMAGE_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its size, which is looked at here
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
                columns, rows = image.size
                if columns * rows <= MAX_PIXELS:
                    return np.asarray(image.convert("RGB")), image.format != "PNG"
    except Image.DecompressionBombError:
        columns = rows = 0
    except Exception:  # what a decoder raises that meets damaged bytes is not to be listed
        raise AirportError(f"{path}: area image: unreadable: give a JPEG or PNG") from None
    size = f"{columns} x {rows}" if columns else "far too many"
    raise AirportError(f"{path}: area image: {size} pixels: at most {MAX_PIXELS} are right")


def _without_lone_pixels(allowed: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Majority vote of each pixel with its eight neighbours (a median filter)."""
    padded = np.pad(allowed, 1, mode="edge").astype(np.int8)
    rows, columns = allowed.shape
    votes = sum(padded[i:i + rows, j:j + columns] for i in range(3) for j in range(3))
    return np.asarray(votes) >= 5


def _boxes(allowed: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64] | None:
    """One box for each run of allowed pixels in a row, over all equal rows below it.

    Returns:
        First column, first row, last column, last row, each one array; None if there are too many.
    """
    # A last row of none closes what is open there.
    steps = np.diff(np.pad(allowed, ((0, 1), (1, 1))).astype(np.int8), axis=1)
    boxes: list[tuple[float, float, float, float]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row, step in enumerate(steps):
        begins, ends = np.flatnonzero(step == 1), np.flatnonzero(step == -1)
        runs = set(zip(begins.tolist(), ends.tolist(), strict=True))
        for run in [run for run in open_runs if run not in runs]:
            boxes.append((run[0], open_runs.pop(run), run[1], row))
        for run in runs:
            open_runs.setdefault(run, row)
        if len(boxes) > MAX_BOXES:
            return None
    return np.array(boxes, dtype=float).T


def _rectangles(boxes: npt.NDArray[np.float64], scale: MaskScale) -> list[Any]:
    """Return boxes of pixels as rectangles in `map`."""
    c0, r0, c1, r1 = boxes
    x0, x1 = (scale.left_m + c / scale.columns_per_m for c in (c0, c1))
    y0, y1 = (scale.top_m - r / scale.rows_per_m for r in (r1, r0))
    return list(shapely.box(x0, y0, x1, y1))


def _without_specks(area: Any, speck_m2: float) -> Any:
    parts = []
    for part in shapely.get_parts(area):
        if part.area >= speck_m2:
            holes = [hole for hole in part.interiors if Polygon(hole).area >= speck_m2]
            parts.append(Polygon(part.exterior, holes))
    return parts[0] if len(parts) == 1 else MultiPolygon(parts)
