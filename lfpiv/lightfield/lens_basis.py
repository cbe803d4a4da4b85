"""Find the lattice vectors and the phase of a microlens array in its white image, without a first guess.

`find_basis` takes the lattice vectors from the peaks of the autocorrelation. `find_phase` folds the image into one
lattice cell and takes the lens centre from the cell's symmetry.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage, optimize

from lfpiv.errors import InputError
from lfpiv.geometry.optics import LAYOUTS

TILE_PX = 1024
"""Side of the image's middle part that is evaluated [pixel]. Lags of the autocorrelation reach half of it."""
PEAK_FRACTION = 0.7
"""Least correlation at a lattice vector, relative to the highest one."""
SIGNIFICANCE = 8
"""Least correlation of an array [standard deviations of the correlation of as many unrelated pixels]."""
NOMINAL_TOLERANCE = 0.2
"""Largest relative error of a nominal pitch."""
CELL_TOLERANCE = 0.03
"""Largest distance of a neighbour from the layout [pitch]."""
CANDIDATES = 200
"""Number of shortest lags tried as lattice vector."""
NARROWEST_MEAN_PX = 3
"""Least width of the local mean [pixel]."""
PEAK_REACH = 0.9
"""Longest lag of a peak, relative to the longest lag."""
MEAN_PITCHES = 2
"""Width of the local mean that the light is compared with [pitch]."""
RADII = np.concatenate([np.arange(0.02, 0.2, 0.03), np.arange(0.2, 1.21, 0.04)])
"""Radii of the discs and squares that microimages are made of [pitch]. The largest are those of blurred overlaps."""
EXPLAINED_RATIO, LEAST_UNEXPLAINED = 0.4, 0.003
"""Unexplained light about a lens centre over that about a gap, at most, and the share added to both before."""
TURNS = {"square": np.array([[0, -1], [1, 0]]), "hexagonal": np.array([[0, -1], [1, 1]])}
"""A quarter turn, and a sixth of a turn, in lattice indices (i, j)."""


def find_basis(image: np.ndarray, nominal: float | None, layout: str) -> np.ndarray:
    """Return the lattice vectors, rows (column, row) [pixel], in the order of `LensArray.basis_px`.

    Raises
    ------
    InputError
        If the image shows no array, or one of another layout or nominal pitch [pixel].
    """
    tile = _middle(image)
    width, best = nominal or min(tile.shape) / 4, -1.0
    while width >= NARROWEST_MEAN_PX:  # a narrow mean removes unequal lenses, a wide one leaves more signal
        correlation = _autocorrelation(_flattened(tile, width))
        peaks = _correlation_peaks(correlation)
        trial = {name: _best_lag(correlation, *peaks, name) for name in LAYOUTS}
        score = max(score for score, _ in trial.values())
        if score > best:
            chosen, chosen_peaks, found, best = correlation, peaks, trial, score
        width /= 2
    if best * math.sqrt(tile.size) < SIGNIFICANCE:
        raise InputError(
            "white: no regular array of microimages found. Expected a sharp white image with at least four lenses "
            "across; check file, exposure and dark frame."
        )
    fits = [name for name in LAYOUTS if found[name][0] >= PEAK_FRACTION * best]
    shown = min(fits, key=lambda name: np.hypot(*found[name][1]))  # far lags of one layout resemble the other
    if shown != layout:
        raise InputError(
            f"layout: expected the layout of the white image, {shown} with a pitch of about "
            f"{np.hypot(*found[shown][1]):.1f} px, got {layout!r}. Check the microlens layout."
        )
    lag = found[layout][1]
    if nominal and abs(np.hypot(*lag) / nominal - 1) > NOMINAL_TOLERANCE:
        raise InputError(
            f"nominal_pitch_px: expected the pitch of the white image, about {np.hypot(*lag):.1f} px, got {nominal:g}. "
            "Check microlens pitch and pixel size."
        )
    return _refine_basis(chosen, _standard_basis(lag, layout), chosen_peaks[1])


def _middle(image: np.ndarray) -> np.ndarray:
    start = [max(0, (n - TILE_PX) // 2) for n in image.shape]
    return image[start[0] : start[0] + TILE_PX, start[1] : start[1] + TILE_PX]


def _flattened(tile: np.ndarray, width: float) -> np.ndarray:
    """Subtract the local mean and divide by the local contrast, so that unequal and dead lenses do not dominate."""
    size = 2 * round(width / 2) + 1
    mean = ndimage.uniform_filter(tile, size)
    flat: np.ndarray = tile / np.maximum(mean, 0.1 * max(mean.max(), 1e-30)) - 1
    contrast = np.sqrt(np.maximum(ndimage.uniform_filter(flat**2, 2 * size + 1), 0))
    flat /= np.maximum(contrast, max(np.median(contrast), 1e-30))
    flat -= flat.mean()
    return flat


def _autocorrelation(tile: np.ndarray) -> np.ndarray:
    """Return the correlation coefficient of the tile with itself over the overlap, for lags up to half the tile.

    Lag zero lies in the middle. It holds the mean of its neighbours, because pixel noise raises it.
    """
    rows, columns = tile.shape
    reach = rows // 2, columns // 2
    padded = [fft.next_fast_len(size + lag, real=True) for size, lag in zip((rows, columns), reach, strict=True)]
    lag_row, lag_column = np.arange(reach[0] + 1), np.arange(-reach[1], reach[1] + 1)
    pairs = np.multiply.outer(rows - lag_row, columns - np.abs(lag_column))
    power = np.abs(fft.rfft2(tile, padded, workers=-1)) ** 2
    product = fft.irfft2(power, padded, workers=-1)[np.ix_(lag_row, lag_column)]
    (sum_a, sum_b), (square_a, square_b) = _overlap_sums(tile, reach), _overlap_sums(tile**2, reach)
    variances = (square_a - sum_a**2 / pairs) * (square_b - sum_b**2 / pairs)
    half = (product - sum_a * sum_b / pairs) / np.sqrt(np.maximum(variances, 1e-12 * max(variances.max(), 1e-30)))
    correlation = np.vstack([half[:0:-1, ::-1], half])
    correlation[reach] = correlation[reach[0] - 1 : reach[0] + 2, reach[1]][::2].mean()
    return correlation


def _overlap_sums(tile: np.ndarray, reach: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of both copies of the tile over their overlap, for each lag with row >= 0."""
    total = np.zeros(np.add(tile.shape, 1))
    total[1:, 1:] = tile.cumsum(0, dtype=float).cumsum(1)
    r = np.arange(reach[0] + 1)[:, None]
    c = np.arange(-reach[1], reach[1] + 1)[None]
    rows, columns = tile.shape
    left, right = np.maximum(-c, 0), columns - np.maximum(c, 0)  # columns with a partner at column + c

    def box(top: np.ndarray, bottom: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        return total[bottom, last] - total[top, last] - total[bottom, first] + total[top, first]

    return box(0 * r, rows - r, left, right), box(r, rows + 0 * r, left + c, right + c)


def _correlation_peaks(correlation: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the local maxima of a half plane as lags (column, row), and the radius of the lobe at lag zero [pixel]."""
    middle = np.array(correlation.shape) // 2
    row, column = np.ogrid[-middle[0] : middle[0] + 1, -middle[1] : middle[1] + 1]
    radius = np.hypot(row, column)
    ring = np.rint(radius).astype(int).ravel()
    profile = (np.bincount(ring, correlation.ravel()) / np.bincount(ring))[: middle.min() // 2]
    rises = np.flatnonzero(np.diff(profile[1:]) > 0)
    lobe = 1 + int(rises[0]) if len(rises) else len(profile)
    top = ndimage.maximum_filter(correlation, 2 * math.ceil(0.4 * lobe) + 1) == correlation
    top &= ((row > 0) | ((row == 0) & (column > 0))) & (radius > lobe) & (radius < PEAK_REACH * middle.min())
    return (np.argwhere(top) - middle)[:, ::-1], lobe


def _best_lag(correlation: np.ndarray, lags: np.ndarray, lobe: float, layout: str) -> tuple[float, np.ndarray]:
    """Return the score of the best lattice and its shortest lag (column, row).

    The score is the lowest correlation at the neighbours of lag zero. Multiples of the true lattice have the same
    score, so the shortest of the best lags counts.
    """
    middle = np.array(correlation.shape) // 2
    height = correlation[tuple((lags[:, ::-1] + middle).T)]
    lags = lags[height > 0.5 * PEAK_FRACTION * height.max(initial=0)]
    best = [(0.0, np.zeros(2))]
    for lag in lags[np.argsort(np.hypot(*lags.T), kind="stable")[:CANDIDATES]]:
        first, second = _standard_basis(lag, layout)
        nodes = np.array([first, second, second - first] if layout == "hexagonal" else [first, second])
        slack = math.ceil(min(CELL_TOLERANCE * np.hypot(*lag), lobe / 2))
        around = [
            correlation[r - slack : r + slack + 1, c - slack : c + slack + 1]
            for c, r in np.rint(nodes).astype(int) + middle[::-1]
        ]
        best.append((min((float(part.max()) for part in around if part.size), default=0.0), lag))
    highest = max(score for score, _ in best)
    return next((score, lag) for score, lag in best if score >= PEAK_FRACTION * highest)


def cell_angle_deg(layout: str) -> float:
    """Return the angle between the two lattice vectors [degree]."""
    return 60.0 if layout == "hexagonal" else 90.0


def lattice_pitch(basis: np.ndarray, layout: str) -> float:
    """Return the distance of neighbouring lenses [pixel], from the area of the lattice's cell."""
    return math.sqrt(abs(np.linalg.det(basis)) / math.sin(math.radians(cell_angle_deg(layout))))


def _standard_basis(lag: np.ndarray, layout: str) -> np.ndarray:
    """Return the lattice vectors in the order of `LensArray.basis_px`, from one lattice vector."""
    turn, lowest = cell_angle_deg(layout), -15.0 if layout == "hexagonal" else -45.0
    angle = math.degrees(math.atan2(lag[1], lag[0]))
    angles = np.radians(lowest + (angle - lowest) % turn + np.array([0, turn]))
    return np.hypot(*lag) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _refine_basis(correlation: np.ndarray, basis: np.ndarray, lobe: float) -> np.ndarray:
    """Fit the lattice vectors to the correlation's peaks within a radius that doubles from fit to fit."""
    middle = np.array(correlation.shape)[::-1] // 2
    half = max(1, int(lobe / 4))
    offset = np.arange(-half, half + 1)
    row, column = (a.ravel() for a in np.meshgrid(offset, offset, indexing="ij"))
    paraboloid = np.linalg.pinv(np.stack([np.ones_like(row), column, row, column**2, row * column, row**2], 1) + 0.0)
    limit = middle - half - 1
    reach = 1.5 * np.hypot(*basis[0])
    while True:
        index = indices_inside(np.zeros(2), basis, -limit, limit)
        near = np.hypot(*(index @ basis).T) <= reach
        index = index[near & (index != 0).any(1)]
        lag = np.rint(index @ basis).astype(int)
        patch = correlation[middle[1] + lag[:, 1, None] + row, middle[0] + lag[:, 0, None] + column]
        _, dx, dy, xx, xy, yy = (patch @ paraboloid.T).T
        hessian = 4 * xx * yy - xy**2
        peak = (xx < 0) & (hessian > 0)
        shift = np.stack([xy * dy - 2 * yy * dx, xy * dx - 2 * xx * dy], 1)[peak] / hessian[peak, None]
        close = (np.abs(shift) <= half + 1).all(1)
        if np.linalg.matrix_rank(index[peak][close]) == 2:
            basis = np.linalg.lstsq(index[peak][close], lag[peak][close] + shift[close], rcond=None)[0]
        if reach > np.hypot(*limit):
            return basis
        reach *= 2


def indices_inside(origin: np.ndarray, basis: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return the indices (i, j) of all lattice nodes with low <= node < high, shape (node, 2). i runs fastest."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    reach = (corners - origin) @ np.linalg.inv(basis)
    first, last = np.floor(reach.min(0)).astype(int), np.ceil(reach.max(0)).astype(int)
    j, i = (a.ravel() for a in np.mgrid[first[1] : last[1] + 1, first[0] : last[0] + 1])
    index: np.ndarray = np.stack([i, j], axis=1)
    node = origin + index @ basis
    return index[((node >= low) & (node < high)).all(1)]


def find_phase(image: np.ndarray, basis: np.ndarray, layout: str) -> np.ndarray:
    """Return a lens centre (column, row) near the image's middle, correct to about a pixel [pixel].

    The mean cell is symmetric under a quarter turn (hexagonal: a sixth) about a lens centre. A square cell has the same
    symmetry about the gap between four lenses. `_unexplained` tells the two apart by their light.

    Raises
    ------
    InputError
        If the light of a square cell fits microimages about both centres, or about neither.
    """
    pitch = lattice_pitch(basis, layout)
    crop = _middle(image)
    mean = ndimage.uniform_filter(crop, 2 * round(MEAN_PITCHES * pitch / 2) + 1)
    bins = 2 * int(np.clip(pitch / 2, 3, 16))
    cell = _mean_cell(crop / np.maximum(mean, 0.1 * max(float(mean.max()), 1e-30)), basis, bins)

    place = np.stack(np.meshgrid(np.arange(bins), np.arange(bins), indexing="ij"), -1).reshape(-1, 2)
    offset = place[:, None] - place[None]  # (point, centre, 2), for every bin as centre
    turned = (place[None] + offset @ TURNS[layout].T) % bins
    contrast = cell - cell.mean()
    symmetry = (contrast.reshape(-1, 1) * contrast[turned[..., 0], turned[..., 1]]).sum(0)
    centre = place[np.argmax(symmetry)]
    if layout == "square":
        centres = [centre, (centre + bins // 2) % bins]
        found = [_unexplained(np.roll(cell, -middle, (0, 1)), basis) for middle in centres]
        if not min(found) + LEAST_UNEXPLAINED < EXPLAINED_RATIO * (max(found) + LEAST_UNEXPLAINED):
            raise InputError(
                "white: expected light that tells the centres of the microimages from the gaps between four of them, "
                f"found that microimages about either explain it to {100 * (1 - max(found)):.1f} and "
                f"{100 * (1 - min(found)):.1f} %. Use a white image with dark gaps, from a smaller aperture of the "
                "main lens, and a dark image."
            )
        centre = centres[int(np.argmin(found))]
    start = [max(0, (n - TILE_PX) // 2) for n in image.shape[::-1]]
    return centre / bins @ basis + start


def _unexplained(cell: np.ndarray, basis: np.ndarray) -> float:
    """Return the share of a square cell's contrast that no microimages about its first bin explain.

    Microimages are sums of discs and squares of any radii, so they do not grow brighter outwards. They stand on a level
    that is not darker than black. The cell is averaged over its turns and mirror images, against noise and slopes.
    """
    bins = len(cell)
    place = np.stack(np.meshgrid(np.arange(bins), np.arange(bins), indexing="ij"), -1).reshape(-1, 1, 2)
    turned = [cell]
    for _ in range(3):
        turned.append(np.roll(turned[-1][::-1].T, 1, axis=1))
    light = sum(part + part.T for part in turned).ravel() / 8
    light -= min(float(light.min()), 0.0)
    around = np.stack(np.meshgrid(range(-2, 3), range(-2, 3), indexing="ij"), -1).reshape(1, -1, 2)
    away = (place / bins + 0.5) % 1 - 0.5 - around  # [lattice index]
    round_, square = np.linalg.norm(away @ basis, axis=-1) / np.hypot(*basis[0]), np.abs(away).max(-1)
    rest = [
        optimize.nnls(np.column_stack([np.ones(bins * bins), *_discs(distance, bins)]), light)[1]
        for distance in (round_, square)
    ]
    return float(min(rest) ** 2 / max(((light - light.mean()) ** 2).sum(), 1e-30))


def _discs(distance: np.ndarray, bins: int) -> list[np.ndarray]:
    """Return equal discs, one for each of `RADII`, from the distances to their middles (bin, disc) [pitch]."""
    return [np.clip((radius - distance) * bins + 0.5, 0, 1).sum(1) for radius in RADII]


def _mean_cell(crop: np.ndarray, basis: np.ndarray, bins: int) -> np.ndarray:
    """Fold the crop into one lattice cell of bins x bins (i, j). The four nearest bins share each pixel."""
    inverse = np.linalg.inv(basis) * bins
    row, column = np.ogrid[: crop.shape[0], : crop.shape[1]]
    i, j = (column * inverse[0, k] + row * inverse[1, k] for k in (0, 1))
    i0, j0 = np.floor(i).astype(int), np.floor(j).astype(int)
    fi, fj = i - i0, j - j0
    total, weight = np.zeros(bins * bins), np.zeros(bins * bins)
    for di, dj, share in ((0, 0, (1 - fi) * (1 - fj)), (1, 0, fi * (1 - fj)), (0, 1, (1 - fi) * fj), (1, 1, fi * fj)):
        bin_number = ((i0 + di) % bins * bins + (j0 + dj) % bins).ravel()
        total += np.bincount(bin_number, (share * crop).ravel(), bins * bins)
        weight += np.bincount(bin_number, share.ravel(), bins * bins)
    return (total / np.maximum(weight, 1e-12)).reshape(bins, bins)
