"""The tug's own detection module: it will not stop in time."""

from __future__ import annotations

from rampart import DetectionModule, Header, on
from tug import topics
from tug.topics import Free, Motion

BRAKES_MPS2, LATENCY_S = 2.5, 0.15


class TooClose(DetectionModule):
    """Active while the stopping distance exceeds the free way. Suspects the pilot."""

    _speed_mps, _pilot = 0.0, "pilot"

    @on(topics.WHEELS)
    def wheels(self, message: Motion, _header: Header) -> None:
        """Note the speed."""
        self._speed_mps = abs(message.speed_mps)

    @on(topics.DRIVE)
    def drive(self, _message: Motion, header: Header) -> None:
        """Note the pilot's incarnation."""
        self._pilot = f"pilot#{header.incarnation}"

    @on(topics.FREE)
    def free(self, message: Free, _header: Header) -> None:
        """Compare stopping distance and free way."""
        stops_m = self._speed_mps * LATENCY_S + self._speed_mps**2 / (2 * BRAKES_MPS2)
        if self._speed_mps > 0.05 and stops_m > message.free_m:
            self.activate(f"{stops_m:.2f} m to stop, {message.free_m:.2f} m free", (self._pilot,))
        else:
            self.know_idle()
