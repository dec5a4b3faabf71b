"""Reads the specification of a system (its tables: `rampart.manager.spec.schema`).

1. `rampart.files.toml` and `msgspec` check syntax, sizes, types and field names.
2. Missing timeouts are derived from the robot (`rampart.manager.spec.mobile_robot`). Parameters
   that name a timing value get that value.
3. `rampart.manager.spec.checks` checks names, cycles, the tree, the order and the time budget.

Every error is one line: file, path, value, and what was expected (`SpecificationError`). The
caller passes the text and a name for messages; no file is opened here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from rampart.files import toml
from rampart.files.reading import FileError
from rampart.manager.spec.checks import find_nonsense, find_nonsense_of_rest
from rampart.manager.spec.mobile_robot import derive_timeouts
from rampart.manager.spec.nodes import COMMAND_FIELDS
from rampart.manager.spec.reading import MisfitError, read
from rampart.manager.spec.schema import DetectionSpec, NodeSpec, RecoverySpec, SystemSpec
from rampart.manager.spec.tables import Finding, SpecificationError, Table, by_name

Row = TypeVar("Row", bound=Table)

LARGEST, SMALLEST = 1e9, 1e-9
"""Of numbers outside parameters; their squares and quotients are far from a float's limits."""

MAX_DEPTH = 32
"""Deepest nesting of tables and arrays."""

LARGEST_INTEGER = 2 ** 63 - 1
"""Of MessagePack, by which parameters reach an actor."""

INTERFACES, SETUP, TLS = "interfaces", "setup", "tls"
"""Parameters of a node in a system with `[[ros2]]`: a list of folders, a file, and a table of
files, all relative to the system's file.
"""


def parse_specification(text: str, file: str) -> SystemSpec:
    """Read a system spec from TOML and check it; messages name `file`.

    Every timing value of the result is a number.

    Raises:
        SpecificationError: The text is not TOML, a field is missing, unknown or of the wrong type,
            or a check fails.
    """
    return check_document(read_document(text, file), file)


def read_document(text: str, file: str) -> dict[str, Any]:
    """Read TOML without checks; a byte order mark at the start is ignored.

    Raises:
        SpecificationError: The text is not TOML.
    """
    try:
        return toml.parse(text)
    except FileError as error:
        raise SpecificationError(file, "$", str(error)) from None


def check_change(before: SystemSpec, after: SystemSpec) -> None:
    """Check that a running system can be changed into another one.

    Actors, processes, hosts and commands stay. An actor's class may change only within the Python
    modules that the system names already: to import a module is to execute it, and only the file
    that the operator started decides which.

    Raises:
        ValueError: It cannot; the message names node, field and value.
    """
    old, new = ({node.name: node for node in spec.actors()} for spec in (before, after))
    if old.keys() != new.keys():
        names = ", ".join(sorted(old.keys() ^ new.keys()))
        raise ValueError(f"{names}: a running system keeps the actors that it was started with")
    known = {node.actor.partition(":")[0] for node in old.values()}
    for name, node in new.items():
        if node.actor.partition(":")[0] not in known:
            raise ValueError(f"{name}: actor = {node.actor!r}: expected a class in a module that "
                             f"the running system uses: {', '.join(sorted(known))}")
        for field in ("process", "host", *COMMAND_FIELDS):
            value, kept = getattr(node, field), getattr(old[name], field)
            if value != kept:
                raise ValueError(f"{name}: {field} = {value!r}: expected {kept!r}, which stays "
                                 "while a system runs")


def check_document(document: dict[str, Any], file: str) -> SystemSpec:
    """Make a spec of a document, and check it.

    Disabled mechanisms, and those with a disabled module, are checked like all others. They are
    then left out, and the rest is checked again.

    Raises:
        SpecificationError: A field is missing, unknown or of the wrong type, or a check fails.
    """
    for finding in _find_unwritable(document):
        raise _refusal(file, finding, document)
    try:
        spec = read(document, SystemSpec)
    except MisfitError as error:
        raise _refusal(file, error.finding, document) from None
    spec = replace(spec, timing=derive_timeouts(spec.mobile, spec.timing))
    spec = _resolve_folders(_resolve_timing_names(spec, file), file)
    wrong = find_nonsense(spec)
    if wrong is None:
        enabled = spec.without_disabled()
        wrong = find_nonsense_of_rest(enabled) if enabled is not spec else None
        spec = enabled
    if wrong is not None:
        raise _refusal(file, wrong, document)
    return spec


def read_rows(rows: Sequence[dict[str, Any]], kind: type[Row], table: str, file: str
              ) -> tuple[Row, ...]:
    """Read the rows of a table that belongs to an actor; messages name `table` and `file`.

    Raises:
        SpecificationError: A field is missing, unknown or of the wrong type.
    """
    try:
        return tuple(read(row, kind, f"$.{table}[{place}]") for place, row in enumerate(rows))
    except MisfitError as error:
        raise _refusal(file, error.finding, {}) from None


def _refusal(file: str, finding: Finding, document: Mapping[str, Any]) -> SpecificationError:
    return SpecificationError(
        file, by_name(finding.path, document), finding.problem, *finding.value)


def _find_unwritable(document: dict[str, Any]) -> Iterator[Finding]:
    """Find too deep nesting, and numbers that cannot be a time, a distance or a count."""
    left: list[tuple[object, str, int, bool]] = [(document, "$", 0, False)]
    while left:
        value, path, depth, free = left.pop()
        if depth > MAX_DEPTH:
            yield Finding("$", f"nested more than {MAX_DEPTH} deep")
        elif isinstance(value, dict):
            left += [(member, f"{path}.{key}", depth + 1, free or key == "parameters")
                     for key, member in reversed(value.items())]
        elif isinstance(value, list):
            left += [(member, f"{path}[{index}]", depth + 1, free)
                     for index, member in reversed([*enumerate(value)])]
        elif isinstance(value, float) and not math.isfinite(value):
            yield Finding(path, "expected a finite number", (value,))
        elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            yield Finding(path, f"expected an integer of at most {LARGEST_INTEGER}", (value,))
        elif isinstance(value, int | float) and not free and value and not (
                SMALLEST <= abs(value) <= LARGEST):
            yield Finding(path, f"expected 0, or {SMALLEST:g} to {LARGEST:g} in size", (value,))


def _resolve_timing_names(spec: SystemSpec, file: str) -> SystemSpec:
    """Replace names of timing values by their values, in `within_s` and in parameters `*_s`."""
    times = msgspec.structs.asdict(spec.timing)

    def resolve(value: Any, path: str) -> Any:
        if not isinstance(value, str):
            return value
        if value not in times:
            raise SpecificationError(file, path, "unknown timing value; expected a number or one "
                                                 f"of: {', '.join(times)}", value)
        return times[value]

    def resolved(table: str, row: NodeSpec | DetectionSpec | RecoverySpec) -> dict[str, Any]:
        where = f"{table} {row.name}: parameters"
        return {key: resolve(value, f"{where}.{key}") if key.endswith("_s") else value
                for key, value in row.parameters.items()}

    detections = []
    for row in spec.detections:
        parameters = resolved("detection", row)
        within_s = resolve(row.within_s, f"detection {row.name}: within_s")
        if math.isnan(within_s):
            within_s = parameters.get("timeout_s", within_s)
        detections.append(replace(row, within_s=within_s, parameters=parameters))
    nodes = (replace(row, parameters=resolved("node", row)) for row in spec.nodes)
    recoveries = (replace(row, parameters=resolved("recovery", row)) for row in spec.recoveries)
    return replace(spec, nodes=tuple(nodes), detections=tuple(detections),
                   recoveries=tuple(recoveries))


def _resolve_folders(spec: SystemSpec, file: str) -> SystemSpec:
    """Make folders and files of a ROS 2 gateway relative to the folder of the system's file."""

    def beside(path: Any) -> Any:
        return str(PurePath(file).parent / path) if path and isinstance(path, str) else path

    def resolved(node: NodeSpec) -> NodeSpec:
        given = dict(node.parameters)
        if SETUP in given:
            given[SETUP] = beside(given[SETUP])
        if isinstance(folders := given.get(INTERFACES), list):
            given[INTERFACES] = list(map(beside, folders))
        if isinstance(files := given.get(TLS), dict):
            given[TLS] = {name: beside(path) for name, path in files.items()}
        return replace(node, parameters=given)

    return replace(spec, nodes=tuple(map(resolved, spec.nodes))) if spec.ros2 else spec
