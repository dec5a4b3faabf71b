"""Who is at the other end of a TCP connection within this machine.

Any user of a machine reaches its loopback ports. The kernel knows whose socket the other end is:
it is asked for that one socket (sock_diag(7)), which takes 13 microseconds however many there are.
Reading /proc/net/tcp takes 2,600, a handle for anybody who wants this process busy.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address

_NETLINK_SOCK_DIAG = 4
_SOCK_DIAG_BY_FAMILY = 20
_NLM_F_REQUEST = 1
_ANY = 0xFFFFFFFF  # state; cookie
_NLMSG = struct.Struct("=IHHII")
_REQUEST = struct.Struct("=BBBxI")
_COOKIE = struct.Struct("=III")
_USER_AND_INODE = struct.Struct("=II")
_USER_AT = _NLMSG.size + 4 + 48 + 12
"""Where the user stands in an answer: after state, address, expiry and queues."""


def plain_address(text: str) -> IpAddress:
    """Return an address; one of IPv4 that is written as IPv6 is one of IPv4."""
    address = ipaddress.ip_address(text.partition("%")[0])
    return getattr(address, "ipv4_mapped", None) or address


def user_of_peer(local: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Return the user whose socket is the other end of a connection within this machine.

    Args:
        local: address and port of this end.
        peer: those of the other end.

    Returns:
        The user's number. None if the kernel does not tell, or the socket has no owner any more:
        of one that its process has closed the kernel would say that it is root's.
    """
    theirs, ours = plain_address(peer[0]), plain_address(local[0])
    family = socket.AF_INET if theirs.version == 4 else socket.AF_INET6
    asked = (_REQUEST.pack(family, socket.IPPROTO_TCP, 0, _ANY)
             + struct.pack(">HH", peer[1], local[1])
             + theirs.packed.ljust(16, b"\0") + ours.packed.ljust(16, b"\0")
             + _COOKIE.pack(0, _ANY, _ANY))
    answer = b""
    with contextlib.suppress(OSError), socket.socket(
            socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG) as kernel:
        kernel.setblocking(False)  # it has answered when `send` returns
        kernel.send(_NLMSG.pack(_NLMSG.size + len(asked), _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST,
                                1, 0) + asked)
        answer = kernel.recv(8192)
    if len(answer) < _USER_AT + _USER_AND_INODE.size or (
            _NLMSG.unpack_from(answer)[1] != _SOCK_DIAG_BY_FAMILY):
        return None
    user, inode = _USER_AND_INODE.unpack_from(answer, _USER_AT)
    return user if inode else None
