"""A joystick of this machine, read through the kernel's joystick interface.

`/dev/input/jsN` is a stream of 8-byte records, `struct js_event` of <linux/joystick.h>, described
in the kernel's Documentation/input/joydev/joystick-api.rst: milliseconds, value, type, number. When
the device is opened, and after an overflow of its queue, the kernel first sends the state of each
button and axis in records marked as initial.

A button that is already down when the device is opened does not count as pressed: the dead man
requires a press. So neither a stuck button nor a gamepad that is plugged in again moves the robot.

A FIFO or pseudo-terminal with the same records is a virtual joystick.
"""

from __future__ import annotations

import asyncio
import math
import os
import re
import stat
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from rampart.actors.osmosis.messages import Joystick

AUTO = "auto"
"""Name of the first joystick found."""

EVENT = struct.Struct("=IhBB")
"""`struct js_event`: time in ms, value, type, number of the button or axis."""

BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80
"""Types of records; the last is the flag of an initial state."""

FULL_SCALE = 32767
_DEVICES = Path("/dev/input")
_READ_BYTES = 64 * EVENT.size
_NUMBER = re.compile(r"js(\d+)$")


class ForeignDeviceError(Exception):
    """The device does not send joystick records; one line."""


Number = Annotated[int, msgspec.Meta(ge=0, le=255)]
Sign = Literal[-1, 1]


class StickMapping(msgspec.Struct, frozen=True):
    """Axes and button of a device; the defaults suit common gamepads.

    Attributes:
        forward_axis: number of the axis for forward and back.
        left_axis: number of the axis for turning left and right.
        forward_sign: -1 if the axis grows backwards, as in the kernel.
        left_sign: -1 if the axis grows to the right, as in the kernel.
        dead_man_button: number of the button to hold while driving (4: the left shoulder).
        dead_zone: share of the range around the centre that counts as 0; the rest is scaled, so
            that the speed begins at zero.
    """

    forward_axis: Number = 1
    left_axis: Number = 0
    forward_sign: Sign = -1
    left_sign: Sign = -1
    dead_man_button: Number = 4
    dead_zone: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.1

    def __post_init__(self) -> None:
        """Check that the axes differ."""
        if self.forward_axis == self.left_axis:
            raise ValueError("left_axis: expected another axis than forward_axis")


class StickDecoder:
    """Decodes records to the position of the joystick. Pure.

    Args:
        mapping: axes and button.
    """

    def __init__(self, mapping: StickMapping) -> None:
        self._mapping = mapping
        self._rest = b""
        self._axes = {mapping.forward_axis: 0, mapping.left_axis: 0}
        self._pressed = False

    def feed(self, data: bytes) -> None:
        """Take bytes; an incomplete record waits for its rest.

        Raises:
            ForeignDeviceError: a record is neither of a button nor of an axis.
        """
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest = data[whole:]
        for _time_ms, value, kind, number in EVENT.iter_unpack(data[:whole]):
            if kind & ~INITIAL == BUTTON:
                if number == self._mapping.dead_man_button:
                    self._pressed = bool(value) and (self._pressed or not kind & INITIAL)
            elif kind & ~INITIAL == AXIS:
                if number in self._axes:
                    self._axes[number] = value
            else:
                raise ForeignDeviceError(
                    f"event type 0x{kind:02x}: expected 0x01 (button) or 0x02 (axis)")

    @property
    def stick(self) -> Joystick:
        """Position of the joystick."""
        mapping = self._mapping
        return Joystick(self._position(mapping.forward_axis, mapping.forward_sign),
                        self._position(mapping.left_axis, mapping.left_sign), self._pressed)

    def _position(self, axis: int, sign: int) -> float:
        share = min(abs(self._axes[axis]) / FULL_SCALE, 1.0)
        zone = self._mapping.dead_zone
        if share <= zone:
            return 0.0
        return math.copysign((share - zone) / (1.0 - zone), sign * self._axes[axis])


def device_path(name: str, directory: Path = _DEVICES) -> str:
    """Return the path of a device; for `AUTO` the first one found, or ""."""
    if name != AUTO:
        return name
    found = [(int(match[1]), entry) for entry in directory.glob("js*")
             if (match := _NUMBER.match(entry.name))]
    return str(min(found)[1]) if found else ""


class JoystickDevice:
    """Reads a device on the event loop without blocking.

    Args:
        name: path of the device, or `AUTO`.
        mapping: axes and button.
        moved: called after each read; `stick` is the new position.
        gone: called with the reason when an open device has failed.
    """

    def __init__(self, name: str, mapping: StickMapping, moved: Callable[[], None],
                 gone: Callable[[str], None]) -> None:
        self.path = name
        self._name = name
        self._mapping = mapping
        self._decoder = StickDecoder(mapping)
        self._moved = moved
        self._gone = gone
        self._file: int | None = None

    @property
    def stick(self) -> Joystick:
        """Position of the joystick; centred and released without a device."""
        return self._decoder.stick

    def open(self) -> str:
        """Open the device; return why that failed, or ""."""
        self.path = device_path(self._name)
        if not self.path:
            return f"no joystick in {_DEVICES}"
        try:
            mode = Path(self.path).stat().st_mode
            if not (stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)):
                return "neither a device nor a FIFO"
            file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        except (OSError, ValueError) as error:
            return getattr(error, "strerror", None) or str(error)
        try:
            asyncio.get_running_loop().add_reader(file, self._readable)
        except OSError as error:  # a device without poll, such as /dev/zero
            os.close(file)
            return f"not a joystick: {error.strerror}"
        self._decoder = StickDecoder(self._mapping)
        self._file = file
        return ""

    def close(self) -> None:
        """Close the device and release the joystick; idempotent."""
        file, self._file = self._file, None
        self._decoder = StickDecoder(self._mapping)
        if file is not None:
            asyncio.get_running_loop().remove_reader(file)
            os.close(file)

    def _readable(self) -> None:
        if self._file is None:
            return
        try:
            data = os.read(self._file, _READ_BYTES)
            self._decoder.feed(data)
        except BlockingIOError:
            return
        except (OSError, ForeignDeviceError) as error:
            self._lost(getattr(error, "strerror", None) or str(error))
            return
        if data:
            self._moved()
        else:
            self._lost("ended")

    def _lost(self, why: str) -> None:
        self.close()
        self._gone(why)
