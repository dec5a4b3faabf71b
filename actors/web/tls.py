"""Certificate and key of a page: reading, checking, and reloading.

A certificate has a short life, and its file is replaced while a page is served. So each connection
looks whether the files have changed. Valid ones are loaded; with others the previous ones stay in
force, and the reason is reported.

A TLS handshake in memory reads the contents of a certificate: its client trusts this certificate
only, checks its validity, and reads its names.
"""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from rampart.actors.web.access import plain_address
from rampart.actors.web.visitors import SecretError, file_state, read_private

_MAX_BYTES = 1_000_000
_ROUNDS = 4
_KEY = b"PRIVATE KEY-----"
_KINDS = ("DNS", "IP Address")
_MISMATCH = ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH", "NO_CERTIFICATE_ASSIGNED")


class TlsError(ValueError):
    """A page cannot be served with a certificate and key; one line."""


class Certificate(msgspec.Struct, frozen=True):
    """Names and addresses of a certificate, and the end of its validity (Unix time)."""

    names: tuple[str, ...]
    until_s: float

    def covers(self, host: str) -> bool:
        """Return whether it is valid for a name or address."""
        host = host.lower()
        parent = "*." + host.partition(".")[2]
        return any(name in (host, parent) for name in self.names)

    @property
    def plain_names(self) -> tuple[str, ...]:
        """Names without a wildcard."""
        return tuple(name for name in self.names if "*" not in name)


def holds_key(file: Path) -> bool:
    """Return whether a file can be read and contains a private key."""
    try:
        with file.open("rb") as opened:
            return _KEY in opened.read(_MAX_BYTES)
    except (OSError, ValueError):
        return False


def load(certificate: Path, key: Path) -> tuple[ssl.SSLContext, Certificate]:
    """Return the context of TLS connections, and the contents of the certificate.

    TLS 1.3 only, which every current browser supports.

    Args:
        certificate: PEM; the page's certificate, then its chain, if any.
        key: PEM; key of the first certificate, without a passphrase, in a file that only this user
            can read. It may be the same file.

    Raises:
        TlsError: a file cannot be read, the key does not fit, or the certificate is not valid now.
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
        raise TlsError(f"certificate {certificate}: expected a certificate in PEM")
    if _KEY not in secret:
        raise TlsError(f"key {key}: expected a private key in PEM")
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
    return context, _contents(context, certificate)


def _in_words(certificate: Path, key: Path, error: Exception, *, is_locked: bool) -> str:
    if is_locked:
        return f"key {key}: needs a passphrase; expected a key without, in a file of mode 0600"
    if getattr(error, "reason", "") in _MISMATCH:
        return f"key {key}: does not fit certificate {certificate}"
    why = " ".join((getattr(error, "reason", None) or str(error)).lower().replace("_", " ").split())
    return f"certificate {certificate}, key {key}: cannot be loaded ({why})"


def _contents(context: ssl.SSLContext, certificate: Path) -> Certificate:
    """Return the contents of a loaded certificate, by a handshake of a context with a client."""
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_flags = ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN  # not an authority
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
        contents = ends[0].getpeercert()
    except ssl.SSLCertVerificationError as error:
        raise TlsError(f"certificate {certificate}: {error.verify_message}") from None
    except (ssl.SSLError, ValueError, OSError) as error:
        raise TlsError(f"certificate {certificate}: cannot be loaded ({error})") from None
    if not contents:
        raise TlsError(f"certificate {certificate}: cannot be used for a server")
    named: tuple[tuple[str, str], ...] = contents.get(
        "subjectAltName", ())  # type: ignore[assignment]
    names = tuple(str(plain_address(value)) if kind == "IP Address" else value.lower()
                  for kind, value in named if kind in _KINDS)
    return Certificate(names, ssl.cert_time_to_seconds(str(contents["notAfter"])))


def days_left(certificate: Certificate) -> float:
    """Return the days of validity that are left."""
    return (certificate.until_s - time.time()) / 86_400


class Tls:
    """The current certificate of a server.

    Args:
        certificate: see `load`.
        key: see `load`.
        complain: called with the reason when changed files cannot be loaded, once per change.

    Attributes:
        says: contents of the certificate.

    Raises:
        TlsError: see `load`.
    """

    def __init__(self, certificate: Path, key: Path,
                 complain: Callable[[str], None] = lambda _why: None) -> None:
        self._files = certificate, key
        self._complain = complain
        self._seen = self._look()
        self._context, self.says = load(certificate, key)

    def serving(self) -> ssl.SSLContext:
        """Return a context for a server that reloads changed files with each connection."""
        def chosen(connection: ssl.SSLObject | ssl.SSLSocket, *_: object) -> None:
            connection.context = self.context()

        self._context.sni_callback = chosen
        return self._context

    def context(self) -> ssl.SSLContext:
        """Return the context for the next connection."""
        if (seen := self._look()) != self._seen:
            self._seen = seen
            try:
                self._context, self.says = load(*self._files)
            except TlsError as error:
                self._complain(f"{error}; the previous one stays in force")
        return self._context

    def _look(self) -> list[tuple[int, ...]]:
        return [file_state(file) for file in self._files]
