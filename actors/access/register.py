"""The register of a folder of credentials: identities, their kinds, and which are revoked.

It holds no secret. Routers read it when they start and refuse every identity that is missing or
revoked, so it must be the same on every host. A revoked name that gets a new certificate becomes a
new identity with a number after its name. So the old certificate stays refused until it expires.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec

from rampart.files.reading import FileError, read_bytes

Kind = Literal["router", "node", "operator", "viewer"]
KINDS: tuple[str, ...] = get_args(Kind)

IdentityName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z")]
"""The same names as those of nodes."""

REGISTER = "register.json"
SIGNING = "authority.key"
"""Key and certificate of the authority. It belongs on no robot."""

_MOST_BYTES = 1 << 20


class KeysError(ValueError):
    """A folder of credentials cannot be used. The text is one line."""


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A process or person that has, or had, certificates.

    Attributes:
        kind: Kind of the identity.
        number: Grows by 1 with each certificate after a revocation.
        revoked: Whether its certificates are refused.
    """

    kind: Kind
    number: Annotated[int, msgspec.Meta(ge=1)] = 1
    revoked: bool = False

    def common_name(self, name: str) -> str:
        """Return the name in its certificate."""
        return name if self.number == 1 else f"{name}.{self.number}"


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Identities by their names."""

    identities: dict[IdentityName, Identity] = {}

    def of_kind(self, kind: Kind) -> dict[str, str]:
        """Return name in the certificate by name, without revoked identities."""
        return {name: one.common_name(name) for name, one in self.identities.items()
                if one.kind == kind and not one.revoked}

    def issued(self, names: Iterable[str], kind: Kind) -> Register:
        """Return the register after certificates were issued.

        Raises:
            KeysError: A name has another kind.
        """
        found = dict(self.identities)
        for name in names:
            before = found.get(name)
            if before is None:
                found[name] = Identity(kind)
            elif before.kind != kind:
                raise KeysError(f"{name}: is the name of a {before.kind}; expected another name")
            elif before.revoked:
                found[name] = Identity(kind, before.number + 1)
        return Register(found)

    def revoked(self, names: Iterable[str]) -> Register:
        """Return the register after identities were revoked.

        Raises:
            KeysError: An identity has no certificate.
        """
        found = dict(self.identities)
        for name in names:
            before = found.get(name)
            if before is None or before.revoked:
                raise KeysError(f"{name}: no certificate to revoke")
            found[name] = msgspec.structs.replace(before, revoked=True)
        return Register(found)


def read_register(folder: Path) -> Register:
    """Return the register of a folder of credentials.

    Raises:
        KeysError: It does not exist or is invalid.
    """
    file = folder / REGISTER
    try:
        return msgspec.json.decode(read_bytes(file, _MOST_BYTES), type=Register)
    except OSError as error:
        raise KeysError(f"{file}: {error.strerror}; `rampart keys init` makes a folder of keys"
                        ) from None
    except (FileError, msgspec.MsgspecError, RecursionError) as error:
        raise KeysError(f"{file}: {error}") from None
