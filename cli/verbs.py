"""Declaration of verbs: a function, whose docstring has the help text, and options.

The first paragraph of such a docstring is for readers of the code. `--help` prints the rest as the
description, and the part below `Examples:` as the epilogue.
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
"""The function of a verb; it returns the exit code."""

Completer = Callable[..., list[str]]
"""Returns the possible values; argcomplete calls it with the options so far, by name."""

Option = Callable[[argparse._ActionsContainer], object]
"""Adds itself to a parser, or to a group of one."""


def option(*names: str, completer: Completer | None = None, **fields: Any) -> Option:
    """Return an option or argument.

    Args:
        names: as in `add_argument` of argparse.
        completer: see `rampart.cli.completion`.
        fields: as in `add_argument`.
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
    """Return options with a common title in the help."""
    return lambda parser: add_options(parser.add_argument_group(title), options)


def either(*options: Option) -> Option:
    """Return mutually exclusive options."""
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
    """Return the base port of the environment, if any.

    Raises:
        UsageError: it is not a port.
    """
    port = os.environ.get(PORT_VARIABLE, "")
    if port and not (port.isascii() and port.isdecimal() and len(port) <= _PORT_DIGITS):
        raise UsageError(f"{PORT_VARIABLE}={port}: expected a whole number, the base port of a run")
    return int(port) if port else None


def port_option(name: str, text: str, otherwise: int | None = None, **fields: Any) -> Option:
    """Return an option with a base port as its value; the default is that of the environment."""
    def add(parser: argparse._ActionsContainer) -> object:
        return parser.add_argument(name, type=int, help=text, **fields,
                                   default=port_of_environment() or otherwise)

    return add


PORT = port_option("--port", _WHICH_RUN, metavar="N")
JSON = flag("--json", "print JSON")


def served(port: int, what: str) -> tuple[Option, ...]:
    """Return the options of a verb that serves data of a run.

    Args:
        port: default port to serve on.
        what: the right of every client that reaches the port.
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
        name: name of the verb.
        text: line in the list of verbs.
        run: the verb's function, a coroutine function or not.
        options: options of the verb in the order of the help.
        doc: docstring with the help text; that of the function if empty.
        hidden: leave an old name out of the list of verbs.
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
    """Add a family of verbs, and return its subparsers.

    Args:
        verbs: the subparsers of `rampart`.
        name: name of the family.
        text: line in the list of verbs.
        doc: docstring with the help text.
        dest: option that holds the name of the chosen verb.
        metavar: name of this choice in the help.
    """
    parser = verbs.add_parser(name, help=text, **help_of(doc))
    return parser.add_subparsers(dest=dest, required=True, metavar=metavar)


def help_of(doc: str) -> dict[str, Any]:
    """Return the arguments of a parser that print the help text of a docstring."""
    _, _, text = inspect.cleandoc(doc).partition("\n\n")
    description, _, examples = text.partition("\n\nExamples:\n")
    return {"formatter_class": FORMATTER, "description": description,
            "epilog": f"examples:\n{examples}"}


def extra(name: str, *modules: str) -> ModuleType:
    """Import modules of an extra, which the base install lacks, and return the last.

    Raises:
        UsageError: the extra is not installed.
    """
    try:
        return [importlib.import_module(module) for module in modules][-1]
    except ImportError as error:
        raise UsageError(f"this needs the extra {name!r}, which is not installed ({error}); "
                         f"install it with: pip install 'rampart-robot[{name}]'") from None
