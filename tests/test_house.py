"""The house: what imports what, and what the engine knows of a robot.

Checked on the code itself, not on a drawing.
"""

import ast
import importlib
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from rampart.actors.osmosis import topics
from rampart.manager.spec.specification import parse_specification
from rampart.systems import SHIPPED
from tests import ROOT

ROOMS = (
    "files", "systems",
    "manager.model", "manager.strategies", "manager.spec", "manager.arbitration",
    "manager.analysis", "manager.drawing",
    "actors.machine", "actors.bus", "actors.ftm", "actors.web", "actors.runtime",
    "actors.detection", "actors.recovery", "actors.foreign",
    "actors.ros2.translation", "actors.ros2", "actors.system", "manager.actor",
    "actors.access", "actors.supervision", "actors.hosts", "actors.recording", "actors.operator",
    "sim.virtual", "sim.faults", "sim.runs", "sim.campaign",
    "cli", "cli.look", "cli.operate", "cli.record", "cli.analyse",
    "cli.host", "cli.run", "cli.new", "cli.main", "cli.commands_page",
    "testing",
)
"""The rooms of the engine, from the bottom to the top: each may import those before it."""

ROBOTS = ("osmosis",)
"""Parts of a path that make a room one of a robot; the engine may not import such a room."""

CLASS_OF_A_ROBOT = re.compile(rf"[\w.]*\b({'|'.join(ROBOTS)})\b[\w.]*(:\w+)?")
"""A text that is such a path names a module or class of a robot."""


def modules() -> dict[str, Path]:
    """Return the files of the package by the name of their module, without `rampart.`."""
    files = [f for top in sorted((ROOT / "rampart").iterdir()) if top.is_dir()
             for f in sorted(top.resolve().rglob("*.py"))]
    names = {f: ".".join(f.relative_to(ROOT).with_suffix("").parts) for f in files}
    return {name.removeprefix("rampart.").removesuffix(".__init__"): file
            for file, name in names.items()}


MODULES = modules()


def is_robot(module: str) -> bool:
    return not set(ROBOTS).isdisjoint(module.split("."))


def room_of(module: str) -> str:
    """Return the room of a module; the longest name counts."""
    return max((r for r in ROOMS if module == r or module.startswith(r + ".")), key=len,
               default=module)


@cache
def imports_of(module: str) -> frozenset[str]:
    """Return the modules of the package that one imports, without `rampart.`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            below = {f"{node.module}.{alias.name}" for alias in node.names}
            inner = {b for b in below if b.removeprefix("rampart.") in MODULES}
            found |= inner or {node.module or ""}
    return frozenset(name.removeprefix("rampart.") for name in found
                     if name.removeprefix("rampart.") in MODULES and name.startswith("rampart."))


def imports() -> set[tuple[str, str]]:
    """Return module and imported module of each import."""
    return {(module, imported) for module in MODULES for imported in imports_of(module)}


def test_each_module_lives_in_a_room_that_is_listed():
    packages = {m for m, file in MODULES.items() if file.name == "__init__.py"}
    homeless = {m for m in MODULES if m not in packages and not is_robot(m)
                and room_of(m) not in ROOMS}
    assert homeless == set()


def test_no_import_goes_up():
    rank = {room: place for place, room in enumerate(ROOMS)}
    assert {(module, imported) for module, imported in imports()
            if not is_robot(module) and not is_robot(imported)
            and rank.get(room_of(imported), -1) > rank.get(room_of(module), 99)} == set()


def test_the_engine_imports_no_robot():
    assert {(module, imported) for module, imported in imports()
            if is_robot(imported) and not is_robot(module)} == set()


def names_of_the_robot() -> set[str]:
    """Return names that only a robot has: its nodes, modules, mechanisms, topics, map."""
    found = {"airport", "obstacles", "runway", "osmosis"}
    for name in ("osmosis", "paper"):
        spec = parse_specification((SHIPPED / f"{name}.toml").read_text("utf-8"), name)
        parts = (spec.nodes, spec.detections, spec.recoveries, spec.mechanisms, spec.events)
        found |= {one.name for part in parts for one in part}
    return (found | {topic.key for topic in topics.ROBOT}) - {"simulator", "hmi"}


def test_the_engine_names_no_robot_in_texts_either():
    """Docstrings and the examples of a help text may; what decides may not know a name."""
    robots = names_of_the_robot()
    found = set()
    for module, file in MODULES.items():
        if is_robot(module) or module == "systems":  # which one is the default
            continue
        tree = ast.parse(file.read_text(encoding="utf-8"))
        shown = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) \
                    and id(node) not in shown \
                    and (node.value in robots or CLASS_OF_A_ROBOT.fullmatch(node.value)):
                found.add(module)
    assert found == set()


def test_no_circle_of_imports():
    TopologicalSorter({module: imports_of(module) for module in MODULES}).prepare()


def named(text: str) -> list[str]:
    """Return the rooms that a text names as folders and files, as names of modules."""
    return [name.removeprefix("rampart/").removesuffix(".py").replace("/", ".")
            for name in re.findall(r"[a-z]\w*(?:/[a-z]\w*)*(?:\.py)?", text)]


def test_the_map_of_the_house_names_every_room():
    page = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    house = page.partition("## The house")[2].partition("\n## ")[0]
    rows = [named(row) for row in re.findall(r"^\| (`.*?`) \|", house, re.MULTILINE)]
    rooms = [room for row in rows for room in row]
    assert [room for room in rooms if not is_robot(room)] == list(ROOMS)
    assert {room for room in rooms if is_robot(room)} == {
        ".".join(m.split(".")[:2]) for m in MODULES if is_robot(m)}


def test_the_arrows_of_the_map_are_the_imports():
    source = (ROOT / "docs/images/rooms.mmd").read_text(encoding="utf-8")
    boxes = {room: box
             for box, label in re.findall(r'^  (\w+)\(?\["(.*)"\]', source, re.MULTILINE)
             for room in named(label.replace("<br>", " "))}
    assert set(boxes) >= set(ROOMS)
    drawn = set(re.findall(r"^  (\w+) --> (\w+)$", source, re.MULTILINE))

    def box_of(module: str) -> str | None:
        room = ".".join(module.split(".")[:2]) if is_robot(module) else room_of(module)
        return boxes.get(room)  # the package of several rooms is in none

    between_boxes = {(box_of(module), box_of(imported)) for module, imported in imports()
                     if is_robot(module) or not is_robot(imported)}
    reached = set(drawn)
    for between in set(boxes.values()):
        reached |= {(a, d) for a, b in reached for c, d in reached if b == between == c}
    assert drawn <= between_boxes
    assert {(a, b) for a, b in between_boxes if a != b and None not in {a, b}} <= reached


def test_a_room_has_one_name_only():
    """From a checkout Python finds the folders, too."""
    for name in ("actors", "cli", "files", "manager", "sim", "systems"):
        with pytest.raises(ImportError, match=f"import it as rampart.{name}"):
            importlib.import_module(name)


def test_no_tracked_text_names_a_path_of_the_machine_it_was_written_on():
    home = str(ROOT)
    for file in MODULES.values():
        assert home not in file.read_text(encoding="utf-8"), file
