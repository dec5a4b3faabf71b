"""An extended Kalman filter on the planar pose, with its 3x3 algebra written out.

State: x m, y m, yaw rad of `base_link` in `map`. It is predicted by the motion of wheels and gyro,
and corrected by positions and headings. The caller gates measurements by `position_nis` and
`heading_nis` (normalised innovation squared; Bar-Shalom, Li, Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 5.4).

Plain floats: at 50 predictions a second numpy's calls would cost ten times the arithmetic.
"""

from __future__ import annotations

import math

from rampart.actors.osmosis.control.polyline import wrap_angle


class PlanarEkf:
    """Pose with its covariance.

    Args:
        x_m: position in `map`.
        y_m: position in `map`.
        yaw_rad: heading in `map`.
        position_sd_m: standard deviation of each coordinate.
        heading_sd_rad: standard deviation of the heading.

    Attributes:
        x_m: estimate.
        y_m: estimate.
        yaw_rad: estimate, in [-pi, pi].
    """

    __slots__ = ("_ww", "_xw", "_xx", "_xy", "_yw", "_yy", "x_m", "y_m", "yaw_rad")

    def __init__(self, x_m: float, y_m: float, yaw_rad: float, position_sd_m: float,
                 heading_sd_rad: float) -> None:
        self.x_m, self.y_m, self.yaw_rad = x_m, y_m, wrap_angle(yaw_rad)
        self._xx = self._yy = position_sd_m**2
        self._ww = heading_sd_rad**2
        self._xy = self._xw = self._yw = 0.0

    @property
    def position_sd_m(self) -> float:
        """Standard deviation along the worse axis of the position's error ellipse, m."""
        half = (self._xx - self._yy) / 2
        return math.sqrt(max(0.0, (self._xx + self._yy) / 2 + math.hypot(half, self._xy)))

    @property
    def heading_sd_rad(self) -> float:
        """Standard deviation of the heading, rad."""
        return math.sqrt(self._ww)

    def predict(self, forward_m: float, turn_rad: float, variance_m2: float,
                variance_rad2: float) -> tuple[float, float]:
        """Predict by a measured motion; return the displacement in `map`.

        Args:
            forward_m: distance along `base_link`'s x.
            turn_rad: change of heading.
            variance_m2: variance of the distance, for each coordinate.
            variance_rad2: variance of the turn.
        """
        middle = self.yaw_rad + turn_rad / 2
        dx, dy = forward_m * math.cos(middle), forward_m * math.sin(middle)
        self.x_m += dx
        self.y_m += dy
        self.yaw_rad = wrap_angle(self.yaw_rad + turn_rad)
        # P <- F P F' + Q with F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]].
        xw, yw, ww = self._xw, self._yw, self._ww
        self._xx += -2 * dy * xw + dy * dy * ww + variance_m2
        self._xy += dx * xw - dy * yw - dx * dy * ww
        self._yy += 2 * dx * yw + dx * dx * ww + variance_m2
        self._xw = xw - dy * ww
        self._yw = yw + dx * ww
        self._ww = ww + variance_rad2
        return dx, dy

    def position_nis(self, x_m: float, y_m: float, variance_m2: float) -> float:
        """Return the normalised innovation squared of a position: chi-square of 2 degrees."""
        a, b, c = self._xx + variance_m2, self._xy, self._yy + variance_m2
        dx, dy = x_m - self.x_m, y_m - self.y_m
        return (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)

    def update_position(self, x_m: float, y_m: float, variance_m2: float) -> None:
        """Correct by a position in `map`."""
        a, b, c = self._xx + variance_m2, self._xy, self._yy + variance_m2
        determinant = a * c - b * b
        i_xx, i_xy, i_yy = c / determinant, -b / determinant, a / determinant
        xx, xy, yy, xw, yw = self._xx, self._xy, self._yy, self._xw, self._yw
        # K = P H' S^-1, rows x, y, yaw.
        kxx, kxy = xx * i_xx + xy * i_xy, xx * i_xy + xy * i_yy
        kyx, kyy = xy * i_xx + yy * i_xy, xy * i_xy + yy * i_yy
        kwx, kwy = xw * i_xx + yw * i_xy, xw * i_xy + yw * i_yy
        dx, dy = x_m - self.x_m, y_m - self.y_m
        self.x_m += kxx * dx + kxy * dy
        self.y_m += kyx * dx + kyy * dy
        self.yaw_rad = wrap_angle(self.yaw_rad + kwx * dx + kwy * dy)
        self._xx = xx - kxx * xx - kxy * xy
        self._xy = xy - kxx * xy - kxy * yy
        self._yy = yy - kyx * xy - kyy * yy
        self._xw = xw - kxx * xw - kxy * yw
        self._yw = yw - kyx * xw - kyy * yw
        self._ww -= kwx * xw + kwy * yw

    def heading_nis(self, yaw_rad: float, variance_rad2: float) -> float:
        """Return the normalised innovation squared of a heading: chi-square of 1 degree."""
        return wrap_angle(yaw_rad - self.yaw_rad) ** 2 / (self._ww + variance_rad2)

    def update_heading(self, yaw_rad: float, variance_rad2: float) -> None:
        """Correct by a heading in `map`."""
        total = self._ww + variance_rad2
        off = wrap_angle(yaw_rad - self.yaw_rad)
        xw, yw, ww = self._xw, self._yw, self._ww
        self.x_m += xw / total * off
        self.y_m += yw / total * off
        self.yaw_rad = wrap_angle(self.yaw_rad + ww / total * off)
        self._xx -= xw * xw / total
        self._xy -= xw * yw / total
        self._yy -= yw * yw / total
        self._xw = xw * variance_rad2 / total
        self._yw = yw * variance_rad2 / total
        self._ww = ww * variance_rad2 / total

    def doubt(self, sd_m: float, sd_rad: float = 0.0) -> None:
        """Increase the uncertainty after wrong corrections."""
        self._xx += sd_m * sd_m
        self._yy += sd_m * sd_m
        self._ww += sd_rad * sd_rad
