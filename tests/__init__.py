"""The tests mirror the rooms of the package; what several rooms' tests share lies here."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CELL = ROOT / "tests" / "systems" / "cell.toml"
"""A system that is rich in everything but a robot: gates, an order of two, a shared process."""

TANK = (ROOT / "docs/reference/specification.md").read_text("utf-8").split(
    "```toml\n")[1].split("```")[0]
"""The specification of a tank, which is no mobile robot: the worked example of that page."""


def system_file(name: str) -> Path:
    """Return the file of a system that ships, or of the cell."""
    return CELL if name == "cell" else ROOT / "systems" / f"{name}.toml"
