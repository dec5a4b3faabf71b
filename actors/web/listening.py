"""Sockets that listen."""

from __future__ import annotations

import errno
import os
import socket


class PortError(OSError):
    """An address cannot be served.

    Attributes:
        is_taken: the host is right, and another program has the port, or no user may have it.
    """

    def __init__(self, text: str, is_taken: bool) -> None:
        super().__init__(text)
        self.is_taken = is_taken


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address; with port 0 the kernel chooses one.

    The next incarnation of a server gets the port although old connections linger.

    Raises:
        PortError: the address is unknown, not one of this machine, or in use.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server(
            (host, port), family=family, dualstack_ipv6=family == socket.AF_INET6)
    except (OSError, OverflowError, UnicodeError) as error:
        number = getattr(error, "errno", None) or 0
        why = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or error
        raise PortError(f"cannot serve on {host} port {port}: {why}; choose another port",
                        number in {errno.EADDRINUSE, errno.EACCES}) from None
