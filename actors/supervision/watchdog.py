"""The watchdogs that guard a run from outside: a device of the kernel, and systemd.

The root feeds them each time the supervisor reports that it and the FTM Manager work, four times a
second. If root, supervisor or manager hangs for longer than a watchdog's time, that watchdog acts:
the device resets the machine, and systemd ends and restarts the unit.
"""

from __future__ import annotations

import contextlib
import io
import os
import socket

_DISARM = b"V"
"""Magic character of Linux watchdog drivers: the close that follows does not reset the machine."""


class Watchdogs:
    """The watchdogs of one run.

    Args:
        device: Path of the device, "" for none. It is armed from now on.

    Raises:
        OSError: The device cannot be opened.
    """

    def __init__(self, device: str) -> None:
        address = os.environ.pop("NOTIFY_SOCKET", "")  # the run's processes must not use it
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._systemd.setblocking(False)
        self._device = self._open(device) if device else None
        self._is_ready = False

    @staticmethod
    def _open(device: str) -> io.FileIO:
        return io.FileIO(os.open(device, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC), "w")

    def feed(self) -> None:
        """Report that the run is well; the first time, that it has started."""
        self._write(b".")
        self._notify("WATCHDOG=1" if self._is_ready else "READY=1\nWATCHDOG=1")
        self._is_ready = True

    def end(self) -> None:
        """Disarm the device: the run has ended in order."""
        self._notify("STOPPING=1")
        self._write(_DISARM)
        self.release()

    def release(self) -> None:
        """Close this process's descriptors; a device stays armed."""
        self._systemd.close()
        if self._device is not None:
            self._device.close()
            self._device = None

    def _write(self, data: bytes) -> None:
        if self._device is not None:
            with contextlib.suppress(OSError):  # then the device acts
                self._device.write(data)

    def _notify(self, text: str) -> None:
        if self._address:
            with contextlib.suppress(OSError):
                self._systemd.sendto(text.encode(), self._address)
