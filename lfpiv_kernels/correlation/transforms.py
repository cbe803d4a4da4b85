"""Folds and waves of the transforms along z and y by which `spectra` correlates blocks with their surroundings.

A block has offsets 0 to ``edge - 1``, its surroundings ``-search`` to ``edge - 1 + search``. Both are counted from the
block's centre, in half voxels if the edge is even, so both are symmetric. The transform is as long as the surroundings,
rounded up to an even length, so nothing wraps around within the range of lags. It is folded twice: first the values at
offsets t and -t are added and subtracted, then those at t and size / 2 - t. Even frequencies need the sums, odd ones
the differences (the reverse for sines), and a quarter of the products is left.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.transfer import to_device

ROWS = native.constant("spectra.h", "ROWS")
"""Frequencies that are computed at once; rows of the matrices along y are padded to a multiple of it."""


@wp.struct
class PlaneTransform:
    """Transform of planes along z: the arrays of `Planes` on the device."""

    quads: wp.array(dtype=int)
    rows: wp.array(dtype=int)
    matrix: wp.array(dtype=float)
    folds: int
    counts: wp.vec4i


@wp.struct
class Transform:
    """Transforms along y and back: the arrays of `Spectrum` on the device."""

    quads: wp.array(dtype=int)  # folds of a block, then of its surroundings
    folds: wp.vec3i  # how many of either; 1 if those of a block add a second pair, else 0
    matrices: wp.array(dtype=float)
    size: wp.vec2i


@dataclass(frozen=True)
class Spectrum:
    """Transforms for one shape of blocks and one range of lags."""

    size: tuple[int, int]
    """Lengths along z and y."""
    planes: tuple[Planes, Planes]
    """Along z: of a block and of its surroundings."""
    folds: tuple[np.ndarray, np.ndarray]
    """Along y: `fold` of a block and of its surroundings."""
    matrices: np.ndarray
    """Cosines and sines along y of a block and of its surroundings, (even or odd frequencies, fold, cosine or sine,
    frequency, padded to `ROWS`), then `_back` along y and along z; all in one."""

    @functools.cached_property
    def transform(self) -> Transform:
        """Device arrays for the kernel."""
        first, second = self.folds
        transform = Transform()
        transform.quads = to_device(np.concatenate(self.folds).ravel(), int)
        transform.folds = wp.vec3i(len(first), len(second), int(first[:, 2:].max() >= 0))
        transform.matrices, transform.size = to_device(self.matrices, float), wp.vec2i(*self.size)
        return transform

    @classmethod
    @functools.lru_cache
    def for_block(cls, block: tuple[int, int, int], search: tuple[int, int, int]) -> Spectrum:
        """Return the transforms for a block and a search range, order (z, y, x) [voxel]."""
        size = transform_size(block[0], search[0]), transform_size(block[1], search[1])
        reach = [b + 2 * r for b, r in zip(block, search, strict=True)]
        folds = fold(block[1], size[1]), fold(reach[1], size[1])
        matrices = [_analysis(quads, count, size[1]) for quads, count in zip(folds, (block[1], reach[1]), strict=True)]
        matrices += [_back(size[1], search[1], 1.0, 1.0), _back(size[0], search[0], 1 / (size[0] * size[1]), 2.0)]
        return cls(
            size,
            (Planes.for_size(block[0], size[0]), Planes.for_size(reach[0], size[0])),
            folds,
            np.concatenate([matrix.ravel() for matrix in matrices]).astype(np.float32),
        )


@dataclass(frozen=True)
class Planes:
    """Transform of real planes: rows of real parts at frequencies 0 to size / 2, then imaginary ones between.

    Counted in half voxels, the highest frequency has an imaginary part only. It is stored in the place of the real one,
    which gives the same products of two transforms.
    """

    quads: np.ndarray
    """`fold`, flat."""
    rows: np.ndarray
    """Rows by class: even frequencies' cosines and sines, then odd ones'."""
    counts: tuple[int, int, int, int]
    """Rows of each class."""
    matrix: np.ndarray
    """Waves by class, (fold, row), flat."""

    @functools.cached_property
    def transform(self) -> PlaneTransform:
        """Device arrays for the kernel."""
        transform = PlaneTransform()
        transform.quads, transform.rows = to_device(self.quads, int), to_device(self.rows, int)
        transform.matrix = to_device(self.matrix, float)
        transform.folds, transform.counts = len(self.quads) // 4, wp.vec4i(*self.counts)
        return transform

    @classmethod
    def for_size(cls, count: int, size: int) -> Planes:
        """Return the transform of `count` planes to `size` rows."""
        quads, half = fold(count, size), size // 2
        rows, counts, matrix = [], [], []
        for odd, sine in itertools.product((0, 1), (False, True)):
            first, last = (1, half) if sine else (0, half + 1)
            if count % 2 == 0:
                first, last = (1, half + 1) if sine else (0, half)
            frequency = np.arange(first + (first + odd) % 2, last, 2)
            waves = _waves(quads, count, frequency, size)[int(sine)]
            rows.append(np.where(sine & (frequency < half), half + frequency, frequency))
            counts.append(len(frequency))
            matrix.append((-waves if sine else waves).ravel())
        c0, c1, c2, c3 = counts
        flat = np.concatenate(matrix).astype(np.float32)
        return cls(quads.ravel(), np.concatenate(rows).astype(np.int32), (c0, c1, c2, c3), flat)


def transform_size(block: int, search: int) -> int:
    """Return the even length of a transform that holds a block and its surroundings."""
    return -(-(block + 2 * search) // 2) * 2


def fold(count: int, size: int) -> np.ndarray:
    """Return the elements of a row that a transform adds and subtracts before it multiplies.

    Parameters
    ----------
    count : int
        Values in the row.
    size : int
        Length of the transform.

    Returns
    -------
    ndarray of int32, shape (fold, 4)
        For each offset t from the row's centre, 0 <= t <= size / 4: the elements at t, -t, size / 2 - t and
        t - size / 2; -1 where there is none, or where it is the same as an earlier one.
    """
    farthest, quads = count - 1, []  # offsets are doubled, so that they are whole
    for t in range(farthest % 2, min(size // 2, farthest) + 1, 2):
        pairs = (t, -t if t else None), ((size - t, t - size) if 2 * t != size else (None, None))
        offsets = itertools.chain(*pairs)
        quads.append([-1 if o is None or abs(o) > farthest else (farthest + o) // 2 for o in offsets])
    return np.array(quads, np.int32)


def _waves(quads: np.ndarray, count: int, frequency: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines at the folds' first offsets, (fold, frequency)."""
    twice = (count - 1) % 2 + 2 * np.arange(len(quads))
    angle = np.pi * (np.multiply.outer(twice, frequency) % (2 * size)) / size
    return np.cos(angle), np.sin(angle)


def _analysis(quads: np.ndarray, count: int, size: int) -> np.ndarray:
    """Cosines and sines at even and at odd frequencies up to size / 2, (parity, fold, 2, frequency)."""
    half = size // 2
    length = -(-(half // 2 + 1) // ROWS) * ROWS
    matrix = np.zeros((2, len(quads), 2, length))
    for odd in (0, 1):
        frequency = np.arange(odd, half + 1, 2)
        matrix[odd, :, :, : len(frequency)] = np.stack(_waves(quads, count, frequency, size), 1)
    return matrix


def _back(size: int, search: int, scale: float, inner: float) -> np.ndarray:
    """Cosines and sines at even and odd lags for frequencies up to size / 4, (frequency, 4, lag).

    The kernel adds or subtracts the terms at frequencies k and size / 2 - k first. `inner` is the weight of frequencies
    between 0 and size / 2: 2 where they stand for their negatives as well.
    """
    half = size // 2
    frequency, pairs = np.arange(half // 2 + 1), np.arange(search // 2 + 1)
    weight = np.where(frequency == 0, scale, scale * inner) * np.where(2 * frequency == half, 0.5, 1.0)
    waves = []
    for wave in (np.cos, np.sin):
        for odd in (0, 1):
            angle = 2 * np.pi * (np.multiply.outer(frequency, 2 * pairs + odd) % size) / size
            waves.append(weight[:, None] * wave(angle))
    return np.stack(waves, 1)
