"""Changing the mechanisms of a system while it runs.

A change is applied to the document that the system was read from, and the result is checked like
a fresh spec, whole: so nothing can be changed into a system that would have been refused at load.
Document in, document out: a change is never seen half-applied.
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
    """What a change does."""

    ENABLE = "enable"
    DISABLE = "disable"
    RETUNE = "retune"
    REPLACE = "replace"
    SET = "set"


CHANGEABLE: dict[str, type[Table]] = {
    "detection": DetectionSpec, "recovery": RecoverySpec, "mechanism": MechanismSpec}
"""Tables whose rows can be enabled, disabled, retuned and replaced, by name."""

SETTINGS = ("strategy", "shadow", "order")
"""Values that can be set."""


class Change(msgspec.Struct, frozen=True):
    """One change.

    Attributes:
        action: See `Action`.
        name: Of a detection module, a recovery module or a mechanism; with `set` one of
            `SETTINGS`.
        values: With `retune` the fields to change, where a name that is no field of the table is
            one of its parameters; with `replace` the whole new table but for its name; with `set`
            the new value under the key `value`.
    """

    action: Action
    name: str
    values: dict[str, Any] = {}


class ChangeError(ValueError):
    """A change that cannot be made. The message is one line."""


def adapt(document: Document, change: Change, file: str) -> tuple[Document, SystemSpec]:
    """Apply a change.

    Args:
        document: Of the running system, as TOML reads it; it is not touched.
        change: What to change.
        file: Name of the system's file, for messages.

    Returns:
        The new document, and the system it describes.

    Raises:
        ChangeError: There is no such thing to change.
        SpecificationError: The changed system would make no sense.
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
    """Say in a few words what a change does."""
    values = ", ".join(f"{key} = {value!r}" for key, value in change.values.items())
    if change.action is Action.SET:
        return f"set {change.name} to {change.values.get('value')!r}"
    return f"{change.action} {change.name}" + (f": {values}" if values else "")


def parse_value(text: str) -> Any:
    """Read a value as TOML writes it; a bare word is taken for a string.

    Raises:
        ChangeError: It is neither.
    """
    try:
        return toml.parse(f"value = {text}")["value"]
    except FileError:
        if text and all(c.isalnum() or c in "_-./ :()," for c in text):
            return text
        raise ChangeError(f"{shown(text)}: expected a TOML value, e.g. 0.5, true, 'text' or [1, 2]"
                          ) from None


def changed_actors(before: SystemSpec, after: SystemSpec) -> tuple[str, ...]:
    """Return the detection and recovery modules whose processes have to be started anew."""
    was = {node.name: node for node in before.actors()}
    return tuple(node.name for node in after.actors()
                 if node.name in was and (node.actor, node.parameters) != (
                     was[node.name].actor, was[node.name].parameters))


def _find(document: Document, name: str) -> tuple[str, dict[str, Any]]:
    rows = [(table, row) for table in CHANGEABLE for row in document.get(table, ())]
    found = next((one for one in rows if one[1].get("name") == name), None)
    if found is None:
        known = ", ".join(str(row.get("name")) for _, row in rows)
        raise ChangeError(f"unknown detection module, recovery module or mechanism {name!r}; "
                          f"known: {known}")
    return found


def _retune(table: str, row: dict[str, Any], change: Change) -> None:
    if not change.values:
        raise ChangeError(f"retune {change.name}: nothing to change; name fields and values")
    known = [field.encode_name for field in msgspec.structs.fields(CHANGEABLE[table])]
    for key, value in change.values.items():
        if key == "name":
            raise ChangeError(f"name = {value!r}: a name cannot be changed")
        if key == "parameters" and key in known and not isinstance(value, dict):
            raise ChangeError(f"parameters = {value!r}: must be a table of names and values")
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
        raise ChangeError(f"set {change.name}: the value is missing")
    document[change.name] = change.values["value"]

