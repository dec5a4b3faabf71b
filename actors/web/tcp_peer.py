"""The user at the other end of a TCP connection within this machine (proc_net_tcp(5))."""

from __future__ import annotations

import ipaddress
from pathlib import Path

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


def plain_address(text: str) -> IpAddress:
    """Return an address; an IPv4 address that is mapped to IPv6 as IPv4."""
    address = ipaddress.ip_address(text.partition("%")[0])
    return getattr(address, "ipv4_mapped", None) or address


def user_of_peer(local: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Return the user whose socket is the other end of a connection within this machine.

    Args:
        local: address and port of this end.
        peer: address and port of the other end.

    Returns:
        User id. None if there is no such connection, or no process has its socket any more (the
        kernel reports user 0 then).
    """
    ends = (plain_address(peer[0]), peer[1]), (plain_address(local[0]), local[1])
    for table in ("tcp", "tcp6"):
        try:
            lines = Path("/proc/net", table).read_text(encoding="ascii").splitlines()[1:]
        except OSError:  # a kernel without IPv6
            continue
        for line in lines:
            fields = line.split()
            if (_end(fields[1]), _end(fields[2])) == ends and fields[9] != "0":
                return int(fields[7])
    return None


def _end(field: str) -> tuple[IpAddress, int]:
    """Return address and port of e.g. 0100007F:1F90, in words of the machine's byte order."""
    address, _, port = field.partition(":")
    words = [bytes.fromhex(address[i:i + 8])[::-1] for i in range(0, len(address), 8)]
    return plain_address(str(ipaddress.ip_address(b"".join(words)))), int(port, 16)
