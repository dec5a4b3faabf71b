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
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from itertools import chain
from pathlib import PurePath
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from rampart.files import toml
from rampart.files.reading import FileError
from rampart.manager.model.mechanisms import RecoveryKind
from rampart.manager.spec.checks import find_nonsense, find_nonsense_of_rest
from rampart.manager.spec.mobile_robot import Hazard, derive_timeouts
from rampart.manager.spec.nodes import COMMAND_FIELDS, NODE_KINDS
from rampart.manager.spec.schema import (
    TABLES,
    DetectionSpec,
    NodeSpec,
    RecoverySpec,
    SystemSpec,
)
from rampart.manager.spec.tables import Finding, SpecificationError, Table, by_name

Row = TypeVar("Row", bound=Table)

ENUMS: dict[tuple[str, str], Iterable[Enum]] = {
    ("node", "kind"): NODE_KINDS, ("recovery", "kind"): RecoveryKind,
    ("mechanism", "against"): Hazard}

LARGEST, SMALLEST = 1e9, 1e-9
"""Of numbers that the analyses calculate with: squares and quotients of these are far from the
limits of a float, and a thousand million seconds are thirty years.
"""

LARGEST_INTEGER = 2 ** 63 - 1
"""In parameters, which go to an actor as they are, by way of MessagePack."""

INTERFACES = "interfaces"
"""Parameter of a node in a system with `[[ros2]]`: folders, relative to the file of the system."""

MAX_ROWS = {"node": 1000, "detection": 1000, "recovery": 500, "mechanism": 1000, "event": 5000,
            "host": 16, "fault": 500, "orders": 16, "panel": 40, "ros2": 500}
"""Of each table; the shipped systems have 31 actors, and checks compare many with many."""


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

    The actors, their processes and their hosts stay. No module is named that the system it came
    from does not name: a class is imported when it is named, and its module is executed. Only the
    file that the operator started the system with decides which ones may be.

    Raises:
        ValueError: It cannot; the message names node, field and value.
    """
    known = {node.actor.partition(":")[0] for node in before.actors()}
    for node in after.actors():
        if node.actor.partition(":")[0] not in known:
            raise ValueError(f"{node.name}: actor = {node.actor!r}: no actor of the system that "
                             "was started is in that module; known modules: "
                             f"{', '.join(sorted(known))}")
    commands = {node.name: node for node in before.nodes}
    for new in after.nodes:
        for field in COMMAND_FIELDS if new.command else ():
            if getattr(new, field) != getattr(commands.get(new.name), field, None):
                raise ValueError(f"{new.name}: {field}: of a command nothing changes while it runs")
    was, becomes = ({node.name: node for node in spec.actors()} for spec in (before, after))
    if was.keys() != becomes.keys():
        names = ", ".join(sorted(was.keys() ^ becomes.keys()))
        raise ValueError(f"{names}: a running system keeps the actors that it was started with")
    for name, node in becomes.items():
        for field in ("process", "host"):
            value, kept = getattr(node, field), getattr(was[name], field)
            if value != kept:
                raise ValueError(f"{name}: {field} = {value!r}: expected {kept!r}, for while a "
                                 f"system runs no actor moves to another {field}")


def check_document(document: dict[str, Any], file: str) -> SystemSpec:
    """Make a spec of a document, and check it.

    Mechanisms that are disabled, or of which a module is, are checked like all others and then
    left out; what remains has to make sense as well.

    Raises:
        SpecificationError: A field is missing, unknown or of the wrong type, or the spec makes no
            sense.
    """
    for finding in chain(_find_unwritable(document), _find_misshapen(document)):
        raise _refusal(file, finding, document)
    try:
        spec = msgspec.convert(document, SystemSpec)
    except msgspec.ValidationError as error:
        raise _refusal(file, _explain(str(error), document), document) from None
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


def read_rows(rows: Sequence[dict[str, Any]], kind: type[Row], table: str, file: str,
              text: str = "") -> tuple[Row, ...]:
    """Read rows of a table that is an actor's, and not known here.

    Args:
        rows: As the spec has them.
        kind: What one says.
        table: Its name in the file.
        file: Name to use in messages.
        text: What a text should be that is refused by its form.

    Raises:
        SpecificationError: A field is missing, unknown or of the wrong type.
    """
    found = []
    for place, row in enumerate(rows):
        try:
            found.append(msgspec.convert(row, kind))
        except msgspec.ValidationError as error:
            problem, _, path = str(error).rpartition(" - at `$")
            where = f" - at `$.{table}[{place}]" + (path if problem else "`")
            raise _refusal(file, _explain(f"{problem or error}{where}", {table: [*rows]},
                                          {table: kind}, text), {}) from None
    return tuple(found)


def _refusal(file: str, finding: Finding, document: Mapping[str, Any]) -> SpecificationError:
    return SpecificationError(
        file, by_name(finding.path, document), finding.problem, *finding.value)


def _find_unwritable(document: dict[str, Any]) -> Iterator[Finding]:
    """Find nesting without end, and numbers that no time, distance or count is."""
    left: list[tuple[object, str, int, bool]] = [(document, "$", 0, False)]
    while left:
        value, path, depth, free = left.pop()
        if depth > toml.MAX_DEPTH:
            yield Finding("$", f"nested more than {toml.MAX_DEPTH} deep; a spec needs three levels")
        elif isinstance(value, dict) and any(len(key) > toml.MAX_KEY for key in value):
            yield Finding(path, f"a key of more than {toml.MAX_KEY} characters")
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
            yield Finding(path, f"out of all proportion; between {SMALLEST:g} and {LARGEST:g} is "
                                "right", (value,))


def _find_misshapen(document: dict[str, Any]) -> Iterator[Finding]:
    """Find by hand what msgspec gives no path for that ends in the key of a dict."""
    for key, value in document.items():
        if key not in _fields(SystemSpec):
            yield _unknown_field(f"$.{key}", _fields(SystemSpec), value, is_top=True)
    for key, most in MAX_ROWS.items():
        rows = document.get(key, ())
        if isinstance(rows, list | dict) and len(rows) > most:
            yield Finding(f"$.{key}", f"{len(rows)} of them; at most {most} are right")
    orders = document.get("orders", {})
    if not isinstance(orders, dict):
        yield Finding("$.orders", "expected a table of orders", (orders,))
        return
    for name, relation in orders.items():
        if not isinstance(relation, dict):
            yield Finding(f"$.orders.{name}", "expected a table, recovery = [recoveries that it is "
                          "above]", (relation,))
            return
        for upper, lowers in relation.items():
            if not isinstance(lowers, list) or not all(isinstance(x, str) for x in lowers):
                yield Finding(f"$.orders.{name}.{upper}", "expected a list of recovery names",
                              (lowers,))


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


def _explain(error: str, document: dict[str, Any],
             tables: Mapping[str, type[Table]] = TABLES, text: str = "") -> Finding:
    """Turn msgspec's words into ours: add the value, and what is known where names are wrong."""
    # A problem may quote a key of the file, the path at the end cannot.
    found = re.fullmatch(r"(?s)(.*) - at `([^`]*)`", error)
    problem, path = (found[1], found[2]) if found else (error, "$")
    steps = re.findall(r"\w+", path)
    value: Any = document
    for step in steps:
        value = value[int(step)] if isinstance(value, list) else value[step]
    words = [step for step in steps if not step.isdigit()]
    table, field = ([""] * 2 + words)[-2:]

    missing = re.search(r"missing required field `(\w+)`", problem)
    if missing:
        return Finding(path, f"required field {missing[1]!r} is missing")
    if "unknown field `" in problem:
        known = _fields(tables[field])
        key = next(key for key in value if key not in known)
        return _unknown_field(f"{path}.{key}", known, value[key], is_top=not field)
    if (table, field) in ENUMS:
        known = [member.value for member in ENUMS[table, field]]
        problem = f"unknown {field}; known: {', '.join(known)}"
        if field == "against":
            problem += ", or { within_s = ..., hazard = '...' }"
    elif field == "gate":
        problem = "unknown gate; known: 'or', 'and', { at_least = k }"
    elif "regex" in problem and (table, field) == ("fault", "name"):
        problem = "expected a name: a small letter, then small letters, digits and hyphens"
    elif "regex" in problem and field in {"actor", "stand_in"}:
        problem = "expected 'module:Class', e.g. 'rampart.actors.operator.hmi:Hmi'"
    elif "regex" in problem and text:
        problem = text
    elif "regex" in problem:
        problem = "expected a name: a letter, then letters, digits and underscores"
    return Finding(path, problem.replace("`", ""), (value,))


def _fields(table: type[Table]) -> list[str]:
    return [field.encode_name for field in msgspec.structs.fields(table)]


def _unknown_field(path: str, known: Iterable[str], value: object, *, is_top: bool) -> Finding:
    return Finding(path, f"unknown field; known: {', '.join(known)}" + (
        "; what an application is told stands in [application]" if is_top else ""), (value,))
