"""`rampart keys`: the credentials of a run.

Issue and revoke the credentials of a run.

A folder of keys contains an authority, and a private key and certificate of each
process and person. In a run with --keys all links use mutual TLS, and routers
accept from each certificate only the messages that its owner declares. This needs
the extra: pip install 'rampart-robot[keys]'.

Examples:
  rampart keys init                               # create an authority in keys/
  rampart keys issue --system osmosis             # for all processes
  rampart keys issue --operator ada --viewer bob  # for people
  rampart run --keys keys
  rampart keys show                               # list certificates and expiry
  rampart keys rotate                             # replace all
  rampart keys revoke ada
"""

from __future__ import annotations

import argparse
import datetime as dt
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from rampart import systems as shipped
from rampart.actors.access.register import IdentityName, Kind, read_register
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.cli import systems
from rampart.cli.output import UsageError, positive, print_rows, say, unknown
from rampart.cli.verbs import (
    JSON,
    Option,
    add_family,
    add_verb,
    extra,
    number,
    option,
    several,
    word,
)

if TYPE_CHECKING:
    from rampart.actors.access.key_folder import Entry

DEFAULT = "keys"

_MOST_DAYS = 36_525
_ROUTER = re.compile(rf"({'|'.join(ROUTERS)})(_\w+)?\Z")
_SHOWN = 16
"""Digits of a fingerprint in the table; --json has all 64."""


def _names(text: str) -> Option:
    return option("names", nargs="*", metavar="NAME", help=text)


_FOLDER = word("--keys", "DIR", f"folder of keys (default: {DEFAULT})", DEFAULT)
_DAYS = number("--days", "N", "days until expiry (default: 30 for processes, 7 for people)")


def add(verbs: Any) -> None:
    """Add the family to the parser."""
    family = add_family(verbs, "keys", "issue and revoke credentials", __doc__ or "")
    add_verb(family, "init", "create a folder of keys with an authority", init, _FOLDER,
             number("--days", "N", "days until the authority expires (default: 1826)", 1826.0))
    add_verb(family, "issue", "issue certificates", issue,
             _names("processes: nodes, modules, supervisor, observer, routers"), _FOLDER,
             word("--system", "SPEC", "issue to all processes of a system: a file, or the name of "
                  "a shipped one"),
             several("--operator", "NAME", "a person who may inject, adapt, reset and order; "
                     "repeatable"),
             several("--viewer", "NAME", "a person who may only watch; repeatable"),
             several("--address", "ADDRESS", "IP address or name at which other hosts reach the "
                     "routers; repeatable"), _DAYS)
    add_verb(family, "rotate", "replace certificates", rotate,
             _names("names (default: all)"), _FOLDER, _DAYS)
    add_verb(family, "revoke", "revoke certificates", revoke, _names("names"), _FOLDER)
    add_verb(family, "share", "copy the credentials of a host", share,
             option("host", metavar="HOST", help="name of the host"), _FOLDER,
             option("--system", metavar="SPEC", required=True,
                    help="system file, or name of a shipped system"),
             option("--to", metavar="DIR", required=True, help="new folder"),
             several("--person", "NAME", "also an operator or viewer who uses tools there; "
                     "repeatable"))
    add_verb(family, "show", "list certificates", show,
             _names("names (default: all)"), _FOLDER, JSON)


def init(options: argparse.Namespace) -> int:
    """Create a folder of keys.

    Create a folder of keys, mode 0700, with a new authority. Its private key
    authority.key signs certificates. No run needs it: keep it off the robots.

    Examples:
      rampart keys init
      rampart keys init --keys ~/fleet --days 3650
    """
    positive("--days", options.days, below=_MOST_DAYS)
    folder = Path(options.keys)
    _keys().init(folder, options.days)
    say(f"{folder}: created an authority; next: rampart keys issue --keys {folder} --system NAME")
    return 0


def issue(options: argparse.Namespace) -> int:
    """Issue certificates.

    Issue a private key and a certificate to processes and people. A new certificate
    of the same name replaces the old one in the folder, which stays valid until it
    expires or is revoked.

    Examples:
      rampart keys issue --system osmosis
      rampart keys issue DM4 RM3 --days 2
      rampart keys issue router_a router_b --address 10.0.0.2
      rampart keys issue --operator ada
    """
    positive("--days", options.days, below=_MOST_DAYS)
    names = dict.fromkeys([*options.names, *(_of_system(options.system) if options.system else ())])
    routers = [name for name in names if _ROUTER.match(name)]
    wanted: list[tuple[Kind, list[str]]] = [
        ("router", routers), ("node", [name for name in names if name not in routers]),
        ("operator", options.operator), ("viewer", options.viewer)]
    if not any(holders for _, holders in wanted):
        raise UsageError("issue: expected NAME, --system SPEC, --operator NAME or --viewer NAME")
    for name in (name for _, holders in wanted for name in holders):
        _check_name(name)
    at = _addresses(options.system) if options.system else {}
    folder, keys = Path(options.keys), _keys()
    if options.address and not routers:
        raise UsageError(f"--address {options.address[0]}: only routers have an address; "
                         f"expected {' '.join(ROUTERS)} or --system, too")
    for address in options.address:
        keys.check_address(address)
    register = read_register(folder)
    for kind, holders in wanted:  # refuses each name before the first certificate is issued
        register = register.issued(holders, kind)
    for kind, holders in wanted:
        for addresses in dict.fromkeys(at.get(name, ()) for name in holders):
            there = [name for name in holders if at.get(name, ()) == addresses]
            reached = (*options.address, *addresses) if kind == "router" else ()
            keys.issue(folder, there, kind, reached, options.days)
        if holders:
            say(f"{kind}: {', '.join(holders)}")
    return 0


def rotate(options: argparse.Namespace) -> int:
    """Replace certificates.

    Issue a new private key and certificate for each name that has some, with the
    same kind and addresses. A process uses them from its next start: restart the
    nodes one after the other with `kill-node`. Old certificates stay valid until
    they expire.

    Examples:
      rampart keys rotate
      rampart keys rotate ada --days 1
    """
    positive("--days", options.days, below=_MOST_DAYS)
    done = _keys().rotate(Path(options.keys), options.names, options.days)
    say(f"new: {', '.join(done) or 'none; the folder has no certificate'}")
    return 0


def revoke(options: argparse.Namespace) -> int:
    """Revoke certificates.

    Revoke all certificates of a name. Then copy register.json to each host, and
    restart its routers one after the other: this puts the revocation in force. A
    certificate that is issued to the name later is a new identity, for which the
    routers must be restarted, too.

    Examples:
      rampart keys revoke ada
      kill-node router_a; kill-node router_b
    """
    if not options.names:
        raise UsageError("revoke: expected NAME; `rampart keys show` lists the names")
    _keys().revoke(Path(options.keys), options.names)
    say(f"revoked: {', '.join(options.names)}; in force when the routers have been restarted: "
        f"{'; '.join(f'kill-node {name}' for name in ROUTERS)}")
    return 0


def show(options: argparse.Namespace) -> int:
    """Print the certificates.

    List each identity of a folder of keys: kind, name in the certificate, expiry,
    fingerprint (SHA-256), and its problem if it has one.

    Examples:
      rampart keys show
      rampart keys show router_a --json

    exit code: 0 all that are listed are valid, 1 one is not, 2 bad usage
    """
    folder = Path(options.keys)
    found = {entry.name: entry for entry in _keys().entries(folder)}
    for name in options.names:
        if name not in found:
            raise unknown("name", name, found)
    shown = [found[name] for name in options.names or found]
    now = dt.datetime.now(dt.UTC)
    rows = [_row(entry, now) for entry in shown]
    print_rows(("name", "kind", "in its certificate", "until (UTC)", "fingerprint", "state"), [
        (r["name"], r["kind"], r["common_name"], (r["not_after"] or "")[:16].replace("T", " "),
         r["fingerprint"][:_SHOWN], r["state"]) for r in rows],
        {"keys": str(folder), "identities": rows}, as_json=options.json)
    return 0 if all(row["state"] in {"valid", "revoked", "not here"} for row in rows) else 1


def _row(entry: Entry, now: dt.datetime) -> dict[str, Any]:
    certificate, identity = entry.certificate, entry.identity
    state = "valid"
    if identity.revoked:
        state = "revoked"
    elif entry.trouble:
        state = entry.trouble
    elif certificate is None:
        state = "not here"
    elif now >= certificate.not_after:
        state = "expired"
    elif now < certificate.not_before:
        state = "not yet valid"
    return {"name": entry.name, "kind": identity.kind,
            "common_name": identity.common_name(entry.name), "state": state,
            "revoked": identity.revoked,
            "not_before": certificate.not_before.isoformat() if certificate else None,
            "not_after": certificate.not_after.isoformat() if certificate else None,
            "fingerprint": certificate.fingerprint if certificate else "",
            "addresses": list(certificate.addresses) if certificate else []}


def share(options: argparse.Namespace) -> int:
    """Copy the credentials of a host.

    Copy into a new folder the credentials of the processes that may run on a host,
    the register, and the certificate of the authority. Then copy that folder to the
    host. The first host gets the credentials of all, because it takes over from
    others. The authority's private key is not copied.

    Examples:
      rampart keys share ground --system my.toml --to ground-keys
      scp -pr ground-keys 192.168.7.2:
    """
    layout = _layout(options.system)
    names = [host.name for host in layout.spec.hosts]
    if options.host not in names:
        raise unknown("host", options.host, names)
    host = "" if options.host == names[0] else options.host
    needed = [*layout.hosts.routers_of(host), *sorted(
        layout.hosts.may_run(host, layout.members)), *options.person]
    _keys().share(Path(options.keys), Path(options.to), needed)
    say(f"{options.to}: {len(needed)} keys for host {options.host}; start it there with --keys")
    return 0


def _of_system(system: str) -> list[str]:
    """Return the names of all processes of a system that have certificates."""
    layout = _layout(system)
    return [*(name for host in layout.hosts.supervisors for name in layout.hosts.routers_of(host)),
            *layout.members]


def _addresses(system: str) -> dict[str, tuple[str, ...]]:
    """Return the addresses at which each router of a system is reached from other hosts."""
    hosts = _layout(system).hosts
    return {name: (hosts.address_of(host),) for host in hosts.supervisors
            for name in hosts.routers_of(host)} if hosts.several else {}


def _layout(system: str) -> Layout:
    systems.load(system)
    plan = RunPlan(system_file=str(shipped.find(system)))
    return Layout(plan, load_system(plan))


def _check_name(name: str) -> None:
    try:
        msgspec.convert(name, IdentityName)
    except msgspec.ValidationError:
        raise UsageError(f"{name!r}: not a name; expected a letter and up to 63 letters, digits "
                         "and _") from None


def _keys() -> Any:
    extra("keys", "cryptography")
    from rampart.actors.access import key_folder  # noqa: PLC0415 of the extra

    return key_folder
