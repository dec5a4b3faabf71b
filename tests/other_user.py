"""Another user of this machine: code that runs as nobody, for which the tests must be root's."""

import os
import subprocess
import sys

import pytest

NOBODY = 65534
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can be another user")

_BECOME = f"""\
import encodings.idna, os, socket, sys, time
os.setgroups([]), os.setgid({NOBODY}), os.setuid({NOBODY})
host, port = sys.argv[1].rsplit(":", 1)
def connect():
    return socket.create_connection((host, int(port)), 5)
def told(connection):
    text = b""
    try:
        while part := connection.recv(65536):
            text += part
    except ConnectionError:
        pass
    return text.decode().replace("\\r", "")
"""


def as_nobody(at: str, code: str) -> subprocess.Popen[str]:
    """Start code as the user nobody; it has `connect()` to an address and `told(connection)`."""
    return subprocess.Popen([sys.executable, "-c", _BECOME + code, at], text=True,
                            stdin=subprocess.PIPE, stdout=subprocess.PIPE)
