"""Certificates of an authority and of the identities it certifies. Pure; needs `cryptography`.

Keys are on the curve P-256, which TLS libraries and browsers accept. A file holds a private key and
its certificate, so that neither is exchanged without the other. Only a router's certificate is
valid for the listening side of a link, so a node cannot pose as a router.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""Addresses of every router on its own machine."""

_BACK = dt.timedelta(minutes=5)
"""A certificate is valid from this long before its issue, for hosts whose clocks are behind."""

_AUTHORITY = "Rampart authority"
_RSA_BITS = 2048
_CURVES = (ec.SECP256R1, ec.SECP384R1)


@dataclass(frozen=True, slots=True)
class Certificate:
    """Contents of a certificate.

    Attributes:
        common_name: Name of the owner.
        kind: router, node, operator or viewer.
        not_before, not_after: Validity, UTC.
        fingerprint: SHA-256, in hexadecimal.
        addresses: Alternative names.
        is_ours: Whether the authority signed it.
        has_key: Whether the file also holds its private key.
        refused_key: Kind of its key if routers refuse it; else "".
    """

    common_name: str
    kind: str
    not_before: dt.datetime
    not_after: dt.datetime
    fingerprint: str
    addresses: tuple[str, ...]
    is_ours: bool
    has_key: bool
    refused_key: str


def new_authority(now: dt.datetime, days: float) -> bytes:
    """Return key and certificate of a new authority, PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"{_AUTHORITY} {secrets.token_hex(4)}", "authority")
    certificate = _begun(name, name, key, now, days).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True).add_extension(
        _usage(signs=True), critical=True).sign(key, hashes.SHA256())
    return _pem(key, certificate)


def public_part(pem: bytes) -> bytes:
    """Return the certificate alone."""
    return x509.load_pem_x509_certificate(pem).public_bytes(serialization.Encoding.PEM)


def new_certificate(authority: bytes, common_name: str, kind: str, *,
                    addresses: Sequence[str], now: dt.datetime, days: float) -> bytes:
    """Return a new key and the certificate for it, PEM.

    Args:
        authority: Key and certificate, PEM.
        common_name: Name of the owner.
        kind: Kind of the owner. Only a router's certificate is valid for listening.
        addresses: IP addresses and names of a router.
        now: UTC.
        days: Validity.

    Raises:
        ValueError: The authority's data are invalid.
    """
    issuer = x509.load_pem_x509_certificate(authority)
    signing = serialization.load_pem_private_key(authority, None)
    if not isinstance(signing, ec.EllipticCurvePrivateKey):
        raise ValueError("not an elliptic-curve key, expected one made by rampart")
    key = ec.generate_private_key(ec.SECP256R1())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    certificate = _begun(_name(common_name, kind), issuer.subject, key, now, days)
    if kind == "router":
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        certificate = certificate.add_extension(x509.SubjectAlternativeName(
            [_alternative(one) for one in dict.fromkeys((*LOOPBACK, *addresses))]), critical=False)
    signed = certificate.add_extension(
        x509.BasicConstraints(ca=False, path_length=None), critical=True).add_extension(
        _usage(signs=False), critical=True).add_extension(
        x509.ExtendedKeyUsage(uses), critical=False).sign(signing, hashes.SHA256())
    return _pem(key, signed)


def read_certificate(pem: bytes, authority: bytes) -> Certificate:
    """Return the contents of a certificate.

    Args:
        pem: Certificate, with or without its key.
        authority: Certificate of the authority.

    Raises:
        ValueError: One of them is not a certificate.
    """
    found, issuer = x509.load_pem_x509_certificate(pem), x509.load_pem_x509_certificate(authority)
    try:
        found.verify_directly_issued_by(issuer)
        is_ours = True
    except (ValueError, TypeError, InvalidSignature):
        is_ours = False
    try:
        has_key = serialization.load_pem_private_key(pem, None).public_key() == found.public_key()
    except (ValueError, TypeError):
        has_key = False
    try:
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        addresses = tuple(str(one.value) for one in names)
    except x509.ExtensionNotFound:
        addresses = ()
    return Certificate(
        _subject(found, NameOID.COMMON_NAME), _subject(found, NameOID.ORGANIZATIONAL_UNIT_NAME),
        found.not_valid_before_utc, found.not_valid_after_utc,
        found.fingerprint(hashes.SHA256()).hex(), addresses, is_ours, has_key, _refused(found))


def _refused(certificate: x509.Certificate) -> str:
    """Return the kind of a certificate's key if rustls refuses it; else ""."""
    key = certificate.public_key()
    if isinstance(key, rsa.RSAPublicKey):
        return f"RSA of {key.key_size} bits" if key.key_size < _RSA_BITS else ""
    if isinstance(key, ec.EllipticCurvePublicKey):
        return "" if isinstance(key.curve, _CURVES) else f"of the curve {key.curve.name}"
    return "" if isinstance(key, ed25519.Ed25519PublicKey) else type(key).__name__.strip("_")


def check_address(text: str) -> None:
    """Check an alternative name.

    Raises:
        ValueError: The text is neither an IP address nor a host name.
    """
    _alternative(text)


def _begun(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey,
           now: dt.datetime, days: float) -> x509.CertificateBuilder:
    return x509.CertificateBuilder(
        issuer, subject, key.public_key(), x509.random_serial_number(), now - _BACK,
        now + dt.timedelta(days=days))


def _name(common_name: str, kind: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, kind),
                      x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, key_cert_sign=signs, crl_sign=signs,
        encipher_only=False, decipher_only=False)


def _alternative(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        pass
    labels = text.split(".")
    if not text.isascii() or len(text) > 253 or not all(
            0 < len(one) < 64 and one.replace("-", "a").isalnum() for one in labels):
        raise ValueError(f"{text!r}: expected an IP address or a host name")
    return x509.DNSName(text)


def _subject(found: x509.Certificate, what: x509.ObjectIdentifier) -> str:
    values = found.subject.get_attributes_for_oid(what)
    return str(values[0].value) if values else ""


def _pem(key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption()) + certificate.public_bytes(serialization.Encoding.PEM)
