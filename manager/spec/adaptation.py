"""Changes the mechanisms of a running system.

A change is applied to a copy of the system's document, and the result is checked as at load. So no
change leads to a system that would have been refused at its start, and none is half applied.
"""

from __future__ import annotations

import copy
from enum import StrEnum
from typing import Any

import msgspec

from rampart.files import toml
from rampart.files.plain_text import shown
from rampart.files.reading import FileError
from rampart.manager.spec.schema import DetectionSpec, MechanismSpec, RecoverySpec, SystemSpec
from rampart.manager.spec.specification import check_document
from rampart.manager.spec.tables import Table

Document = dict[str, Any]


class Action(StrEnum):
    """Kind of a change."""

    ENABLE = "enable"
    DISABLE = "disable"
    RETUNE = "retune"
    REPLACE = "replace"
    SET = "set"


CHANGEABLE: dict[str, type[Table]] = {
    "detection": DetectionSpec, "recovery": RecoverySpec, "mechanism": MechanismSpec}
"""Tables whose rows can be enabled, disabled, retuned and replaced, by name."""

SETTINGS = ("strategy", "shadow", "order")
"""Fields of the system that can be set."""


class Change(msgspec.Struct, frozen=True):
    """One change.

    Attributes:
        action: See `Action`.
        name: Name of a detection module, a recovery module or a mechanism; with `set` one of
            `SETTINGS`.
        values: With `retune`, the fields to change; a name that is not a field of the table is a
            parameter. With `replace`, the whole new table without its name. With `set`, the new
            value under the key `value`.
    """

    action: Action
    name: str
    values: dict[str, Any] = {}


class ChangeError(ValueError):
    """A change that cannot be applied. The message is one line."""


def adapt(document: Document, change: Change, file: str) -> tuple[Document, SystemSpec]:
    """Return a changed copy of a document, and the system that it describes.

    Raises:
        ChangeError: The name or a value of the change is unknown or missing.
        SpecificationError: The changed system would be refused at load.
    """
    after = copy.deepcopy(document)
    match change.action:
        case Action.SET:
            _set(after, change)
        case Action.ENABLE | Action.DISABLE:
            _find(after, change.name)[1]["enabled"] = change.action is Action.ENABLE
        case Action.RETUNE:
            _retune(*_find(after, change.name), change)
        case Action.REPLACE:
            row = _find(after, change.name)[1]
            if change.values.get("name", change.name) != change.name:
                raise ChangeError(f"name = {change.values['name']!r}: a replacement keeps the "
                                  f"name, {change.name!r}")
            row.clear()
            row.update({"name": change.name, **change.values})
    return after, check_document(after, file)


def describe(change: Change) -> str:
    """Return a change in a few words."""
    values = ", ".join(f"{key} = {value!r}" for key, value in change.values.items())
    if change.action is Action.SET:
        return f"set {change.name} to {change.values.get('value')!r}"
    return f"{change.action} {change.name}" + (f": {values}" if values else "")


def parse_value(text: str) -> Any:
    """Read a TOML value; a bare word counts as a string.

    Raises:
        ChangeError: The text is neither.
    """
    try:
        return toml.parse(f"value = {text}")["value"]
    except FileError:
        if text and all(c.isalnum() or c in "_-./ :()," for c in text):
            return text
        raise ChangeError(f"{shown(text)}: expected a TOML value, e.g. 0.5, true, 'text' or [1, 2]"
                          ) from None


def changed_actors(before: SystemSpec, after: SystemSpec) -> tuple[str, ...]:
    """Return the modules whose processes have to be restarted."""
    old = {node.name: (node.actor, node.parameters) for node in before.actors()}
    return tuple(node.name for node in after.actors()
                 if (node.actor, node.parameters) != old.get(node.name))


def _find(document: Document, name: str) -> tuple[str, dict[str, Any]]:
    rows = [(table, row) for table in CHANGEABLE for row in document.get(table, ())]
    found = next((found for found in rows if found[1].get("name") == name), None)
    if found is None:
        known = ", ".join(str(row.get("name")) for _, row in rows)
        raise ChangeError(f"unknown detection module, recovery module or mechanism {name!r}; "
                          f"known: {known}")
    return found


def _retune(table: str, row: dict[str, Any], change: Change) -> None:
    if not change.values:
        raise ChangeError(f"retune {change.name}: expected fields and their new values")
    known = [field.encode_name for field in msgspec.structs.fields(CHANGEABLE[table])]
    for key, value in change.values.items():
        if key == "name":
            raise ChangeError(f"name = {value!r}: a name cannot be changed")
        if key == "parameters" and key in known and not isinstance(value, dict):
            raise ChangeError(f"parameters = {value!r}: expected a table")
        if key in known:
            row[key] = value
        elif "parameters" in known:
            row.setdefault("parameters", {})[key] = value
        else:
            raise ChangeError(f"{key} = {value!r}: unknown field of a {table}; known: "
                              f"{', '.join(k for k in known if k != 'name')}")


def _set(document: Document, change: Change) -> None:
    if change.name not in SETTINGS:
        raise ChangeError(f"unknown setting {change.name!r}; known: {', '.join(SETTINGS)}")
    if "value" not in change.values:
        raise ChangeError(f"set {change.name}: expected a value")
    document[change.name] = change.values["value"]

