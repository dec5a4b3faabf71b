"""Options of the command line that the application of a system adds."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import msgspec

from rampart.actors.run.application import Application
from rampart.cli.output import UsageError


def add(parser: argparse.ArgumentParser, kind: type[Application], said: Mapping[str, Any]) -> None:
    """Add an option for each field of an application's options.

    Args:
        parser: of the command.
        kind: the application.
        said: what the system's spec chooses, for the help.
    """
    fields = msgspec.structs.fields(kind.Options)
    if not fields:
        return
    group = parser.add_argument_group(f"options of this system ({kind.__name__})")
    for field in fields:
        plain, meta = _parts(kind, field.name)
        extra = meta.extra or {}
        default = said.get(field.name, field.default)
        shown = "" if default in ("", msgspec.NODEFAULT) else f" (default: {default})"
        more = {"nargs": "?", "const": extra["alone"]} if "alone" in extra else {}
        group.add_argument(
            f"--{field.name.replace('_', '-')}", dest=f"application_{field.name}", default=None,
            metavar=extra.get("metavar", field.name.upper()),
            type=plain if plain in {int, float} else str,
            help=(meta.description or "") + shown, **more)


def chosen(options: argparse.Namespace, kind: type[Application]) -> dict[str, Any]:
    """Return what was given on the command line; files as paths that every process finds.

    Raises:
        UsageError: a value is not what its field takes.
    """
    found: dict[str, Any] = {}
    for field in msgspec.structs.fields(kind.Options):
        value = getattr(options, f"application_{field.name}", None)
        if value is None:
            continue
        try:
            msgspec.convert(value, field.type)
        except msgspec.ValidationError as error:
            raise UsageError(f"--{field.name.replace('_', '-')} {value}: {error}") from None
        extra = _parts(kind, field.name)[1].extra or {}
        if extra.get("file") and Path(value).exists():
            value = str(Path(value).resolve())
        found[field.name] = value
    return found


def _parts(kind: type[Application], name: str) -> tuple[Any, msgspec.Meta]:
    """Return the plain type of a field and what is said of it."""
    hint = get_type_hints(kind.Options, include_extras=True)[name]
    if get_origin(hint) is not Annotated:
        return hint, msgspec.Meta()
    plain, *said = get_args(hint)
    return plain, next((s for s in said if isinstance(s, msgspec.Meta)), msgspec.Meta())
