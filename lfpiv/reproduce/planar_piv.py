"""Planar PIV of a known flow: particle images of a light sheet by a conventional camera, processed by OpenPIV.

OpenPIV is GPL and optional (extra ``piv2d``): it is imported where it is used, and nowhere else in this package.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from lfpiv.errors import InputError
from lfpiv.simulation.scene import Noise
from lfpiv.simulation.sensor import FULL_SCALE


@dataclass(frozen=True, kw_only=True)
class SheetCamera:
    """A camera that looks along -z at a light sheet; the defaults are Table 2's conventional camera."""

    focal_length_mm: float = 100.0
    magnification: float = 0.33
    pixel_mm: float = 4.45e-3
    particle_px: float = 0.625
    """Standard deviation of a particle's image [pixel]: 2.5 pixels across at 1/e^2, slightly out of focus to avoid peak
    locking. Diffraction would give 0.2."""
    sheet_mm: float = 0.5
    """Half thickness of the Gaussian sheet at 1/e^2 of its intensity [mm]. The paper does not state it."""
    particles_per_px: float = 8 / 32**2
    """Particles within the sheet's thickness per pixel: eight in each window of 32 x 32."""
    peak_counts: float = 1500.0
    """All light of a particle in the middle of the sheet, summed over its pixels [count]."""
    axis_mm: tuple[float, float] = (0.0, 0.0)
    """Point (x, y) where the camera's axis meets the sheet [mm]."""

    @property
    def pixel_in_sheet_mm(self) -> float:
        """Pixel pitch in the sheet [mm]."""
        return self.pixel_mm / self.magnification

    @property
    def object_distance_mm(self) -> float:
        """Lens to sheet, f (1 + 1/M) [mm]."""
        return self.focal_length_mm * (1 + 1 / self.magnification)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanarVectors:
    """Vectors of one pair in one plane, y rising."""

    x_mm: np.ndarray
    y_mm: np.ndarray
    displacement_mm: np.ndarray
    """In-plane displacement (x, y) [mm], shape (y, x, 2); NaN where OpenPIV found no valid vector."""


def require_openpiv() -> None:
    """Raise InputError if OpenPIV is not installed."""
    try:
        import openpiv.windef  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"lsi: expected OpenPIV for the planar PIV, it cannot be imported ({error}). Install the extra piv2d: "
            "pip install 'lfpiv[piv2d]'."
        ) from None


def sheet_images(
    camera: SheetCamera,
    flow: Callable[[np.ndarray], np.ndarray],
    *,
    plane_mm: float,
    field_mm: tuple[tuple[float, float], tuple[float, float]],
    noise: Noise,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Render both frames of one pair: Gaussian particle images, integrated over the pixels, with noise and 12 bits.

    Parameters
    ----------
    camera : SheetCamera
        Camera and light sheet.
    flow : callable
        Points (n, 3) to displacements (n, 3) between the frames [mm].
    plane_mm : float
        Depth z of the sheet, where the camera is focused [mm].
    field_mm : ((float, float), (float, float))
        Low and high corner (x, y) of the part of the sensor that is read, in the sheet [mm].
    noise : Noise
        Background, read-out and shot noise.
    rng : numpy.random.Generator
        Source of particles and noise.

    Returns
    -------
    tuple of ndarray, shape (rows, columns), uint16
        The first row is the highest y.
    """
    pixel = camera.pixel_in_sheet_mm
    low, high = np.asarray(field_mm[0]), np.asarray(field_mm[1])
    columns, rows = (round(n) for n in (high - low) / pixel)
    margin = 32 * pixel  # particles that move into the field
    size = np.array([*(high - low + 2 * margin), 6 * camera.sheet_mm])
    # the number of particles in an evenly lit sheet of the same thickness
    count = round(camera.particles_per_px * size[0] * size[1] / pixel**2 * size[2] / (2 * camera.sheet_mm))
    middle = np.array([*(low + high) / 2, plane_mm])
    position = middle + rng.uniform(-0.5, 0.5, (count, 3)) * size
    displacement = flow(position)
    frames = []
    for sign in (-0.5, 0.5):
        x, y, z = (position + sign * displacement).T
        light = camera.peak_counts * np.exp(-2 * ((z - plane_mm) / camera.sheet_mm) ** 2)
        scale = camera.object_distance_mm / (camera.object_distance_mm - (z - plane_mm))
        seen_x = camera.axis_mm[0] + (x - camera.axis_mm[0]) * scale
        seen_y = camera.axis_mm[1] + (y - camera.axis_mm[1]) * scale
        image = _draw((seen_x - low[0]) / pixel, (high[1] - seen_y) / pixel, light, camera.particle_px, (rows, columns))
        if noise.full_well_e > 0:
            per_count = noise.full_well_e / FULL_SCALE
            image = rng.poisson(image * per_count) / per_count
        image = image + noise.background + noise.read_noise * rng.standard_normal(image.shape)
        frames.append(np.clip(np.rint(image), 0, FULL_SCALE).astype(np.uint16))
    return frames[0], frames[1]


def _draw(column: np.ndarray, row: np.ndarray, light: np.ndarray, sigma: float, shape: tuple[int, int]) -> np.ndarray:
    """Draw Gaussians integrated over pixels. Pixel (i, j) spans rows i to i + 1 and columns j to j + 1."""
    reach = int(np.ceil(4 * sigma)) + 1
    image = np.zeros((shape[0] + 2 * reach, shape[1] + 2 * reach))
    inside = (column > 0) & (column < shape[1]) & (row > 0) & (row < shape[0])
    column, row, light = column[inside], row[inside], light[inside]
    offset = np.arange(-reach, reach + 1)

    def shares(at: np.ndarray) -> np.ndarray:
        edge = np.floor(at)[:, None] + np.append(offset, reach + 1) - at[:, None]
        return np.diff(ndtr(edge / sigma), axis=1)

    patch = light[:, None, None] * shares(row)[:, :, None] * shares(column)[:, None, :]
    rows = np.floor(row).astype(int)[:, None, None] + reach + offset[:, None]
    columns = np.floor(column).astype(int)[:, None, None] + reach + offset
    np.add.at(image, (rows, columns), patch)
    return image[reach:-reach, reach:-reach]


def correlate_frames(
    first: np.ndarray,
    second: np.ndarray,
    camera: SheetCamera,
    field_mm: tuple[tuple[float, float], tuple[float, float]],
) -> PlanarVectors:
    """Correlate a pair by OpenPIV in windows of 64, 32 and 32 pixels, half overlapping, the last two deformed."""
    from openpiv import windef
    from openpiv.settings import PIVSettings

    settings = PIVSettings()
    settings.windowsizes, settings.overlap, settings.num_iterations = (64, 32, 32), (32, 16, 16), 3
    with contextlib.redirect_stdout(io.StringIO()):  # its validation prints
        x, y, u, v, flags = windef.simple_multipass(first.astype(np.float32), second.astype(np.float32), settings)
    pixel = camera.pixel_in_sheet_mm
    # OpenPIV gives v upwards, vectors from the top row down, and their rows in reverse
    row = np.asarray(y)[::-1, 0]
    displacement = np.where(np.asarray(flags, bool)[..., None], np.nan, np.stack([u, v], axis=-1)) * pixel
    return PlanarVectors(
        x_mm=field_mm[0][0] + np.asarray(x)[0] * pixel,
        y_mm=field_mm[1][1] - row[::-1] * pixel,
        displacement_mm=displacement[::-1],
    )
