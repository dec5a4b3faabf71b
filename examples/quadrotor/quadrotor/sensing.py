"""IMUs, magnetometer and the attitude that follows from them, for the estimator and each pilot."""

from __future__ import annotations

import math
from typing import ClassVar

from quadrotor import topics as t
from quadrotor.attitude import AttitudeFilter, ImuVote
from quadrotor.control import STEP_S
from quadrotor.vehicle import Vector
from rampart import Actor, Context, Header, on


class Sensing(Actor):
    """Base of pilots and estimator.

    Class attributes:
        wait_s: how long a new process waits for the attitude of another node, before it takes the
            accelerometer's.
    """

    wait_s: ClassVar[float] = 0.0

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._imus, self._filter = ImuVote(), AttitudeFilter()
        self._yaw_rad: float | None = None
        self._born_s = self.clock.now()

    @on(t.IMU_1)
    def imu_1(self, message: t.Imu, header: Header) -> None:
        """Take a reading of the first IMU."""
        self._imus.take(0, message, header.stamp)

    @on(t.IMU_2)
    def imu_2(self, message: t.Imu, header: Header) -> None:
        """Take a reading of the second IMU."""
        self._imus.take(1, message, header.stamp)

    @on(t.IMU_3)
    def imu_3(self, message: t.Imu, header: Header) -> None:
        """Take a reading of the third IMU."""
        self._imus.take(2, message, header.stamp)

    @on(t.HEADING)
    def heading(self, message: t.Heading, _header: Header) -> None:
        """Take the magnetometer's yaw."""
        if math.isfinite(message.yaw_rad):
            self._yaw_rad = message.yaw_rad

    def _sense(self) -> tuple[Vector, Vector] | None:
        """Advance the attitude by `STEP_S`.

        Returns:
            Angular rate, rad/s, and specific force, m/s², in `base_link`; None while the attitude
            is not known.
        """
        now_s = self.clock.now()
        voted = self._imus.vote(now_s)
        if voted is None:
            return None
        rate, force = voted
        if not self._filter.known:
            if now_s - self._born_s > self.wait_s and self._yaw_rad is not None:
                self._filter.level(force, self._yaw_rad)
            return None
        self._filter.step(rate, force, self._yaw_rad, STEP_S)
        return voted
