"""The register of a folder of keys: who has a certificate, of which kind, and who no longer.

It holds no secret. Routers read it when they start, and let through nobody who is not in it, or is
revoked there; so it has to be the same on every host. A name that was revoked and gets a new
certificate is another identity, with a number behind its name: the old one stays out, though it
has not expired yet.
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
"""As nodes are called."""

REGISTER = "register.json"
SIGNING = "authority.key"
"""Key and certificate of the authority; to be kept where no robot is."""

_MOST_BYTES = 1 << 20


class KeysError(ValueError):
    """A folder of keys cannot be used; one line."""


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Somebody who has, or had, certificates.

    Attributes:
        kind: what it is.
        number: of the identity; grows by 1 with each certificate that follows a revocation.
        revoked: whether it has none that counts.
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
        """Return the names of those who are not revoked → the names in their certificates."""
        return {name: one.common_name(name) for name, one in self.identities.items()
                if one.kind == kind and not one.revoked}

    def issued(self, names: Iterable[str], kind: Kind) -> Register:
        """Return the register in which these have certificates.

        Raises:
            KeysError: one of them is somebody else.
        """
        found = dict(self.identities)
        for name in names:
            before = found.get(name)
            if before is None:
                found[name] = Identity(kind)
            elif before.kind != kind:
                raise KeysError(f"{name}: is the name of a {before.kind}; another one is right")
            elif before.revoked:
                found[name] = Identity(kind, before.number + 1)
        return Register(found)

    def revoked(self, names: Iterable[str]) -> Register:
        """Return the register in which these have none.

        Raises:
            KeysError: one of them has none anyway.
        """
        found = dict(self.identities)
        for name in names:
            before = found.get(name)
            if before is None or before.revoked:
                raise KeysError(f"{name}: has no certificate that could be revoked")
            found[name] = msgspec.structs.replace(before, revoked=True)
        return Register(found)


def read_register(folder: Path) -> Register:
    """Return the register of a folder of keys.

    Raises:
        KeysError: there is none, or it is unsound.
    """
    file = folder / REGISTER
    try:
        return msgspec.json.decode(read_bytes(file, _MOST_BYTES), type=Register)
    except OSError as error:
        raise KeysError(f"{file}: {error.strerror}; `rampart keys init` makes a folder of keys"
                        ) from None
    except (FileError, msgspec.MsgspecError, RecursionError) as error:
        raise KeysError(f"{file}: {error}") from None
