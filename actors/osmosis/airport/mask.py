"""Reads the allowed area from an image whose red pixels are prohibited.

The authors' samples are JPEGs: within a block (8 pixels) of an edge the red value oscillates around
the threshold. The threshold alone would add teeth of more than a metre to the pavement, so in a
JPEG a pixel that is clearly red counts as red too. A median filter removes single pixels; islands
and holes of a few pixels are dropped. The area outside the image is prohibited.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry import MultiPolygon, Polygon

from rampart.actors.osmosis.airport.errors import AirportError, readable
from rampart.files.reading import read_bytes

RED_THRESHOLD = 250
"""Pixels with R above this are prohibited (authors' code)."""

PLAINLY_RED = 128
"""In a JPEG, a pixel whose red exceeds green and blue by more than this is prohibited."""

SPECK_PIXELS = 12
"""Smaller islands and holes are compression noise."""

MAX_IMAGE_BYTES = 32 << 20
MAX_PIXELS = 1 << 24
"""4,096 x 4,096, at the authors' scale 790 m x 890 m. The authors' image has 0.6 million."""

MAX_BOXES = 20_000
"""Rectangles that make up the pavement; a slanted edge needs one per row of pixels."""


COLUMNS_PER_M, ROWS_PER_M, LEFT_M, TOP_M = 5.2, 4.6, -80.0, 80.0
"""The authors' scale: column = 5.2 * (x + 80), row = 4.6 * (80 - y)."""


def allowed_area(path: Path) -> Any:
    """Return the area that is not red as a shapely (multi)polygon in `map`, m.

    Raises:
        AirportError: not an image, or entirely prohibited.
    """
    pixels, lossy = _decoded(path)
    prohibited = pixels[:, :, 0] > RED_THRESHOLD
    if lossy:
        others = pixels[:, :, 1:].max(axis=2)
        prohibited |= (pixels[:, :, 0] > others) & (pixels[:, :, 0] - others > PLAINLY_RED)
    allowed = _without_lone_pixels(~prohibited)
    if not allowed.any():
        raise AirportError(f"{path}: area image: entirely red: expected pavement that is not red")
    boxes = _boxes(allowed)
    if boxes is None:
        raise AirportError(f"{path}: area image: pavement of more than {MAX_BOXES} rectangles: "
                           "expected straight edges without noise")
    area = shapely.unary_union(_rectangles(boxes))
    pixel_m = max(1 / COLUMNS_PER_M, 1 / ROWS_PER_M)
    speck_m2 = SPECK_PIXELS / (COLUMNS_PER_M * ROWS_PER_M)
    return _without_specks(shapely.simplify(area, pixel_m).buffer(0), speck_m2)


def _decoded(path: Path) -> tuple[npt.NDArray[np.uint8], bool]:
    """Return the image as rows x columns x RGB, and whether its compression is lossy."""
    from PIL import Image  # noqa: PLC0415 few airports have an image

    with readable(path, "expected a smaller one", "area image"):
        data = read_bytes(path, MAX_IMAGE_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about its size, which is checked here
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
                columns, rows = image.size
                if columns * rows <= MAX_PIXELS:
                    return np.asarray(image.convert("RGB")), image.format != "PNG"
    except Image.DecompressionBombError:
        columns = rows = 0
    except Exception:  # decoders raise many kinds for damaged bytes
        raise AirportError(f"{path}: area image: unreadable: expected a JPEG or PNG") from None
    size = f"{columns} x {rows}" if columns else "far too many"
    raise AirportError(f"{path}: area image: {size} pixels: expected at most {MAX_PIXELS}")


def _without_lone_pixels(allowed: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Apply a 3 x 3 median filter."""
    padded = np.pad(allowed, 1, mode="edge").astype(np.int8)
    rows, columns = allowed.shape
    votes = sum(padded[i:i + rows, j:j + columns] for i in range(3) for j in range(3))
    return np.asarray(votes) >= 5


def _boxes(allowed: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64] | None:
    """Return boxes of allowed pixels: one per run of pixels, over all rows with the same run.

    Returns:
        First column, first row, last column and last row as one array each; None if too many.
    """
    # An empty last row closes the open runs.
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


def _rectangles(boxes: npt.NDArray[np.float64]) -> list[Any]:
    """Convert boxes of pixels to rectangles in `map`."""
    c0, r0, c1, r1 = boxes
    x0, x1 = (LEFT_M + c / COLUMNS_PER_M for c in (c0, c1))
    y0, y1 = (TOP_M - r / ROWS_PER_M for r in (r1, r0))
    return list(shapely.box(x0, y0, x1, y1))


def _without_specks(area: Any, speck_m2: float) -> Any:
    parts = []
    for part in shapely.get_parts(area):
        if part.area >= speck_m2:
            holes = [hole for hole in part.interiors if Polygon(hole).area >= speck_m2]
            parts.append(Polygon(part.exterior, holes))
    return parts[0] if len(parts) == 1 else MultiPolygon(parts)
