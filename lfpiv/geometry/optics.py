"""Nominal optics of a plenoptic camera, and the lattice of its microlens array, in millimetres.

(u, v) is a point on the main lens's pupil, (s, t) a point on the microlens array.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

LAYOUTS = ("square", "hexagonal")
NEIGHBOURS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
"""Lattice steps to the eight neighbours of a node, shape (8, 2)."""


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Nominal optics of one plenoptic camera, as data sheets state them (Table 2 of the paper)."""

    focal_length_mm: float
    """Main lens focal length f [mm]."""
    magnification: float
    """Main lens magnification M, of either sign."""
    f_number: float
    """Main lens f-number N."""
    microlens_pitch_mm: float
    """Microlens pitch p_m [mm]."""
    microlens_focal_length_mm: float
    """Microlens focal length f_m, equal to the distance of the sensor behind the array [mm]."""
    pixel_mm: float
    """Pixel pitch [mm]."""
    sensor_shape: tuple[int, int]
    """Sensor size [pixel], order (rows, columns)."""
    layout: str = "square"
    """Microlens layout, "square" or "hexagonal"."""

    @property
    def object_distance_mm(self) -> float:
        """Distance of the focal plane from the main lens, ``s_o = f (1 + 1/|M|)`` [mm]."""
        return self.focal_length_mm * (1 + 1 / abs(self.magnification))

    @property
    def image_distance_mm(self) -> float:
        """Distance of the microlens array from the main lens, ``s_i = f (1 + |M|)`` [mm]."""
        return self.focal_length_mm * (1 + abs(self.magnification))

    @property
    def pupil_radius_mm(self) -> float:
        """Radius of the main lens pupil, R = f / 2N [mm]."""
        return self.focal_length_mm / (2 * self.f_number)

    @property
    def sensor_per_pupil(self) -> float:
        """Image scale of the pupil behind a microlens, f_m / s_i (Eq. 9)."""
        return self.microlens_focal_length_mm / self.image_distance_mm

    @property
    def pupil_pixel_mm(self) -> float:
        """Width of one pixel projected on the pupil, pixel * s_i / f_m [mm]."""
        return self.pixel_mm / self.sensor_per_pupil

    @property
    def microimage_pitch_px(self) -> float:
        """Pitch of the microimages on the sensor, p_m (1 + f_m/s_i) / pixel [pixel]."""
        return self.microlens_pitch_mm * (1 + self.sensor_per_pupil) / self.pixel_mm

    def sensor_mm(self, position_px: np.ndarray) -> np.ndarray:
        """Return positions on the sensor [mm] from (column, row) [pixel], whole numbers at the pixels' centres.

        The origin is the sensor's centre; pixel i spans [i - n/2, i + 1 - n/2] * pixel.
        """
        rows, columns = self.sensor_shape
        return (np.asarray(position_px, float) + 0.5 - np.array([columns, rows]) / 2) * self.pixel_mm

    def sensor_px(self, position_mm: np.ndarray) -> np.ndarray:
        """Return (column, row) [pixel] from positions on the sensor [mm]; inverse of `sensor_mm`."""
        rows, columns = self.sensor_shape
        return np.asarray(position_mm, float) / self.pixel_mm + np.array([columns, rows]) / 2 - 0.5


def spread_over_pupil(radius_mm: float) -> np.ndarray:
    """Return points spread evenly over the pupil: the centre and rings of 6, 12 and 18, shape (37, 2) [mm]."""
    rings = [np.zeros((1, 2))]
    for ring in (1, 2, 3):
        angle = (np.arange(6 * ring) + 0.5 * (ring % 2)) * np.pi / (3 * ring)
        rings.append(ring / 3 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return radius_mm * np.concatenate(rings)


def random_on_pupil(radius_mm: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points evenly over the pupil, shape (count, 2) [mm]."""
    radius, angle = radius_mm * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def float_pair(values: ArrayLike) -> tuple[float, float]:
    """Return two numbers as a tuple of Python floats."""
    first, second = np.asarray(values, float).tolist()
    return first, second


@dataclass(frozen=True, kw_only=True)
class LensLattice:
    """Lattice of a microlens array: lens (i, j) has its centre at origin + i basis[0] + j basis[1].

    A ray belongs to the lens with the nearest centre.
    """

    origin_mm: tuple[float, float]
    """Centre (s, t) of lens (0, 0), a lens near the sensor's centre [mm]."""
    basis_mm: tuple[tuple[float, float], tuple[float, float]]
    """Lattice vectors (s, t) to the neighbours (1, 0) and (0, 1) [mm]; 90 or 60 degrees apart."""
    layout: str = "square"
    """"square" or "hexagonal"."""

    @property
    def pitch_mm(self) -> float:
        """Distance between neighbouring lenses, from the area of a lattice cell [mm]."""
        area = abs(np.linalg.det(np.asarray(self.basis_mm)))
        return float(np.sqrt(area * (2 / np.sqrt(3) if self.layout == "hexagonal" else 1)))

    def centres_mm(self, index: np.ndarray) -> np.ndarray:
        """Return the lens centres (s, t) of lattice indices (i, j) [mm], shape (..., 2)."""
        return np.asarray(self.origin_mm) + np.asarray(index, float) @ np.asarray(self.basis_mm)

    def nearest(self, position_mm: np.ndarray) -> np.ndarray:
        """Return the lattice index (i, j) of the lens nearest to each position (s, t) [mm], shape (..., 2).

        Examples
        --------
        >>> from lfpiv import LensLattice
        >>> lattice = LensLattice(origin_mm=(0.0, 0.0), basis_mm=((0.1, 0.0), (0.0, 0.1)))
        >>> lattice.nearest([[0.12, -0.04], [0.26, 0.0]]).tolist()
        [[1, 0], [3, 0]]
        """
        offset = np.asarray(position_mm, float) - np.asarray(self.origin_mm)
        guess: np.ndarray = np.rint(offset @ np.linalg.inv(np.asarray(self.basis_mm)))
        best, best_distance = guess.copy(), np.full(guess.shape[:-1], np.inf)
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                candidate = guess + (i, j)
                distance = ((offset - candidate @ np.asarray(self.basis_mm)) ** 2).sum(-1)
                closer = distance < best_distance - 1e-15
                best[closer], best_distance[closer] = candidate[closer], distance[closer]
        return best.astype(int)
