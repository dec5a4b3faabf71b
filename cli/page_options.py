"""What can be said on the command line of the operator's page: where it is, for whom, how safe.

All of it is checked before anything is started, so that a page that could not be served, or would
be open to strangers, is one line and no surprise.
"""

from __future__ import annotations

import argparse
import os
import secrets
import socket
from collections.abc import Callable
from pathlib import Path

import msgspec

from rampart.actors.web.access import ANY, Access, AccessError, check_token, is_loopback, new_token
from rampart.actors.web.page_plan import PagePlan
from rampart.actors.web.tls import Certificate, TlsError, days_left, holds_key, load
from rampart.actors.web.token_file import SecretError, read_secret
from rampart.actors.web.visitors import VisitorError, lists_visitors, read_visitors
from rampart.cli.output import UsageError
from rampart.cli.verbs import flag, option, whole, word

TOKEN_VARIABLE = "RAMPART_HMI_TOKEN"  # noqa: S105 the name of one

NAMES = ("hmi_port", "hmi_host", "hmi_token_file", "hmi_cert", "hmi_key", "hmi_unencrypted",
         "hmi_behind")

_SOON_DAYS = 7.0
"""A certificate that ends within so many days is told."""

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
    """Return the token of the environment, and take it from there: nothing that is started has it.

    Raises:
        UsageError: there is one on the command line.
    """
    own = os.environ.pop(TOKEN_VARIABLE, "")
    if options.hmi_token is not None:
        raise UsageError("--hmi-token: a command line is read by every user of this machine; put "
                         "another token into a file of mode 0600 for --hmi-token-file FILE, or "
                         f"into the variable {TOKEN_VARIABLE}")
    return own


def page_of(options: argparse.Namespace, own: str, note: Callable[[str], None]
            ) -> PagePlan:
    """Return where the page is, for whom, encrypted how.

    Tokens come from a file or the environment, which other users cannot read as they can read a
    command line; where none is given and one is needed it is made.

    Args:
        options: of the command line.
        own: token of the environment, "" for none.
        note: is told what is odd, and no error.

    Raises:
        UsageError: an option makes no sense, or the page could not be served like this.
    """
    if options.no_hmi or options.virtual:
        if options.wait:
            raise UsageError("--wait: the mission is started from the operator's page, which there "
                             f"is not with --{'no-hmi' if options.no_hmi else 'virtual'}")
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
    _check_address(host, options.hmi_port)
    return PagePlan(
        options.hmi_port, host, token, is_new, listed,
        cert=str(Path(options.hmi_cert).resolve()) if certificate else "",
        key=str(Path(options.hmi_key).resolve()) if certificate else "",
        unencrypted=options.hmi_unencrypted, secret=secrets.token_hex(32),
        shown=_shown(host, certificate), behind=options.hmi_behind)


def audited(page: PagePlan, file: Path) -> PagePlan:
    """Return the plan of a page that keeps in a file who did what, if there is a page."""
    return msgspec.structs.replace(page, audit_log=str(file)) if page.port else page


def _tokens(options: argparse.Namespace, own: str) -> tuple[str, str]:
    """Return the token that everybody shows, or the path of the list of those who have one."""
    source = TOKEN_VARIABLE
    try:
        if options.hmi_token_file:
            source = f"--hmi-token-file {options.hmi_token_file}"
            file = Path(options.hmi_token_file)
            if lists_visitors(file):
                if not read_visitors(file):
                    raise VisitorError("lists nobody; rampart tokens issue NAME --role ROLE --file "
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
        raise UsageError(f"--hmi-key {key}: --hmi-cert FILE is needed as well")
    if not key and Path(cert).is_file() and not holds_key(Path(cert)):
        raise UsageError(f"--hmi-cert {cert}: holds no key; --hmi-key FILE is needed as well")
    key = options.hmi_key = key or cert
    if options.hmi_unencrypted:
        raise UsageError(f"--hmi-unencrypted: with --hmi-cert {cert} the page is encrypted; leave "
                         "one of them out")
    try:
        _, found = load(Path(cert), Path(key))
    except TlsError as error:
        raise UsageError(f"--hmi-cert, --hmi-key: {error}") from None
    host = options.hmi_host
    if not found.names:
        note(f"--hmi-cert {cert}: is for no name or address (no subjectAltName): browsers will "
             "refuse it")
    elif host not in ANY and not found.covers(host):
        note(f"--hmi-cert {cert}: is for {', '.join(found.names)}, not for {host}: browsers that "
             f"open the page at {host} will refuse it")
    if (days := days_left(found)) < _SOON_DAYS:
        note(f"--hmi-cert {cert}: ends in {days:.1f} days; a new one in its place is taken while "
             "the page is served")
    return found


def _shown(host: str, certificate: Certificate | None) -> str:
    """Return under which name the page is shown: one that browsers accept, if there is one."""
    names = certificate.plain_names if certificate else ()
    if host in ANY:
        others = (name for name in names if not is_loopback(name))
        return next(others, next(iter(names), socket.gethostname() if certificate else ""))
    return host


def _check_address(host: str, port: int) -> None:
    """Refuse an address that is not this machine's, and a port that another program serves."""
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise UsageError(f"--hmi-host {host}: no address of this machine ({why}); 0.0.0.0 stands "
                         "for all it has") from None
    with socket.socket(family, kind, number) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address[0], port, *address[2:]))
        except OSError as error:
            raise UsageError(f"--hmi-port {port}: {error.strerror}; choose another --hmi-port, or "
                             "--no-hmi") from None
