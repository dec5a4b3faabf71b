"""The house's rule: imports run one way. Checked on the code itself, not on a drawing."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

ALLOWED: dict[str, set[str]] = {
    "files": set(),
    "airport": set(),
    "actors.runtime": set(),
    "manager": set(),
    "actors": {"actors.runtime"},  # messages.py and topics.py, the robot's contract
    "rampart.manager.actor": {"actors.runtime", "actors", "manager"},
    "actors.control": {"actors.runtime", "actors", "airport", "manager"},
    # The page shows the processes that supervision looks after.
    "actors.operator": {"actors.runtime", "actors", "actors.supervision", "airport", "manager"},
    "actors.detection": {"actors.runtime", "actors", "airport", "manager"},
    "actors.recovery": {"actors.runtime", "actors", "airport", "manager"},
    "actors.recording": {"actors.runtime", "actors", "actors.supervision", "airport", "manager"},
    "actors.stub": {"actors.runtime", "actors", "actors.detection", "actors.recovery"},
    "actors.supervision": {"actors.runtime", "actors", "airport", "manager"},
    "sim": {"actors.runtime", "actors", "actors.supervision", "airport", "manager", "systems"},
    "toolbox": {"actors.runtime", "actors", "actors.supervision", "actors.operator",
                "actors.recording", "airport", "manager", "sim", "systems"},
    "launch": {"actors.runtime", "actors", "actors.supervision", "actors.recording", "airport",
               "manager", "sim", "systems"},
}
"""What each room may import, besides itself, `files` and third parties."""

ROOMS = sorted(ALLOWED, key=len, reverse=True)
TOP = {"actors", "airport", "files", "manager", "sim", "toolbox", "launch", "systems"}


def room_of(module: str) -> str | None:
    """Return the room of a dotted module name; longest match wins."""
    if module.split(".", maxsplit=1)[0] not in TOP:
        return None
    if module == "systems" or module.startswith("systems."):
        return "systems"
    return next((r for r in ROOMS if module == r or module.startswith(r + ".")), module)


def imports_of(file: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{file}: relative import"
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names
                                      if (ROOT / f"{node.module}.{alias.name}".replace(".", "/")
                                          ).with_suffix(".py").exists()}
    return found


def modules() -> list[tuple[str, Path]]:
    files = [ROOT / "launch.py"]
    for top in ("actors", "airport", "files", "manager", "sim", "toolbox"):
        files += sorted((ROOT / top).rglob("*.py"))
    return [(".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), f)
            for f in files]


@pytest.mark.parametrize(("module", "file"), modules(), ids=[m for m, _ in modules()])
def test_a_module_imports_only_what_its_room_may(module, file):
    room = room_of(module)
    wrong = {
        imported for imported in imports_of(file)
        if (target := room_of(imported)) is not None
        and target not in {room, "files"} and target not in ALLOWED[room]
    }
    assert wrong == set(), f"{module} (room {room}) must not import {sorted(wrong)}"


def test_no_tracked_text_names_a_path_of_the_machine_it_was_written_on():
    home = str(ROOT)
    for _, file in modules():
        assert home not in file.read_text(encoding="utf-8"), file
