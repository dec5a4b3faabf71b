"""Output of the verbs: errors, tables, JSON."""

from __future__ import annotations

import contextlib
import difflib
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from rampart.files.plain_text import one_line, printable
from rampart.files.reading import FileError

_WARNING_CHARS = 4000


class UsageError(ValueError):
    """The request cannot be fulfilled; one line. Exit code 2, as for every `ValueError`."""


class NoEffectError(Exception):
    """The request had no effect; one line. Exit code 1."""


FORMAT = 1
"""Number in every JSON object that a verb prints; it grows when a field changes its meaning.

See docs/reference/json.md.
"""

_LISTED = 12
_NEAREST = 3


def unknown(what: str, value: str, known: Iterable[str]) -> UsageError:
    """Return the error of an unknown name, with the known names, or the nearest of many."""
    names = list(known)
    if len(names) <= _LISTED:
        return UsageError(f"unknown {what} {value!r}; known: {', '.join(names) or 'none'}")
    near = difflib.get_close_matches(value, names, _NEAREST, 0.4)
    return UsageError(f"unknown {what} {value!r}; " + (
        f"the nearest of {len(names)}: {', '.join(near)}" if near else
        f"none of {len(names)} is similar"))


@contextlib.contextmanager
def refusing(*kinds: type[Exception]) -> Iterator[None]:
    """Turn errors of some kinds into a `UsageError` with the same text.

    Raises:
        UsageError: instead of an error of these kinds.
    """
    try:
        yield
    except kinds as error:
        raise UsageError(str(error)) from None


@contextlib.contextmanager
def using(file: object, *kinds: type[Exception]) -> Iterator[None]:
    """Turn errors of a file, and others of some kinds, into a `UsageError` with its name.

    Raises:
        UsageError: instead of an error of the operating system, or of the contents.
    """
    refused: tuple[type[Exception], ...] = (FileError, *kinds)
    try:
        yield
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror}") from None
    except refused as error:
        raise UsageError(f"{file}: {error}") from None


def positive(option: str, value: float | None, why: str = "must be above 0",
             below: float | None = None) -> None:
    """Refuse a value that is not above 0, or not below another."""
    if value is not None and not (value > 0 and (below is None or value < below)):
        raise UsageError(f"{option} {value:g}: {why}")


def between(option: str, value: float, least: float, most: float, why: str = "") -> None:
    """Refuse a value that is not within bounds."""
    if not least <= value <= most:
        shown = f"{value:g}" if isinstance(value, float) else value
        raise UsageError(f"{option} {shown}: must be between {least} and {most}{why}")


def say(text: str = "") -> None:
    """Print one line at once; text of others in it cannot break it in two."""
    print(printable(text), flush=True)


def say_text(text: str) -> None:
    """Print a text of several lines."""
    print(printable(text, keep="\n"), flush=True)


def warn(text: str) -> None:
    """Print a line on stderr."""
    print(f"rampart: {one_line(text, _WARNING_CHARS)}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the present step in one line of a terminal.

    The line is cleared at the end.
    """
    def show(text: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\x1b[K{text[:100]}", end="", file=sys.stderr, flush=True)

    try:
        yield show
    finally:
        show("")


def rendered(template: Path, **values: Any) -> str:
    """Return a filled-in Jinja template, with numbers in their shortest form.

    Args:
        template: file of the template.
        values: values by name.
    """
    import jinja2  # noqa: PLC0415 few verbs need it

    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent),
        autoescape=False,  # noqa: S701 Markdown needs no escapes
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        finalize=lambda value: f"{value:g}" if isinstance(value, float) else value)
    return pages.get_template(template.name).render(values)


def print_json(data: Any, *, indent: bool = True, names: bool = False) -> None:
    """Print data as JSON; NaN and infinity become null.

    Args:
        data: a struct or dictionary is printed with `format` as its first field.
        indent: print several lines.
        names: the keys are user data, so no `format` field is added.
    """
    if isinstance(data, msgspec.Struct) and not data.__struct_config__.array_like:
        data = msgspec.to_builtins(data)
    if isinstance(data, dict) and not names:
        data = {"format": FORMAT, **data}
    text = msgspec.json.encode(data)
    say_text((msgspec.json.format(text, indent=2) if indent else text).decode())


def print_rows(head: Sequence[str], rows: Sequence[Sequence[Any]], data: Any, *, as_json: bool
               ) -> None:
    """Print rows as a table, or with --json the data that they show."""
    if as_json:
        print_json(data)
    else:
        print_table(head, rows)


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows in aligned columns, numbers to the right and with two decimals at most."""
    table = [[printable(str(round(cell, 2) if isinstance(cell, float) else cell)) for cell in row]
             for row in (head, *rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(head))]
    right = [bool(rows) and all(isinstance(row[i], (int, float)) for row in rows)
             for i in range(len(head))]
    for line in table:
        cells = [cell.rjust(width) if number else cell.ljust(width)
                 for cell, width, number in zip(line, widths, right, strict=True)]
        say("  ".join(cells).rstrip())
