"""An airport as large as the largest real ones: 8 km, four runways, over 1,000 surfaces."""

from __future__ import annotations

from pathlib import Path

import tomli_w

WIDE_M, PITCH_M = 8000, 60
RUNWAYS_M = (-2000, -700, 700, 2000)


def write_large_airport(path: Path) -> Path:
    """Write its TOML file."""
    surfaces, nodes, edges, rows = [], {}, [], []
    xs = range(-WIDE_M // 2, WIDE_M // 2 + 1, PITCH_M)

    def pave(name: str, kind: str, half_m: float, *line: tuple[float, float]) -> None:
        surfaces.append({"name": name, "kind": kind, "half_width_m": half_m, "centre_line": line})

    for y in RUNWAYS_M:
        pave(f"R{y}", "runway", 30.0, (xs[0], y), (xs[-1], y))
        for side in (-180, 180):
            lane = f"{y + side}/"
            pave(f"T{lane}", "taxiway", 12.0, (xs[0], y + side), (xs[-1], y + side))
            for number, x in enumerate(xs):
                pave(f"C{lane}{number}", "taxiway", 12.0, (x, y), (x, y + side))
                nodes |= {f"{lane}{number}": (x, y + side), f"r{lane}{number}": (x, y + side / 18)}
                edges.append((f"{lane}{number}", f"r{lane}{number}"))
                if number:
                    edges.append((f"{lane}{number - 1}", f"{lane}{number}"))
            rows.append({"name": f"L{lane}", "nominal_cd": 50.0, "first": (xs[0], y + side),
                         "last": (xs[-1], y + side), "count": 200})
    goals = [{"x_m": x, "y_m": -520.0, "mode": mode} for x, mode in (
        (20.0, "taxi"), (980.0, "light verification"), (2960.0, "taxi"))]
    path.write_text(tomli_w.dumps({
        "name": "large", "start": {"x_m": 20.0, "y_m": -520.0, "yaw_rad": 0.0}, "nodes": nodes,
        "edges": edges, "surface": surfaces, "row": rows, "missions": {"A": {"goals": goals}}}))
    return path
