"""Orientation of a camera about a volume: rotations from world to camera axes, from an angle or a viewing direction.

The camera's z axis points from the volume to the camera. Without roll its x axis is normal to the world's y axis, so
that rows of the picture are, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STRAIGHT = 1e-6
"""Part of a direction normal to y below which the camera looks along y, and its x axis is the world's."""


def camera_rotation(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return Rz(roll) Rx(pitch) Ry(yaw) of angles in rad, with Ry the rotation of Eqs. 1-3, shape (3, 3)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


@dataclass(frozen=True)
class Orientation:
    """Nominal orientation of a camera whose axis meets the origin."""

    yaw_deg: float
    """Angle about y (Eqs. 1-3), positive for a camera on the side of +x [degree]."""
    pitch_deg: float = 0.0
    """Angle of the axis above the plane y = 0, positive for a camera on the side of +y [degree]."""
    roll_deg: float = 0.0
    """Right-handed rotation about the camera's z axis, after yaw and pitch [degree]."""

    def __post_init__(self) -> None:
        """Check the values; raise ValueError."""
        if not all(map(math.isfinite, (self.yaw_deg, self.pitch_deg, self.roll_deg))):
            raise ValueError(f"orientation: expected finite angles [degree], got {self}.")

    @classmethod
    def from_direction(cls, direction: Sequence[float], roll_deg: float = 0.0) -> Orientation:
        """Return the orientation of a camera in a direction from the origin.

        Parameters
        ----------
        direction : (float, float, float)
            Vector (x, y, z) from the origin towards the camera, of any length. Along y the camera's x axis is the
            world's: the limit of a camera that rises from +z.
        roll_deg : float
            Right-handed rotation about the camera's z axis [degree].

        Raises
        ------
        ValueError
            If the direction is zero or a value is not finite.

        Examples
        --------
        >>> from lfpiv.geometry.orientation import Orientation
        >>> above = Orientation.from_direction((0, 1, 1))
        >>> round(above.yaw_deg, 6), round(above.pitch_deg, 6)
        (0.0, 45.0)
        """
        vector = np.asarray(direction, float)
        largest = np.abs(vector).max(initial=0.0)
        if vector.shape != (3,) or not (0 < largest < math.inf):  # false for NaN, too
            raise ValueError(f"direction: expected a finite vector (x, y, z) other than 0, got {direction}.")
        x, y, z = (vector / largest).tolist()
        beside = math.hypot(x, z)
        yaw = math.atan2(x, z) if beside > STRAIGHT * math.hypot(beside, y) else 0.0
        return cls(math.degrees(yaw), math.degrees(math.atan2(y, beside)), roll_deg)

    @property
    def rotation(self) -> np.ndarray:
        """Rotation from world to camera axes, shape (3, 3). Its last row points from the origin towards the camera."""
        return camera_rotation(*np.radians([self.yaw_deg, self.pitch_deg, self.roll_deg]))

    def away_from_z(self, angle_deg: float) -> Orientation:
        """Return the orientation with the axis turned by an angle away from z, Eqs. 11-12 [degree].

        Cameras in the plane y = 0 turn about y. A camera on the z axis turns towards +x.
        """
        if not self.pitch_deg:
            turned = self.yaw_deg + (math.copysign(angle_deg, self.yaw_deg * angle_deg) if self.yaw_deg else angle_deg)
            return Orientation(turned, 0.0, self.roll_deg)
        x, y, z = self.rotation[2].tolist()
        angle, beside = math.atan2(math.hypot(x, y), z) + math.radians(angle_deg), math.hypot(x, y)
        sine = math.sin(angle) / beside
        return Orientation.from_direction((sine * x, sine * y, math.cos(angle)), self.roll_deg)

    def __str__(self) -> str:
        """Return the orientation as text for messages and the report."""
        roll = f", rolled by {self.roll_deg:g}°" if self.roll_deg else ""
        if not self.pitch_deg:
            return f"at {self.yaw_deg:g}°{roll}"
        direction = (round(value, 3) + 0.0 for value in self.rotation[2].tolist())
        return f"in the direction ({', '.join(f'{value:g}' for value in direction)}){roll}"
