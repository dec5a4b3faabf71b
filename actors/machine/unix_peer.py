"""The peer of a unix socket, and the state of a process."""

from __future__ import annotations

import os
import socket
import struct

_CREDENTIALS = struct.Struct("3i")
_STAT_BYTES = 4096


def peer(connection: socket.socket) -> tuple[int, int]:
    """Return pid and user id of the process at the other end (unix(7), SO_PEERCRED)."""
    pid, uid, _gid = _CREDENTIALS.unpack(
        connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return pid, uid


def is_same_user(connection: socket.socket) -> bool:
    """Whether the process at the other end belongs to this user."""
    return peer(connection)[1] == os.getuid()


def receive_signed(connection: socket.socket, size: int) -> tuple[bytes, int]:
    """Receive one datagram; return it with the pid of its sender, by the kernel.

    The socket needs SO_PASSCRED (unix(7)) before the datagram is sent. The pid is 0 if the sender
    belongs to another user, or if the connection was closed.

    Raises:
        BlockingIOError: No datagram waits.
        OSError: The connection is broken.
    """
    data, ancillary, _flags, _address = connection.recvmsg(
        size, socket.CMSG_SPACE(_CREDENTIALS.size))
    for level, kind, content in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            pid, uid, _gid = _CREDENTIALS.unpack(content)
            return data, pid if uid == os.getuid() else 0
    return data, 0


def process_state(pid: int | str) -> str:
    """Return the state letter of a process, or of a thread PID/task/TID; "X" if it has ended."""
    stat = stat_fields(pid)
    return stat[0].decode() if stat else "X"


def stat_fields(pid: int | str) -> list[bytes]:
    """Return the fields of /proc/PID/stat after the name; none if there is no such process."""
    try:  # a third of the time of pathlib; the supervisor calls this 66 times a second
        stat = os.open(f"/proc/{pid}/stat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return []
    try:
        return os.read(stat, _STAT_BYTES).rpartition(b")")[2].split()
    except OSError:
        return []
    finally:
        os.close(stat)
