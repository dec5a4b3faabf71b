"""Who is at the other end of a unix socket, and what that process is doing."""

from __future__ import annotations

import os
import socket
import struct

_CREDENTIALS = struct.Struct("3i")
_STAT_BYTES = 4096


def peer(connection: socket.socket) -> tuple[int, int]:
    """Return process and user at the other end, as the kernel knows them (unix(7), SO_PEERCRED)."""
    pid, uid, _gid = _CREDENTIALS.unpack(
        connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return pid, uid


def is_same_user(connection: socket.socket) -> bool:
    """Whether the process at the other end belongs to this user."""
    return peer(connection)[1] == os.getuid()


def receive_signed(connection: socket.socket, size: int) -> tuple[bytes, int]:
    """Receive one datagram and return it with the process that sent it, as the kernel knows it.

    The socket needs SO_PASSCRED (unix(7)) before the datagram is sent. The process is 0 if the
    sender belongs to another user, or if there was none: the connection was closed.

    Raises:
        BlockingIOError: there is none yet.
        OSError: the connection is broken.
    """
    data, ancillary, _flags, _address = connection.recvmsg(
        size, socket.CMSG_SPACE(_CREDENTIALS.size))
    for level, kind, content in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            pid, uid, _gid = _CREDENTIALS.unpack(content)
            return data, pid if uid == os.getuid() else 0
    return data, 0


def process_state(pid: int) -> str:
    """Return the state letter of /proc/PID/stat, or "X" if there is no such process."""
    stat = stat_fields(pid)
    return stat[0].decode() if stat else "X"


def stat_fields(pid: int) -> list[bytes]:
    """Return the fields of /proc/PID/stat after the name; none if there is no such process."""
    try:  # a third of what pathlib takes; of the routers it is asked 66 times a second
        stat = os.open(f"/proc/{pid}/stat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return []
    try:
        return os.read(stat, _STAT_BYTES).rpartition(b")")[2].split()
    except OSError:
        return []
    finally:
        os.close(stat)
