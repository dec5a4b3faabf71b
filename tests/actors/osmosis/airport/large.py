"""An airport as large as the largest real ones: 8 km, four runways, over 1,000 surfaces."""

from __future__ import annotations

from pathlib import Path

import tomli_w

WIDE_M, PITCH_M = 8000, 200
RUNWAYS_M = (-2000, -700, 700, 2000)


def write_large_airport(path: Path) -> Path:
    """Write its TOML file."""
    surfaces, buildings, nodes, edges, rows = [], [], {}, [], []
    xs = range(-WIDE_M // 2, WIDE_M // 2 + 1, PITCH_M)
    for runway, y in enumerate(RUNWAYS_M):
        surfaces.append({"name": f"R{runway}", "kind": "runway", "half_width_m": 30.0,
                         "centre_line": [[xs[0], y], [xs[-1], y]]})
        for side in (-180, 180):
            lane = f"{runway}{'s' if side < 0 else 'n'}"
            surfaces.append({"name": f"T{lane}", "kind": "taxiway", "half_width_m": 12.0,
                             "centre_line": [[xs[0], y + side], [xs[-1], y + side]]})
            for number, x in enumerate(xs):
                nodes[f"{lane}{number}"] = [x, y + side]
                if number:
                    edges.append([f"{lane}{number - 1}", f"{lane}{number}"])
                surfaces.append({"name": f"C{lane}{number}", "kind": "taxiway",
                                 "half_width_m": 12.0, "centre_line": [[x, y], [x, y + side]]})
                nodes[f"r{lane}{number}"] = [x, y + side / 18]
                edges.append([f"{lane}{number}", f"r{lane}{number}"])
                if number % 2 == 0:
                    continue
                stand = y + side * 1.4
                surfaces += [{"name": f"S{lane}{number}.{n}", "kind": "apron", "polygon": [
                    [x + 40 * n - 18, stand - 70], [x + 40 * n + 18, stand - 70],
                    [x + 40 * n + 18, stand + 70], [x + 40 * n - 18, stand + 70]]}
                    for n in range(-2, 3)]
                buildings.append({
                    "name": f"B{lane}{number}", "x_m": x, "y_m": y + side * 2.2, "length_m": 120,
                    "width_m": 40, "height_m": 12})
            rows.append({"name": f"L{lane}", "nominal_cd": 50.0, "first": [xs[0], y + side],
                         "last": [xs[-1], y + side], "count": 200})
    path.write_text(tomli_w.dumps({
        "name": "large", "start": {"x_m": 0.0, "y_m": -520.0, "yaw_rad": 0.0}, "nodes": nodes,
        "edges": edges, "surface": surfaces, "building": buildings, "row": rows,
        "missions": {"A": {"goals": [
            {"x_m": 0.0, "y_m": -520.0, "mode": "taxi"},
            {"x_m": 1000.0, "y_m": -520.0, "mode": "light verification"},
            {"x_m": 3000.0, "y_m": -520.0, "mode": "taxi"}]}}}))
    return path
