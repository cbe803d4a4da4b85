"""What surrounds the particles in an image: level and noise of its background, measured where no particle lights it.

Particle images of thin seeding are mostly background, as images of stars are. Level and noise are measured in tiles of
the sensor by clipping bright pixels [1]_, and interpolated between the tiles.

.. [1] E. Bertin, S. Arnouts, "SExtractor: Software for source extraction", Astron. Astrophys. Suppl. 117 (1996)
   393-404, doi:10.1051/aas:1996164, section 4.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lfpiv.geometry.optics import LensLattice, Optics

TILE_PX = 48
"""Edge of a tile [pixel]."""
LEAST_PIXELS = 200
"""Least number of pixels that tell level and noise of a tile."""
CLIP_SIGMA, CLIPS = 2.5, 5
"""Distance from the median above which a pixel is lit [standard deviation], and how often such pixels are left out."""
LEAST_DARK = 0.4
"""Least share of a tile's pixels that are not clipped, for the tile to show its background."""
LEAST_NOISE = 0.3
"""Least noise: that of rounding [counts]."""
CLASSES = 8
"""Classes of brightness of standing light."""
EDGE_PX = 1.0
"""Width of the edge of a microimage that is left out [pixel]."""
ONE_SIGMA = 15.87
"""Percentile of a normal distribution at one standard deviation below its mean."""
LARGEST_LEVEL = 3.0
"""Largest level of a tile [noise]: what is brighter is light of particles."""


def whole_pixels(optics: Optics, lattice: LensLattice) -> np.ndarray:
    """Return the pixels that lie inside a microimage, shape (rows, columns), bool: stray light is dark between them."""
    widening = (1 + optics.sensor_per_pupil) / optics.pixel_mm
    rows, columns = optics.sensor_shape
    half = np.array([columns, rows]) / 2
    place = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1)
    index = ((place - half) / widening - np.asarray(lattice.origin_mm)) @ np.linalg.inv(np.asarray(lattice.basis_mm))
    off = place - (lattice.centres_mm(np.rint(index)) * widening + half)
    radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    return np.square(off).sum(-1) < max(radius - EDGE_PX, 1.0) ** 2


def surroundings(
    image: np.ndarray, noise: float, unlit: np.ndarray, standing: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return level and noise of the background of an image, as they are inside microimages.

    Where standing light was subtracted, what is left of it and its photon noise depend on how bright it is.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Image, or what particles leave of it [counts].
    noise : float
        Noise where the image does not show it [counts].
    unlit : ndarray, shape (rows, columns), bool
        Pixels that may show the background.
    standing : ndarray, shape (rows, columns), optional
        Standing light that was subtracted [counts], 0 where none stands.

    Returns
    -------
    level, noise : ndarray, shape (rows, columns), float32
        Mean and standard deviation of the background [counts].
    """
    plain = unlit if standing is None else unlit & (standing <= 0)
    rows, columns = (-(-length // TILE_PX) for length in image.shape)
    levels, noises = np.full((rows, columns), np.nan), np.full((rows, columns), np.nan)
    for row in range(rows):
        for column in range(columns):
            tile = np.s_[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
            if (found := _background(image[tile][plain[tile]])) is not None:
                levels[row, column], noises[row, column] = found
    noises = np.maximum(_filled(noises, noise), LEAST_NOISE)
    levels = np.clip(_filled(levels, 0.0), -LARGEST_LEVEL * noises, LARGEST_LEVEL * noises)
    level, deviation = _stretched(levels, image.shape), _stretched(noises, image.shape)
    if standing is not None and (standing > 0).any():
        _remains(image, unlit, standing, level, deviation)
    return level, deviation


def _remains(
    image: np.ndarray, unlit: np.ndarray, standing: np.ndarray, level: np.ndarray, deviation: np.ndarray
) -> None:
    """Measure level and noise where light stands, in classes of its brightness; change both in place."""
    inside = standing > 0
    edges = np.quantile(standing[inside], np.linspace(0, 1, CLASSES + 1)[1:-1])
    kind = np.digitize(standing, edges)
    for number in range(CLASSES):
        pixels = inside & (kind == number)
        if (found := _background(image[pixels & unlit])) is not None:
            level[pixels], deviation[pixels] = found[0], np.maximum(deviation[pixels], found[1])


def _background(counts: np.ndarray) -> tuple[float, float] | None:
    """Return mean and standard deviation of the pixels left after bright ones are clipped; None for too few."""
    if counts.size < LEAST_PIXELS:
        return None
    kept = np.sort(counts)
    for _ in range(CLIPS):
        median, low = kept[len(kept) // 2], kept[int(len(kept) * ONE_SIGMA / 100)]
        high = kept[int(len(kept) * (1 - ONE_SIGMA / 100))]
        limit = median + CLIP_SIGMA * max(median - low, (high - low) / 2, 1e-6)
        end = int(np.searchsorted(kept, limit, side="right"))
        if end == len(kept):
            break
        kept = kept[:end]
    if len(kept) < LEAST_DARK * len(counts):
        return None
    return float(kept.mean()), float(kept.std())


def _filled(values: np.ndarray, default: float) -> np.ndarray:
    """Return tiles smoothed by the median of their neighbours; `default` where no tile nearby has a value."""
    with np.errstate(all="ignore"):
        padded = np.pad(values, 1, constant_values=np.nan)
        around = np.stack(
            [padded[i : i + values.shape[0], j : j + values.shape[1]] for i in range(3) for j in range(3)]
        )
    known = np.isfinite(around).any(0)
    found = np.full(values.shape, default)
    found[known] = np.nanmedian(around[:, known], axis=0)
    return found


def _stretched(tiles: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the values of tiles interpolated to pixels."""
    place = [(np.arange(length) + 0.5) / TILE_PX - 0.5 for length in shape]
    grid = np.meshgrid(*place, indexing="ij")
    return ndimage.map_coordinates(tiles, grid, order=1, mode="nearest").astype(np.float32)
