"""A folder of credentials: an authority, and the certificates it issued. Needs `cryptography`.

`keys/` has mode 0700 and holds

* `authority.key`: private key and certificate of the authority. Only `rampart keys` needs it.
* `ca.crt`: its certificate, and `register.json`: valid and revoked identities. Both are public and
  the same on every host.
* `NAME.pem`: private key and certificate of an identity, mode 0600, for the host that runs it.

Each file is written beside its place, synchronised, and renamed, so it is always complete. The
register is written first. If the process is killed in between, an identity has no certificate, or a
revoked one still has a file, which no router accepts. Both are shown, and a second attempt repairs
them.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import fcntl
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from rampart.actors.access.certificates import (
    Certificate,
    check_address,
    new_authority,
    new_certificate,
    public_part,
    read_certificate,
)
from rampart.actors.access.register import (
    REGISTER,
    SIGNING,
    Identity,
    KeysError,
    Kind,
    Register,
    read_register,
)
from rampart.actors.bus.zenoh_session import AUTHORITY, key_file
from rampart.files.reading import FileError, read_bytes
from rampart.files.writing import replace_file

__all__ = ["check", "check_address", "days_left", "entries", "expired", "init", "issue",
           "lifetimes", "revoke", "rotate"]

AUTHORITY_DAYS = 1826.0
DAYS: dict[str, float] = {"router": 30.0, "node": 30.0, "operator": 7.0, "viewer": 7.0}
"""Default validity of certificates by kind."""

_MOST_BYTES = 64 << 10


@dataclass(frozen=True, slots=True)
class Entry:
    """One identity and its certificate.

    Attributes:
        name: Name of the identity.
        identity: Its entry in the register.
        certificate: None if its file is not here.
        trouble: Why its file cannot be used; "" if it can, or if there is no file.
    """

    name: str
    identity: Identity
    certificate: Certificate | None
    trouble: str


def init(folder: Path, days: float = AUTHORITY_DAYS) -> None:
    """Make a folder with a new authority, or complete a folder whose making was interrupted.

    Raises:
        KeysError: The folder has an authority, or other users can access it.
        OSError: It cannot be written.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with _locked(folder):
        own, public, register = (folder / name for name in (SIGNING, AUTHORITY, REGISTER))
        if own.exists() and public.exists() and register.exists():
            raise KeysError(f"{folder}: has an authority already; a new one would invalidate all "
                            "certificates")
        if public.exists() and not own.exists():
            raise KeysError(f"{folder}: has keys that were issued elsewhere; expected a new folder")
        if not own.exists():
            replace_file(own, new_authority(_now(), days))
        replace_file(public, public_part(_read(own)), 0o644)
        if not register.exists():
            _keep(folder, Register())


def issue(folder: Path, names: Sequence[str], kind: Kind, addresses: Sequence[str] = (),
          days: float | None = None) -> None:
    """Issue certificates. An earlier certificate of an identity stays valid until it expires.

    Args:
        folder: Folder of credentials.
        names: Names of the identities.
        kind: Kind of the identities.
        addresses: Addresses of routers, besides loopback.
        days: Validity; None for the default of the kind.

    Raises:
        KeysError: The authority is not here, or a name has another kind.
        OSError: A file cannot be written.
    """
    with _locked(folder):
        authority = _authority(folder)
        register = read_register(folder).issued(names, kind)
        common_names = register.of_kind(kind)
        _keep(folder, register)
        for name in names:
            replace_file(_file(folder, name), new_certificate(
                authority, common_names[name], kind, addresses=addresses, now=_now(),
                days=DAYS[kind] if days is None else days))


def rotate(folder: Path, names: Sequence[str], days: float | None = None) -> list[str]:
    """Reissue existing certificates with new keys and the same addresses.

    Args:
        folder: Folder of credentials.
        names: Names of the identities; empty for all.
        days: Validity; None for the default of each kind.

    Returns:
        The names.

    Raises:
        KeysError: The authority is not here, or an identity has no certificate.
        OSError: A file cannot be written.
    """
    here = {entry.name: entry for entry in entries(folder)}
    chosen = list(names) or [name for name, one in here.items()
                             if one.certificate is not None and not one.identity.revoked]
    for name in chosen:
        if name not in here or here[name].identity.revoked:
            raise KeysError(f"{name}: has no certificate; `rampart keys issue` gives it one")
    for name in chosen:
        found, kind = here[name].certificate, here[name].identity.kind
        issue(folder, [name], kind, found.addresses if found is not None else (), days)
    return chosen


def revoke(folder: Path, names: Sequence[str]) -> None:
    """Revoke identities and remove their files.

    A host enforces it from the next start of its routers with this register.

    Raises:
        KeysError: An identity has no certificate.
        OSError: A file cannot be written.
    """
    with _locked(folder):
        _keep(folder, read_register(folder).revoked(names))
        for name in names:
            _file(folder, name).unlink(missing_ok=True)


def share(folder: Path, to: Path, names: Sequence[str]) -> None:
    """Copy the keys of some identities and the public files into a new folder.

    Raises:
        KeysError: An identity has no valid certificate, or the new folder exists.
        OSError: A file cannot be read or written.
    """
    check(folder, names)
    if to.exists():
        raise KeysError(f"{to}: exists; expected a new folder")
    to.mkdir(mode=0o700)
    for file in (folder / AUTHORITY, folder / REGISTER, *(_file(folder, name) for name in names)):
        replace_file(to / file.name, _read(file))


def entries(folder: Path) -> list[Entry]:
    """Return all identities, sorted by name.

    Raises:
        KeysError: The folder does not exist, or has no certificate of an authority.
    """
    register = read_register(folder)
    authority = _read(folder / AUTHORITY)
    found = []
    for name, identity in sorted(register.identities.items()):
        certificate, trouble = None, ""
        try:
            certificate = read_certificate(_read(_file(folder, name)), authority)
            trouble = _trouble(name, identity, certificate)
        except FileNotFoundError:
            pass
        except ValueError as error:
            trouble = " ".join(str(error).split())
        found.append(Entry(name, identity, certificate, trouble))
    return found


def _trouble(name: str, identity: Identity, certificate: Certificate) -> str:
    if not certificate.is_ours:
        return "of another authority"
    if certificate.refused_key:
        return (f"its key is {certificate.refused_key}, which no router takes; expected P-256, "
                "P-384, Ed25519, or RSA of at least 2048 bits")
    if not certificate.has_key:
        return "without its private key"
    if certificate.common_name != identity.common_name(name):
        return f"of {certificate.common_name}, and not of {identity.common_name(name)}"
    return ""


def check(folder: Path, names: Sequence[str]) -> dt.datetime:
    """Check the credentials of a run, and return when the first of them expires.

    Args:
        folder: Folder of credentials.
        names: Names of all processes of the run.

    Raises:
        KeysError: Other users can read the folder, or a process has no valid certificate.
    """
    _check_private(folder)
    here = {entry.name: entry for entry in entries(folder)}
    until, now = dt.datetime.max.replace(tzinfo=dt.UTC), _now()
    for name in names:
        entry, file = here.get(name), _file(folder, name)
        if entry is None or entry.identity.revoked or (
                entry.certificate is None and not entry.trouble):
            why = "is revoked" if entry and entry.identity.revoked else "has no certificate"
            raise KeysError(f"{file}: {name} {why}; `rampart keys issue` gives it one")
        if entry.trouble or entry.certificate is None:
            raise KeysError(f"{file}: {entry.trouble}; `rampart keys issue {name}` repairs it")
        if file.stat().st_mode & 0o077:
            raise KeysError(f"{file}: others can read it; chmod 600 it")
        if not entry.certificate.not_before <= now < entry.certificate.not_after:
            raise KeysError(f"{file}: valid from {entry.certificate.not_before:%Y-%m-%d %H:%M} to "
                            f"{entry.certificate.not_after:%Y-%m-%d %H:%M} UTC, and it is "
                            f"{now:%Y-%m-%d %H:%M}; `rampart keys rotate` renews it")
        until = min(until, entry.certificate.not_after)
    return until


def lifetimes(folder: Path, names: Iterable[str]) -> dict[str, dt.datetime]:
    """Return when the certificates of some identities expire. Those without a file are left out.

    Raises:
        KeysError: The folder does not exist, or has no certificate of an authority.
    """
    wanted = set(names)
    return {entry.name: entry.certificate.not_after for entry in entries(folder)
            if entry.name in wanted and entry.certificate is not None}


def days_left(until: dt.datetime) -> float:
    """Return the days until a certificate expires; negative if it has expired."""
    return (until - _now()) / dt.timedelta(days=1)


def expired(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return a line for each identity whose certificate has expired."""
    return {name: f"{_file(folder, name)}: the certificate of {name} expired at "
                  f"{until:%Y-%m-%d %H:%M:%S} UTC, and no router takes it; `rampart keys rotate "
                  f"{name}` renews it"
            for name, until in lifetimes(folder, names).items() if days_left(until) <= 0}


def _check_private(folder: Path) -> None:
    found = folder.stat()
    if found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise KeysError(f"{folder}: must be yours alone; chmod 700 it")


def _file(folder: Path, name: str) -> Path:
    return Path(key_file(str(folder), name))


def _authority(folder: Path) -> bytes:
    try:
        return _read(folder / SIGNING)
    except FileNotFoundError:
        raise KeysError(f"{folder / SIGNING}: not found; issue certificates where the authority is"
                        ) from None


def _read(file: Path) -> bytes:
    try:
        return read_bytes(file, _MOST_BYTES)
    except FileNotFoundError:
        raise
    except (OSError, FileError) as error:
        raise KeysError(f"{file}: {getattr(error, 'strerror', None) or error}") from None


def _keep(folder: Path, register: Register) -> None:
    text = msgspec.json.format(msgspec.json.encode(register, order="sorted"), indent=1)
    replace_file(folder / REGISTER, text + b"\n", 0o644)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder, so that of two concurrent changes the second one waits."""
    try:
        place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise KeysError(f"{folder}: {error.strerror}; `rampart keys init` makes it") from None
    try:
        _check_private(folder)
        fcntl.flock(place, fcntl.LOCK_EX)
        yield
    finally:
        os.close(place)


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)
