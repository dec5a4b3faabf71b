"""`rampart tokens`: who may use the operator's page, and as what.

Give people tokens of their own for the operator's page, each with a role:
look sees everything, drive may drive, order missions and reset recoveries,
inject may also inject faults, kill processes and change the strategy. The file
keeps who has which role, and of each token a digest alone; a run takes it with
--hmi-token-file, and notices within a second that it has changed.

Examples:
  rampart tokens issue anna --role drive
  rampart tokens show
  rampart tokens revoke anna
  launch.py --hmi-token-file page.tokens
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rampart.actors.web.token_file import SecretError
from rampart.actors.web.visitors import (
    Role,
    VisitorError,
    check_name,
    check_role,
    issue,
    read_visitors,
    revoke,
)
from rampart.cli.output import UsageError, print_json, print_table, say
from rampart.cli.verbs import JSON, add_family, add_verb, option, word

FILE = "page.tokens"

_FILE = word("--file", "FILE", f"where they are kept (default: {FILE})", FILE)
_NAME = option("name", metavar="NAME", help="who it is: letters, digits, and _ . @ -")


def add(verbs: Any) -> None:
    """Add the verbs to the parser."""
    tokens = add_family(verbs, "tokens", "who may use the operator's page", __doc__)
    add_verb(tokens, "issue", "make a token for somebody", issue_token, _NAME,
             option("--role", metavar="ROLE", required=True, help=", ".join(Role)), _FILE)
    add_verb(tokens, "show", "who has one", show_tokens, _FILE, JSON)
    add_verb(tokens, "revoke", "withdraw somebody's token", revoke_token, _NAME, _FILE)


def issue_token(options: argparse.Namespace) -> int:
    """Print a new token.

    Print a new token for somebody, once: it is kept nowhere. Standard output is
    the token alone.

    Examples:
      rampart tokens issue anna --role drive
      rampart tokens issue control-room --role look --file /etc/rampart/page.tokens
    """
    file = Path(options.file)
    try:
        role = check_role(options.role)
    except VisitorError as error:
        raise UsageError(f"--role: {error}") from None
    try:
        check_name(options.name)
        token = issue(file, options.name, role)
    except (VisitorError, SecretError) as error:
        raise UsageError(f"{file}: {error}") from None
    except OSError as error:
        raise UsageError(f"{file}: cannot be written ({error.strerror})") from None
    say(token)
    return 0


def show_tokens(options: argparse.Namespace) -> int:
    """Print who has a token.

    List who has a token, and their roles.

    Examples:
      rampart tokens show
      rampart tokens show --json
    """
    visitors = _read(Path(options.file)).values()
    if options.json:
        print_json([{"name": v.name, "role": v.role} for v in visitors])
    else:
        print_table(["name", "role"], [[v.name, v.role] for v in visitors])
    return 0


def revoke_token(options: argparse.Namespace) -> int:
    """Withdraw a token.

    Withdraw somebody's token. A run that takes the file closes their pages
    within a second.

    Examples:
      rampart tokens revoke anna
    """
    file = Path(options.file)
    try:
        revoke(file, options.name)
    except (VisitorError, SecretError) as error:
        raise UsageError(f"{file}: {error}") from None
    except OSError as error:
        raise UsageError(f"{file}: cannot be written ({error.strerror})") from None
    say(f"{options.name} has no token any more")
    return 0


def _read(file: Path) -> dict[str, Any]:
    try:
        return read_visitors(file)
    except (VisitorError, SecretError) as error:
        raise UsageError(f"{file}: {error}") from None
