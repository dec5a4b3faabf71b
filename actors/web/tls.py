"""The certificate and key with which a page is encrypted: read, checked, and read anew.

A certificate has a short life and is replaced in its place while a page is served. So the files are
looked at when somebody connects: if they have changed and fit, they are taken; if they do not, the
ones before stay in force and the reason is told.

What a certificate says is learned from a handshake with oneself, in memory: the client that trusts
this certificate alone checks its times, and reads its names.
"""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from rampart.actors.web.tcp_peer import plain_address
from rampart.actors.web.token_file import SecretError, read_private

_MAX_BYTES = 1_000_000
_ROUNDS = 4
_KEY = b"PRIVATE KEY-----"
_KINDS = ("DNS", "IP Address")
_MISMATCH = ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH", "NO_CERTIFICATE_ASSIGNED")


class TlsError(ValueError):
    """A certificate and a key with which no page can be served; one line."""


class Certificate(msgspec.Struct, frozen=True):
    """What a certificate says: for which names and addresses it is, and until when (Unix time)."""

    names: tuple[str, ...]
    until_s: float

    def covers(self, host: str) -> bool:
        """Tell whether it is for a name or address."""
        host = host.lower()
        parent = "*." + host.partition(".")[2]
        return any(name in (host, parent) for name in self.names)

    @property
    def plain_names(self) -> tuple[str, ...]:
        """Those that stand for one host."""
        return tuple(name for name in self.names if "*" not in name)


def holds_key(file: Path) -> bool:
    """Tell whether a file holds a private key as well; not one that cannot be read."""
    try:
        with file.open("rb") as opened:
            return _KEY in opened.read(_MAX_BYTES)
    except (OSError, ValueError):
        return False


def load(certificate: Path, key: Path) -> tuple[ssl.SSLContext, Certificate]:
    """Return what connections are encrypted with, and what the certificate says.

    TLS 1.3 alone: every browser of today speaks it.

    Args:
        certificate: PEM; first that of the page, then those that lead to its authority, if any.
        key: PEM, of the first one, without a passphrase, in a file that only this user can get at;
            the same file, if it holds both.

    Raises:
        TlsError: a file cannot be read, they do not belong together, or it is not valid now.
    """
    try:
        secret = read_private(key, _MAX_BYTES)
    except SecretError as error:
        raise TlsError(f"key {key}: {error}") from None
    try:
        with certificate.open("rb") as file:
            pem = file.read(_MAX_BYTES)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise TlsError(f"certificate {certificate}: cannot be read ({why})") from None
    if b"-----BEGIN CERTIFICATE-----" not in pem:
        raise TlsError(f"certificate {certificate}: no certificate in PEM")
    if _KEY not in secret:
        raise TlsError(f"key {key}: no private key in PEM")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    asked: list[bool] = []

    def no_passphrase() -> bytes:
        asked.append(True)
        return b""

    try:
        context.load_cert_chain(certificate, key, no_passphrase)
    except (ssl.SSLError, ValueError, OSError) as error:
        raise TlsError(_in_words(certificate, key, error, is_locked=bool(asked))) from None
    return context, _look_at(context, certificate)


def _in_words(certificate: Path, key: Path, error: Exception, *, is_locked: bool) -> str:
    if is_locked:
        return f"key {key}: needs a passphrase; expected a key without, in a file of mode 0600"
    if getattr(error, "reason", "") in _MISMATCH:
        return f"key {key}: is not that of certificate {certificate}"
    why = " ".join((getattr(error, "reason", None) or str(error)).lower().replace("_", " ").split())
    return f"certificate {certificate}, key {key}: not taken ({why})"


def _look_at(context: ssl.SSLContext, certificate: Path) -> Certificate:
    """Shake hands with oneself."""
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_flags = ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN  # it need not be an authority's
    try:
        client.load_verify_locations(certificate)
        to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
        ends = (client.wrap_bio(to_client, to_server),
                context.wrap_bio(to_server, to_client, server_side=True))
        for _ in range(_ROUNDS):
            for end in ends:
                try:
                    end.do_handshake()
                except ssl.SSLWantReadError:
                    continue
        said = ends[0].getpeercert()
    except ssl.SSLCertVerificationError as error:
        raise TlsError(f"certificate {certificate}: {error.verify_message}") from None
    except (ssl.SSLError, ValueError, OSError) as error:
        raise TlsError(f"certificate {certificate}: not taken ({error})") from None
    if not said:
        raise TlsError(f"certificate {certificate}: cannot be used for a server")
    named: tuple[tuple[str, str], ...] = said.get("subjectAltName", ())  # type: ignore[assignment]
    names = tuple(str(plain_address(value)) if kind == "IP Address" else value.lower()
                  for kind, value in named if kind in _KINDS)
    return Certificate(names, ssl.cert_time_to_seconds(str(said["notAfter"])))


def days_left(certificate: Certificate) -> float:
    """Return for how many days it is still valid."""
    return (certificate.until_s - time.time()) / 86_400


class Tls:
    """What a server encrypts its connections with, now.

    Args:
        certificate: see `load`.
        key: see `load`.
        complain: is told why changed files are not taken, once for each change.

    Attributes:
        says: the certificate.

    Raises:
        TlsError: they cannot be used.
    """

    def __init__(self, certificate: Path, key: Path,
                 complain: Callable[[str], None] = lambda _why: None) -> None:
        self._files = certificate, key
        self._complain = complain
        self._seen = self._look()
        self._context, self.says = load(certificate, key)

    def serving(self) -> ssl.SSLContext:
        """Return what a server encrypts with: each connection by the files as they are then."""
        def chosen(connection: ssl.SSLObject | ssl.SSLSocket, *_: object) -> None:
            connection.context = self.context()

        self._context.sni_callback = chosen
        return self._context

    def context(self) -> ssl.SSLContext:
        """Return what the next connection is encrypted with."""
        if (seen := self._look()) != self._seen:
            self._seen = seen
            try:
                self._context, self.says = load(*self._files)
            except TlsError as error:
                self._complain(f"{error}; the one before stays in force")
        return self._context

    def _look(self) -> list[tuple[int, int, int]]:
        found = []
        for file in self._files:
            try:
                stat = file.stat()
                found.append((stat.st_ino, stat.st_mtime_ns, stat.st_size))
            except (OSError, ValueError):
                found.append((0, 0, 0))
        return found
