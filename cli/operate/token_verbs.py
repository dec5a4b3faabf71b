"""`rampart tokens`: personal tokens of the operator's page.

Issue personal tokens for the operator's page, each with a role. Role look can only
watch. Role drive can also drive, order missions and reset recoveries. Role inject
can also inject faults, kill processes and change the strategy. The file contains
names, roles and a digest of each token. `rampart run --hmi-token-file` uses it, and
notices a change within a second.

Examples:
  rampart tokens issue anna --role drive
  rampart tokens show
  rampart tokens revoke anna
  rampart run --hmi-token-file page.tokens
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rampart.actors.web.visitors import (
    Role,
    SecretError,
    VisitorError,
    check_name,
    check_role,
    issue,
    read_visitors,
    revoke,
)
from rampart.cli.output import print_rows, say, using
from rampart.cli.verbs import JSON, add_family, add_verb, option, word

FILE = "page.tokens"

_FILE = word("--file", "FILE", f"file of the tokens (default: {FILE})", FILE)
_NAME = option("name", metavar="NAME", help="name of the person: letters, digits, and _ . @ -")


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    tokens = add_family(verbs, "tokens", "issue and revoke tokens for the page", __doc__)
    add_verb(tokens, "issue", "issue a token", issue_token, _NAME,
             option("--role", metavar="ROLE", required=True, help=", ".join(Role)), _FILE)
    add_verb(tokens, "show", "list names and roles", show_tokens, _FILE, JSON)
    add_verb(tokens, "revoke", "revoke a token", revoke_token, _NAME, _FILE)


def issue_token(options: argparse.Namespace) -> int:
    """Print a new token.

    Issue a token and print it. It is stored nowhere, so it is shown only once.
    Standard output is the token alone.

    Examples:
      rampart tokens issue anna --role drive
      rampart tokens issue control-room --role look --file /etc/rampart/page.tokens
    """
    with using("--role", VisitorError):
        role = check_role(options.role)
    with using(options.file, VisitorError, SecretError):
        check_name(options.name)
        say(issue(Path(options.file), options.name, role))
    return 0


def show_tokens(options: argparse.Namespace) -> int:
    """Print the holders of tokens.

    List the names that have a token, and their roles.

    Examples:
      rampart tokens show
      rampart tokens show --json
    """
    with using(options.file, VisitorError, SecretError):
        visitors = read_visitors(Path(options.file)).values()
    print_rows(("name", "role"), [(v.name, v.role) for v in visitors],
               [{"name": v.name, "role": v.role} for v in visitors], as_json=options.json)
    return 0


def revoke_token(options: argparse.Namespace) -> int:
    """Revoke a token.

    Revoke the token of a name. A run that uses the file closes that person's
    pages within a second.

    Examples:
      rampart tokens revoke anna
    """
    with using(options.file, VisitorError, SecretError):
        revoke(Path(options.file), options.name)
    say(f"revoked the token of {options.name}")
    return 0
