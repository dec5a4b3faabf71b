"""Options that the application of a system adds to the command line."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, get_type_hints

import msgspec

from rampart.actors.runtime.application import Application
from rampart.cli.output import UsageError


def add(parser: argparse.ArgumentParser, kind: type[Application], chosen: Mapping[str, Any], *,
        crossed: bool = False) -> None:
    """Add an option for each field of an application's options.

    Args:
        parser: parser of the command.
        kind: the application.
        chosen: values of the specification, for the help.
        crossed: the command makes many runs in virtual time, and takes several values of each.
    """
    fields = msgspec.structs.fields(kind.Options)
    if not fields:
        return
    group = parser.add_argument_group(f"options of this system ({kind.__name__})")
    for field in fields:
        extra = _described(kind, field.name)
        default = chosen.get(field.name, field.default)
        if crossed:
            default = extra.get("campaign", default)
        shown = "" if default in ("", msgspec.NODEFAULT) else f" (default: {default})"
        metavar = extra.get("metavar", field.name.upper())
        group.add_argument(
            f"--{field.name.replace('_', '-')}", dest=f"application_{field.name}",
            default=extra.get("campaign") if crossed else None,
            metavar=f"{metavar},..." if crossed else metavar,
            help=extra.get("description", "") + shown)


def chosen(options: argparse.Namespace, kind: type[Application]) -> dict[str, Any]:
    """Return the given options, with absolute paths of files.

    Raises:
        UsageError: a field does not accept a value.
    """
    return {field.name: _value(kind, field, value)
            for field in msgspec.structs.fields(kind.Options)
            if (value := getattr(options, f"application_{field.name}", None)) is not None}


def alternatives(options: argparse.Namespace, kind: type[Application]) -> list[dict[str, Any]]:
    """Return all combinations of the values, which are separated by commas.

    Raises:
        UsageError: a field does not accept a value.
    """
    found: dict[str, list[Any]] = {}
    for field in msgspec.structs.fields(kind.Options):
        given = getattr(options, f"application_{field.name}", None)
        if given is not None:
            found[field.name] = [_value(kind, field, value) for value in given.split(",")]
    return [dict(zip(found, values, strict=True)) for values in product(*found.values())]


def _value(kind: type[Application], field: msgspec.structs.FieldInfo, text: str) -> Any:
    try:
        value = msgspec.to_builtins(msgspec.convert(text, field.type, strict=False))
    except msgspec.ValidationError as error:
        raise UsageError(f"--{field.name.replace('_', '-')} {text}: {error}") from None
    if _described(kind, field.name).get("file") and Path(text).exists():
        return str(Path(text).resolve())
    return value


def _described(kind: type[Application], name: str) -> dict[str, Any]:
    """Return the `extra` of the `Meta` of a field, with its `description`."""
    hint = get_type_hints(kind.Options, include_extras=True)[name]
    meta = next((note for note in getattr(hint, "__metadata__", ())
                 if isinstance(note, msgspec.Meta)), msgspec.Meta())
    return {"description": meta.description or "", **(meta.extra or {})}
