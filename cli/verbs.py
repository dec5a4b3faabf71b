"""How a verb is declared: by its function, whose docstring has the help text, and its options.

The first paragraph of such a docstring is for readers of the code. What follows is printed by
`--help`: the description, and below `Examples:` what stands at the end.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import inspect
import os
from collections.abc import Callable, Coroutine, Iterable
from types import ModuleType
from typing import Any

from rampart.cli.output import UsageError

FORMATTER = argparse.RawDescriptionHelpFormatter

Run = Callable[[argparse.Namespace], int | Coroutine[Any, Any, int]]
"""Does what a verb is for, and returns the exit code."""

Completer = Callable[..., list[str]]
"""Returns what can be typed; argcomplete calls it with the options so far, by name."""

Option = Callable[[argparse._ActionsContainer], object]
"""Adds itself to a parser, or to a group of one."""


def option(*names: str, completer: Completer | None = None, **fields: Any) -> Option:
    """Return an option or argument.

    Args:
        names: as of `add_argument` of argparse.
        completer: what the shell offers for it, see `rampart.cli.completion`.
        fields: as of `add_argument`.
    """
    def add(parser: argparse._ActionsContainer) -> object:
        action: Any = parser.add_argument(*names, **fields)
        if completer is not None:
            action.completer = completer
        return action

    return add


def flag(name: str, text: str) -> Option:
    """Return an option without a value."""
    return option(name, action="store_true", help=text)


def word(name: str, metavar: str, text: str, default: str | None = None) -> Option:
    """Return an option with a text as its value."""
    return option(name, metavar=metavar, default=default, help=text)


def several(name: str, metavar: str, text: str, completer: Completer | None = None) -> Option:
    """Return an option that may be repeated; its value is a list of texts."""
    return option(name, action="append", default=[], metavar=metavar, help=text,
                  completer=completer)


def number(name: str, metavar: str, text: str, default: float | None = None) -> Option:
    """Return an option with a number as its value."""
    return option(name, type=float, metavar=metavar, default=default, help=text)


def whole(name: str, metavar: str, text: str, default: int | None = None) -> Option:
    """Return an option with a whole number as its value."""
    return option(name, type=int, metavar=metavar, default=default, help=text)


def group(title: str, *options: Option) -> Option:
    """Return options that stand under a title of their own in the help."""
    return lambda parser: add_options(parser.add_argument_group(title), options)


def either(*options: Option) -> Option:
    """Return options of which one at most may be given."""
    return lambda parser: add_options(parser.add_mutually_exclusive_group(), options)


def add_options(parser: argparse._ActionsContainer, options: Iterable[Option]) -> None:
    """Add options to a parser, or to a group of one."""
    for add in options:
        add(parser)


PORT_VARIABLE = "RAMPART_PORT"
_PORT_DIGITS = 5
_WHICH_RUN = ("base port of the run, if this machine has several (default: the variable "
              f"{PORT_VARIABLE})")


def port_of_environment() -> int | None:
    """Return the base port that the environment names, None if none.

    Raises:
        UsageError: it is none.
    """
    said = os.environ.get(PORT_VARIABLE, "")
    if said and not (said.isascii() and said.isdecimal() and len(said) <= _PORT_DIGITS):
        raise UsageError(f"{PORT_VARIABLE}={said}: a whole number is right, the base port of a run")
    return int(said) if said else None


def port_option(name: str, text: str, otherwise: int | None = None, **fields: Any) -> Option:
    """Return an option with a base port as its value; the default is what the environment says."""
    def add(parser: argparse._ActionsContainer) -> object:
        return parser.add_argument(name, type=int, help=text, **fields,
                                   default=port_of_environment() or otherwise)

    return add


PORT = port_option("--port", _WHICH_RUN, metavar="N")
JSON = flag("--json", "print JSON")
JSON_FORMAT = option("--json", action="store_const", dest="format", const="json",
                     help="same as --format json")


def served(port: int, what: str) -> tuple[Option, ...]:
    """Return the options of a verb that serves what it hears of a run.

    Args:
        port: where it is served unless told otherwise.
        what: can be done by whoever reaches it.
    """
    return (
        whole("--port", "N", f"port to serve on (default: {port})", port),
        word("--host", "ADDRESS", "address to serve on (default: 127.0.0.1); any client that "
             f"reaches it may {what}", "127.0.0.1"),
        port_option("--run", _WHICH_RUN, dest="of", metavar="N"))


def add_verb(verbs: Any, name: str, text: str, run: Run, *options: Option, doc: str = "",
             hidden: bool = False) -> None:
    """Add a verb to the command line.

    Args:
        verbs: the subparsers of `rampart`, or of a family.
        name: as it is typed.
        text: in the list of verbs.
        run: the verb's function, a coroutine function or not.
        options: those of the verb, as the help lists them.
        doc: with the help text; the function's docstring if it is empty.
        hidden: not in the list of verbs: an old name.
    """
    def call(given: argparse.Namespace) -> int:
        done = run(given)
        return done if isinstance(done, int) else asyncio.run(done)

    listed = {} if hidden else {"help": text}
    parser = verbs.add_parser(name, **listed, **help_of(doc or run.__doc__ or ""))
    add_options(parser, options)
    parser.set_defaults(run=call)


def add_family(verbs: Any, name: str, text: str, doc: str, *, dest: str = "subverb",
               metavar: str = "VERB") -> Any:
    """Add a verb that has verbs of its own, and return its subparsers.

    Args:
        verbs: the subparsers of `rampart`.
        name: as it is typed.
        text: in the list of verbs.
        doc: docstring with the help text.
        dest: where the choice is found in the options.
        metavar: stands for the choice in the help.
    """
    parser = verbs.add_parser(name, help=text, **help_of(doc))
    return parser.add_subparsers(dest=dest, required=True, metavar=metavar)


def help_of(doc: str) -> dict[str, Any]:
    """Return what a parser is told of the help in a docstring."""
    _, _, text = inspect.cleandoc(doc).partition("\n\n")
    description, _, examples = text.partition("\n\nExamples:\n")
    return {"formatter_class": FORMATTER, "description": description,
            "epilog": f"examples:\n{examples}"}


def extra(name: str, module: str) -> ModuleType:
    """Return a module of an extra, a library that is no part of the base install.

    Raises:
        UsageError: the extra is not installed; the line says how to.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"this needs the extra {name!r}, which is not installed ({error}); "
                         f"install it with: pip install 'rampart-robot[{name}]'") from None
