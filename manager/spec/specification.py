"""Reads the specification of a system; what a spec can say is in `rampart.manager.spec.schema`.

Reading happens in three steps, each with its own kind of error, and every error is one line that
names file, path, value, and what would be right (`SpecificationError`):

1. syntax, sizes and types: `rampart.files.toml`, then `msgspec`, strict, unknown fields forbidden;
2. timing values left out are derived from the robot (`rampart.manager.spec.mobile_robot`), and
   parameters that name a timing value are replaced by it;
3. sense: names, cycles, the tree, the order, the time budget (`rampart.manager.spec.checks`).

There is no file I/O here: the caller hands over the text, and the name to use in messages.
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
"""Of numbers that the analyses calculate with: squares and quotients of these are far from the
limits of a float, and a thousand million seconds are thirty years.
"""

LARGEST_INTEGER = 2 ** 63 - 1
"""In parameters, which go to an actor as they are, by way of MessagePack."""

INTERFACES = "interfaces"
"""Parameter of a node in a system with `[[ros2]]`: folders, relative to the file of the system."""


def parse_specification(text: str, file: str) -> SystemSpec:
    """Read a system spec and check it.

    Args:
        text: TOML.
        file: Name to use in messages.

    Returns:
        The spec, with every timing value a number.

    Raises:
        SpecificationError: The text is no TOML, a field is missing, unknown or of the wrong type,
            or the spec makes no sense.
    """
    return check_document(read_document(text, file), file)


def read_document(text: str, file: str) -> dict[str, Any]:
    """Read TOML, unchecked; a byte order mark at its beginning is no part of it.

    Raises:
        SpecificationError: The text is no TOML.
    """
    try:
        return toml.parse(text)
    except FileError as error:
        raise SpecificationError(file, "$", str(error)) from None


def check_change(before: SystemSpec, after: SystemSpec) -> None:
    """Make sure that a running system can be changed into another one.

    The actors, their processes, hosts and commands stay. No module is named that the system it came
    from does not name: a class is imported when it is named, and its module is executed. Only the
    file that the operator started the system with decides which ones may be.

    Raises:
        ValueError: It cannot; the message names node, field and value.
    """
    was, becomes = ({node.name: node for node in spec.actors()} for spec in (before, after))
    if was.keys() != becomes.keys():
        names = ", ".join(sorted(was.keys() ^ becomes.keys()))
        raise ValueError(f"{names}: a running system keeps the actors that it was started with")
    known = {node.actor.partition(":")[0] for node in was.values()}
    for name, node in becomes.items():
        if node.actor.partition(":")[0] not in known:
            raise ValueError(f"{name}: actor = {node.actor!r}: no actor of the system that was "
                             "started is in that module; known modules: "
                             f"{', '.join(sorted(known))}")
        for field in ("process", "host", *COMMAND_FIELDS):
            value, kept = getattr(node, field), getattr(was[name], field)
            if value != kept:
                raise ValueError(f"{name}: {field} = {value!r}: expected {kept!r}, which stays "
                                 "while a system runs")


def check_document(document: dict[str, Any], file: str) -> SystemSpec:
    """Make a spec of a document, and check it.

    Mechanisms that are disabled, or of which a module is, are checked like all others and then
    left out; what remains has to make sense as well.

    Raises:
        SpecificationError: A field is missing, unknown or of the wrong type, or the spec makes no
            sense.
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
    """Read rows of a table that is an actor's, and not known here.

    Args:
        rows: As the spec has them.
        kind: What one says.
        table: Its name in the file.
        file: Name to use in messages.

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
    """Find nesting without end, and numbers that no time, distance or count is."""
    left: list[tuple[object, str, int, bool]] = [(document, "$", 0, False)]
    while left:
        value, path, depth, free = left.pop()
        if depth > toml.MAX_DEPTH:
            yield Finding("$", f"nested more than {toml.MAX_DEPTH} deep")
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
            yield Finding(path, f"out of all proportion; expected {SMALLEST:g} to {LARGEST:g}",
                          (value,))


def _resolve_timing_names(spec: SystemSpec, file: str) -> SystemSpec:
    """Replace names of timing values by the values, in `within_s` and in parameters `*_s`."""
    times = msgspec.structs.asdict(spec.timing)

    def resolve(value: Any, path: str) -> Any:
        if not isinstance(value, str):
            return value
        if value not in times:
            raise SpecificationError(file, path, "unknown timing value; a number or one of: "
                                                 f"{', '.join(times)}", value)
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
    """Put the folder of the file before those that a gateway to ROS 2 names."""

    def resolved(node: NodeSpec) -> NodeSpec:
        named = node.parameters.get(INTERFACES)
        if not isinstance(named, list):
            return node
        above = PurePath(file).parent
        return replace(node, parameters={**node.parameters, INTERFACES: [
            str(above / one) if isinstance(one, str) else one for one in named]})

    return replace(spec, nodes=tuple(map(resolved, spec.nodes))) if spec.ros2 else spec
