"""Certificates and keys for tests, with keys of P-256, made once per process. All sign themselves.

`robot` is for robot.local, *.robots.example and loopback, `other` for other.local; `old` has ended,
`client` is for clients alone, `locked` is robot's key with a passphrase.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

NAMES = {"robot": ["robot.local", "*.robots.example", "127.0.0.1", "::1"],
         "other": ["other.local"], "old": ["old.local"], "client": []}


def _alternative(name: str) -> x509.GeneralName:
    is_address = name[0].isdigit() or ":" in name
    return x509.IPAddress(ipaddress.ip_address(name)) if is_address else x509.DNSName(name)


def _key_pem(key: ec.EllipticCurvePrivateKey, lock) -> str:
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
                             lock).decode()


def _pems() -> dict[str, str]:
    made = {}
    for name, names in NAMES.items():
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        begun = dt.datetime.now(dt.UTC) - dt.timedelta(days=2)
        builder = x509.CertificateBuilder(
            subject, subject, key.public_key(), x509.random_serial_number(), begun,
            begun + dt.timedelta(days=1 if name == "old" else 30)).add_extension(
            x509.BasicConstraints(ca=True, path_length=None), critical=True)
        extension = x509.SubjectAlternativeName(map(_alternative, names)) if names else (
            x509.ExtendedKeyUsage([x509.ExtendedKeyUsageOID.CLIENT_AUTH]))
        certificate = builder.add_extension(extension, critical=False).sign(key, hashes.SHA256())
        made[f"{name}.crt"] = certificate.public_bytes(serialization.Encoding.PEM).decode()
        made[f"{name}.key"] = _key_pem(key, serialization.NoEncryption())
        if name == "robot":
            made["locked.key"] = _key_pem(key, serialization.BestAvailableEncryption(b"secret"))
    return made


PEMS = _pems()


def pem(folder: Path, name: str) -> Path:
    """Write one into a folder, as its owner would keep it, and return its path."""
    file = folder / name
    file.touch(0o600)
    file.write_text(PEMS[name])
    return file


def pair(folder: Path, name: str = "robot") -> tuple[Path, Path]:
    """Write a certificate and its key."""
    return pem(folder, f"{name}.crt"), pem(folder, f"{name}.key")
