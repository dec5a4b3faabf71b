"""Options of the operator's page: address, tokens, encryption.

They are checked before a process starts. A page that cannot be served, or that would be open to
strangers, is refused in one line.
"""

from __future__ import annotations

import argparse
import os
import secrets
import socket
from collections.abc import Callable
from pathlib import Path

import msgspec

from rampart.actors.web.access import (
    ANY,
    Access,
    AccessError,
    PagePlan,
    check_token,
    is_loopback,
    new_token,
)
from rampart.actors.web.listening import PortError, listen
from rampart.actors.web.tls import Certificate, TlsError, days_left, holds_key, load
from rampart.actors.web.token_file import SecretError, read_secret
from rampart.actors.web.visitors import VisitorError, lists_visitors, read_visitors
from rampart.cli.output import UsageError
from rampart.cli.verbs import flag, option, whole, word

TOKEN_VARIABLE = "RAMPART_HMI_TOKEN"  # noqa: S105 a name

NAMES = ("hmi_port", "hmi_host", "hmi_token_file", "hmi_cert", "hmi_key", "hmi_unencrypted",
         "hmi_behind")

_SOON_DAYS = 7.0
"""Days before its expiry from which a certificate causes a note."""

OPTIONS = (
    whole("--hmi-port", "PORT", "port of the operator's page (default: 8080)", 8080),
    word("--hmi-host", "HOST", "address of the operator's page (default: 127.0.0.1, this machine "
         "only). Any other address needs a certificate. The page then asks for the token that is "
         "printed at the start of the run", "127.0.0.1"),
    word("--hmi-cert", "FILE", "certificate chain of the page (PEM)", ""),
    word("--hmi-key", "FILE", "private key of the certificate (PEM, mode 0600; default: in the "
         "file of the certificate)", ""),
    flag("--hmi-unencrypted", "serve the page to other machines without encryption: anyone on "
         "that network can read the token and all data"),
    word("--hmi-behind", "ORIGIN", "origin at which a reverse proxy on this machine serves the "
         "page, as https://robot.example; the page asks for a token", ""),
    word("--hmi-token-file", "FILE", "file of mode 0600 with a token of 16 characters or more, or "
         f"the file of `rampart tokens`. The variable {TOKEN_VARIABLE} can hold a token, too "
         "(default: a random token; none on this machine)", ""),
    option("--hmi-token", nargs="?", const="", help=argparse.SUPPRESS))  # refused


def own_token(options: argparse.Namespace) -> str:
    """Return the token of the environment, and remove it there: no child process inherits it.

    Raises:
        UsageError: there is a token on the command line.
    """
    own = os.environ.pop(TOKEN_VARIABLE, "")
    if options.hmi_token is not None:
        raise UsageError("--hmi-token: every user of this machine can read a command line; put "
                         "another token into a file of mode 0600 for --hmi-token-file FILE, or "
                         f"into the variable {TOKEN_VARIABLE}")
    return own


def page_of(options: argparse.Namespace, own: str, note: Callable[[str], None]
            ) -> PagePlan:
    """Return address, tokens and encryption of the page.

    Tokens come from a file or the environment, because other users can read a command line. If a
    token is required and none is given, a random one is made.

    Args:
        options: options of the command line.
        own: token of the environment, "" without one.
        note: called with each warning.

    Raises:
        UsageError: options contradict each other, or the page cannot be served.
    """
    if options.no_hmi or options.virtual:
        if options.wait:
            raise UsageError("--wait: the operator's page starts the mission; not with "
                             f"--{'no-hmi' if options.no_hmi else 'virtual'}")
        return PagePlan(0 if options.no_hmi else options.hmi_port)
    host: str = options.hmi_host
    token, listed = _tokens(options, own)
    is_new = not (token or listed or (is_loopback(host) and not options.hmi_behind))
    if is_new:
        token = new_token()
    certificate = _certificate(options, note)
    try:
        Access(host, options.hmi_port, bool(token or listed), certificate is not None,
               options.hmi_unencrypted, behind=options.hmi_behind)
    except AccessError as error:
        which = f"--hmi-behind {options.hmi_behind}" if options.hmi_behind else f"--hmi-host {host}"
        raise UsageError(f"{which}: {error}") from None
    try:
        listen(host, options.hmi_port).close()
    except PortError as error:
        which = f"--hmi-port {options.hmi_port}" if error.is_taken else (
            f"--hmi-host {host}: expected an address of this machine, or 0.0.0.0 for all")
        raise UsageError(f"{which}: {error}") from None
    import rampart.actors.operator.server  # noqa: F401, PLC0415 before the fork, if there is a page

    return PagePlan(
        options.hmi_port, host, token, is_new, listed,
        cert=str(Path(options.hmi_cert).resolve()) if certificate else "",
        key=str(Path(options.hmi_key).resolve()) if certificate else "",
        unencrypted=options.hmi_unencrypted, secret=secrets.token_hex(32),
        shown=_shown(host, certificate), behind=options.hmi_behind)


def audited(page: PagePlan, file: Path) -> PagePlan:
    """Return the plan of the page with a file for its audit log, if there is a page."""
    return msgspec.structs.replace(page, audit_log=str(file)) if page.port else page


def _tokens(options: argparse.Namespace, own: str) -> tuple[str, str]:
    """Return the common token, or the path of a list of personal tokens."""
    source = TOKEN_VARIABLE
    try:
        if options.hmi_token_file:
            source = f"--hmi-token-file {options.hmi_token_file}"
            file = Path(options.hmi_token_file)
            if lists_visitors(file):
                if not read_visitors(file):
                    raise VisitorError("is empty; rampart tokens issue NAME --role ROLE --file "
                                       f"{file}")
                return "", str(file.resolve())
            own = read_secret(file)
        return (check_token(own) if own else ""), ""
    except (AccessError, SecretError, VisitorError) as error:
        raise UsageError(f"{source}: {error}") from None


def _certificate(options: argparse.Namespace, note: Callable[[str], None]
                 ) -> Certificate | None:
    """Return the certificate that is given, if any."""
    cert, key = options.hmi_cert, options.hmi_key
    if not (cert or key):
        return None
    if not cert:
        raise UsageError(f"--hmi-key {key}: expected --hmi-cert FILE, too")
    if not key and Path(cert).is_file() and not holds_key(Path(cert)):
        raise UsageError(f"--hmi-cert {cert}: contains no key; expected --hmi-key FILE, too")
    key = options.hmi_key = key or cert
    if options.hmi_unencrypted:
        raise UsageError(f"--hmi-unencrypted: contradicts --hmi-cert {cert}; expected one of them")
    try:
        _, found = load(Path(cert), Path(key))
    except TlsError as error:
        raise UsageError(f"--hmi-cert, --hmi-key: {error}") from None
    host = options.hmi_host
    if not found.names:
        note(f"--hmi-cert {cert}: contains no name or address (subjectAltName); browsers will "
             "refuse it")
    elif host not in ANY and not found.covers(host):
        note(f"--hmi-cert {cert}: is for {', '.join(found.names)}, not for {host}: browsers that "
             f"open the page at {host} will refuse it")
    if (days := days_left(found)) < _SOON_DAYS:
        note(f"--hmi-cert {cert}: expires in {days:.1f} days; the page will use a new file without "
             "a restart")
    return found


def _shown(host: str, certificate: Certificate | None) -> str:
    """Return the host of the printed address, if possible one that browsers accept."""
    names = certificate.plain_names if certificate else ()
    if host in ANY:
        others = (name for name in names if not is_loopback(name))
        return next(others, next(iter(names), socket.gethostname() if certificate else ""))
    return host
