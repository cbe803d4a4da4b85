"""Microlens array from a white image: sub-pixel lattice of the microimages' centres.

The white image's autocorrelation gives the lattice's vectors, the symmetry of its mean cell the phase. Each microimage
is then fitted with the mean microimage, moved, scaled and tilted in brightness; the result is an affine lattice through
the fitted centres, robust against dead lenses and dust.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from lfpiv.errors import InputError
from lfpiv.rig import LAYOUTS, LensLattice, Optics

log = logging.getLogger(__name__)

TILE_PX = 1024
"""Side of the part of the image that the autocorrelation sees [pixel]; lags reach half of it."""
PEAK_FRACTION = 0.7
"""A lag is a lattice vector if its correlation is above this part of the best; between lattice vectors it is lower."""
SIGNIFICANCE = 8
"""Correlation that is no chance [standard deviations of that of unrelated pixels, one in the root of their number]."""
NOMINAL_TOLERANCE = 0.2
"""Largest relative error of a nominal pitch: twice what a data sheet may be off."""
CELL_TOLERANCE = 0.03
"""Largest misfit of a neighbour to the layout [pitch]; real arrays stay within 1 %."""
CANDIDATES = 200
"""Shortest lags tried as lattice vector."""
BLUR_PX = 0.9
"""Gaussian blur of the microimages before the fit [pixel]: removes what the pixels alias, so no locking to pixels."""
BLUR_REACH_PX = 3
"""Reach of the blur [pixel], over three standard deviations."""
SHIFT_DIFFERENCE = np.array([1, -8, 0, 8, -1]) / 12
"""What a shift adds, per pixel: the negative first derivative to fourth order, as convolution weights."""
PATCH_BLOCK = 512
"""Microimages cut out at a time, so that they stay in the processor's cache."""
TEMPLATE_LENSES = 500
"""Microimages whose median is the mean microimage."""
SAMPLE_LENSES = 1500
"""Microimages that fix the lattice before all are measured."""
MIN_LENSES = 12
"""Fewest measured microimages: four values per unknown of the lattice."""
MAX_PASSES = 20
"""Most passes of an iteration that usually ends after three to five."""
PASS_TOLERANCE_PX = 0.01
"""Change of the lattice that ends the first passes [pixel]; the final ones start within it."""
LIT_FRACTION = 0.1
"""A microimage with less than this part of the brightest decile's contrast is dead or dark."""
OUTLIER_SCALES = 4.685
"""Tukey's biweight constant [standard deviations]: 95 % efficiency on normal errors."""
MEDIAN_DISTANCE = {1: 0.6745, 2: math.sqrt(2 * math.log(2))}
"""Median distance of normal errors from their mean in one and two dimensions [standard deviations]."""
DISTORTION_PX = 0.05
"""Smooth distortion worth a warning [pixel, rms]: what would move a pupil coordinate by a twentieth of a pixel."""


@dataclass(frozen=True, kw_only=True)
class LensArray:
    """Microimage centres of one camera as a lattice on the sensor: centre = origin + i basis[0] + j basis[1].

    Positions are (column, row) in pixels, integer at a pixel's centre. Microimage (0, 0) is the one nearest the
    sensor's centre.
    """

    centres_px: np.ndarray
    """Centres of all microimages whose centre lies on the sensor, cut ones included [pixel], shape (lens, 2)."""
    index: np.ndarray
    """Their lattice indices (i, j), shape (lens, 2), integer; i runs fastest."""
    origin_px: tuple[float, float]
    """Centre of microimage (0, 0) [pixel]."""
    basis_px: tuple[tuple[float, float], tuple[float, float]]
    """Vectors to the microimages (1, 0) and (0, 1) [pixel], the first -45 to 45 (hexagonal: -15 to 45) degrees from
    +column, the second 90 (60) degrees further towards +row."""
    layout: str
    """"square" or "hexagonal"."""
    rms_px: float
    """Root mean square distance between measured centres and lattice, outliers left out [pixel]."""
    measured: int
    """Number of microimages that the lattice rests on."""
    sensor_shape: tuple[int, int]
    """Shape of the white image [pixel], order (rows, columns)."""

    @property
    def pitch_px(self) -> float:
        """Distance between neighbouring centres, from the area of the lattice's cell [pixel]."""
        return _pitch(np.asarray(self.basis_px), self.layout)

    @property
    def rotation_deg(self) -> float:
        """Angle from +column towards +row of basis[0], mean over both lattice vectors [degree]."""
        first, second = (math.degrees(math.atan2(row, column)) for column, row in self.basis_px)
        return (first + second - _cell_angle_deg(self.layout)) / 2

    def lattice(self, optics: Optics) -> LensLattice:
        """Lens centres in the microlens plane, s_l = X_c / (1 + f_m/s_i), the optical axis at the sensor's centre.

        Raises
        ------
        ValueError
            If `optics` has another layout or sensor than the white image.
        """
        if optics.layout != self.layout:
            raise ValueError(f"optics.layout: expected {self.layout!r} as in the lens array, got {optics.layout!r}.")
        if tuple(optics.sensor_shape) != self.sensor_shape:
            raise ValueError(
                f"optics.sensor_shape: expected {self.sensor_shape} as in the white image, got {optics.sensor_shape}."
            )
        scale = 1 + optics.sensor_per_pupil
        origin = optics.sensor_mm(np.asarray(self.origin_px)) / scale
        basis = np.asarray(self.basis_px) * optics.pixel_mm / scale
        return LensLattice(
            origin_mm=tuple(origin.tolist()), basis_mm=tuple(map(tuple, basis.tolist())), layout=self.layout
        )


def find_lens_array(
    white: np.ndarray,
    dark: np.ndarray | None = None,
    nominal_pitch_px: float | None = None,
    layout: str = "square",
) -> LensArray:
    """Find the microimages of a white image.

    Parameters
    ----------
    white : ndarray, shape (rows, columns)
        White image [counts], any real dtype.
    dark : ndarray, shape (rows, columns), optional
        Dark frame [counts], subtracted from `white`.
    nominal_pitch_px : float, optional
        Expected distance of neighbouring microimages [pixel], good to 10 %; found from the image where missing.
    layout : {"square", "hexagonal"}
        Arrangement of the lenses; a hexagonal array may lie in any orientation.

    Raises
    ------
    InputError
        If an argument is not of the kind above, or the image shows no such array of microimages.
    """
    image = _checked_image(white, dark)
    if layout not in LAYOUTS:
        raise InputError(f"layout: expected one of {LAYOUTS}, got {layout!r}.")
    nominal = _checked_pitch(nominal_pitch_px, image.shape)

    basis = _find_basis(image, nominal, layout)
    origin = _find_phase(image, basis, layout)
    origin, basis, rms, measured = _fit_lattice(image, origin, basis, layout)

    rows, columns = image.shape
    index = _indices_inside(origin, basis, (-0.5, -0.5), (columns - 0.5, rows - 0.5))
    centres = origin + index @ basis
    middle = np.argmin(((centres - ((columns - 1) / 2, (rows - 1) / 2)) ** 2).sum(1))
    origin, index = centres[middle], index - index[middle]
    array = LensArray(
        centres_px=centres,
        index=index,
        origin_px=tuple(origin.tolist()),
        basis_px=tuple(map(tuple, basis.tolist())),
        layout=layout,
        rms_px=rms,
        measured=measured,
        sensor_shape=image.shape,
    )
    log.info(
        "%s lens array: %d microimages, pitch %.4f px, rotation %.4f degrees, %d measured, rms %.4f px",
        layout, len(index), array.pitch_px, array.rotation_deg, measured, rms,
    )  # fmt: skip
    return array


# Input ---------------------------------------------------------------------------------------------------------------


def _checked_image(white: np.ndarray, dark: np.ndarray | None) -> np.ndarray:
    """White image less the dark frame as float32, after all checks."""
    white = _checked_frame("white", white)
    image = white.astype(np.float32)
    if dark is not None:
        dark = _checked_frame("dark", dark)
        if dark.shape != white.shape:
            raise InputError(
                f"dark: expected shape {white.shape} as the white image, got {dark.shape}. "
                "Use a dark frame of the same camera, uncropped."
            )
        image = image - dark.astype(np.float32)
    if not image.max() > 0:
        raise InputError("white: expected light, got an image without any value above the dark level. Check exposure.")
    if image.max() == image.min():
        raise InputError("white: expected microimages, got the same value in every pixel. Check the file.")
    return image


def _checked_frame(name: str, frame: np.ndarray) -> np.ndarray:
    frame = np.asarray(frame)
    if frame.ndim != 2:
        hint = " Convert colour images to one channel first." if frame.ndim == 3 else ""
        raise InputError(f"{name}: expected a grey image of shape (rows, columns), got shape {frame.shape}.{hint}")
    if frame.dtype.kind not in "uif":
        raise InputError(f"{name}: expected integer or float counts, got dtype {frame.dtype}.")
    if min(frame.shape) < 16:
        raise InputError(f"{name}: expected at least 16 x 16 pixels, got {frame.shape}.")
    if frame.dtype.kind == "f" and not np.isfinite(frame).all():
        raise InputError(
            f"{name}: expected finite counts, got NaN or infinity in {(~np.isfinite(frame)).sum()} pixels."
        )
    return frame


def _checked_pitch(nominal_pitch_px: float | None, shape: tuple[int, int]) -> float | None:
    if nominal_pitch_px is None:
        return None
    try:
        nominal = float(nominal_pitch_px)
    except (TypeError, ValueError):
        nominal = math.nan
    longest = min(shape) / 3
    if not 3 <= nominal <= longest:
        raise InputError(
            f"nominal_pitch_px: expected 3 to {longest:g} pixels (a third of the image), got {nominal_pitch_px!r}. "
            "Check pitch and pixel size, or leave it out."
        )
    return nominal


# Lattice vectors from the autocorrelation ----------------------------------------------------------------------------


def _find_basis(image: np.ndarray, nominal: float | None, layout: str) -> np.ndarray:
    """Lattice vectors, rows (column, row) [pixel], in the standard order of `LensArray.basis_px`."""
    tile = _middle(image)
    width, best = nominal or min(tile.shape) / 4, -1.0
    while width >= 3:  # a narrow mean hides unequal lenses, a wide one keeps more signal: the lattice itself decides
        correlation = _autocorrelation(_evened(tile, width))
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
            "Check microlens pitch and pixel size, or leave it out."
        )
    return _refine_basis(chosen, _standard_basis(lag, layout), chosen_peaks[1])


def _middle(image: np.ndarray) -> np.ndarray:
    start = [max(0, (n - TILE_PX) // 2) for n in image.shape]
    return image[start[0] : start[0] + TILE_PX, start[1] : start[1] + TILE_PX]


def _evened(tile: np.ndarray, width: float) -> np.ndarray:
    """Tile less its local mean in units of its local contrast: unequal and dead lenses must not outweigh the gaps."""
    size = 2 * round(width / 2) + 1
    mean = ndimage.uniform_filter(tile, size)
    even = tile / np.maximum(mean, 0.1 * max(mean.max(), 1e-30)) - 1
    contrast = np.sqrt(np.maximum(ndimage.uniform_filter(even**2, 2 * size + 1), 0))
    even /= np.maximum(contrast, max(np.median(contrast), 1e-30))
    return even - even.mean()


def _autocorrelation(tile: np.ndarray) -> np.ndarray:
    """Correlation coefficient of the tile with itself over the overlap at each lag up to half of it.

    Lag zero lies in the middle and holds the mean of its neighbours, so pixel noise leaves no spike.
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
    """Sum over the tile's part that meets itself at each lag (row >= 0): of the one copy and of the other."""
    total = np.zeros(np.add(tile.shape, 1))
    total[1:, 1:] = tile.cumsum(0, dtype=float).cumsum(1)
    r = np.arange(reach[0] + 1)[:, None]
    c = np.arange(-reach[1], reach[1] + 1)[None]
    rows, columns = tile.shape
    left, right = np.maximum(-c, 0), columns - np.maximum(c, 0)  # columns that have a partner at column + c

    def box(top, bottom, first, last):
        return total[bottom, last] - total[top, last] - total[bottom, first] + total[top, first]

    return box(0 * r, rows - r, left, right), box(r, rows + 0 * r, left + c, right + c)


def _correlation_peaks(correlation: np.ndarray) -> tuple[np.ndarray, float]:
    """Local maxima of a half plane, lags (n, 2) as (column, row), and the radius of the lobe about lag zero [pixel]."""
    middle = np.array(correlation.shape) // 2
    row, column = np.ogrid[-middle[0] : middle[0] + 1, -middle[1] : middle[1] + 1]
    radius = np.hypot(row, column)
    ring = np.rint(radius).astype(int).ravel()
    profile = (np.bincount(ring, correlation.ravel()) / np.bincount(ring))[: middle.min() // 2]
    rises = np.flatnonzero(np.diff(profile[1:]) > 0)
    lobe = 1 + int(rises[0]) if len(rises) else len(profile)
    top = ndimage.maximum_filter(correlation, 2 * math.ceil(0.4 * lobe) + 1) == correlation
    top &= ((row > 0) | ((row == 0) & (column > 0))) & (radius > lobe) & (radius < 0.9 * middle.min())
    return (np.argwhere(top) - middle)[:, ::-1], lobe


def _best_lag(correlation: np.ndarray, lags: np.ndarray, lobe: float, layout: str) -> tuple[float, np.ndarray]:
    """Shortest lag (column, row) that spans a lattice of high correlation, with the lattice's score.

    The score is the lowest correlation at the neighbours of lag zero. Multiples of the lattice score as high as the
    true one, so the shortest of the best is taken.
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


def _cell_angle_deg(layout: str) -> float:
    return 60.0 if layout == "hexagonal" else 90.0


def _pitch(basis: np.ndarray, layout: str) -> float:
    return math.sqrt(abs(np.linalg.det(basis)) / math.sin(math.radians(_cell_angle_deg(layout))))


def _standard_basis(lag: np.ndarray, layout: str) -> np.ndarray:
    """Lattice vectors, ordered and signed as `LensArray.basis_px` says, of the lattice that one of them spans."""
    turn, lowest = (60.0, -15.0) if layout == "hexagonal" else (90.0, -45.0)
    angle = math.degrees(math.atan2(lag[1], lag[0]))
    angle = np.radians(lowest + (angle - lowest) % turn + np.array([0, turn]))
    return np.hypot(*lag) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _refine_basis(correlation: np.ndarray, basis: np.ndarray, lobe: float) -> np.ndarray:
    """Lattice vectors through the correlation's peaks at lags of doubling length, each predicted by the last fit."""
    middle = np.array(correlation.shape)[::-1] // 2
    half = max(1, int(lobe / 4))
    offset = np.arange(-half, half + 1)
    row, column = (a.ravel() for a in np.meshgrid(offset, offset, indexing="ij"))
    paraboloid = np.linalg.pinv(np.stack([np.ones_like(row), column, row, column**2, row * column, row**2], 1) + 0.0)
    limit = middle - half - 1
    reach = 1.5 * np.hypot(*basis[0])
    while True:
        index = _indices_inside(np.zeros(2), basis, -limit, limit)
        near = np.hypot(*(index @ basis).T) <= reach
        index = index[near & (index != 0).any(1)]
        lag = np.rint(index @ basis).astype(int)
        patch = correlation[middle[1] + lag[:, 1, None] + row, middle[0] + lag[:, 0, None] + column]
        _, dx, dy, xx, xy, yy = (patch @ paraboloid.T).T
        hessian = 4 * xx * yy - xy**2
        peak = (xx < 0) & (hessian > 0)
        shift = np.stack([xy * dy - 2 * yy * dx, xy * dx - 2 * xx * dy], 1)[peak] / hessian[peak, None]
        kept = (np.abs(shift) <= half + 1).all(1)
        if np.linalg.matrix_rank(index[peak][kept]) == 2:
            basis = np.linalg.lstsq(index[peak][kept], lag[peak][kept] + shift[kept], rcond=None)[0]
        if reach > np.hypot(*limit):
            return basis
        reach *= 2


def _indices_inside(origin: np.ndarray, basis: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """List the indices (i, j) of all lattice nodes with low <= node < high, row after row, shape (node, 2)."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    reach = (corners - origin) @ np.linalg.inv(basis)
    first, last = np.floor(reach.min(0)).astype(int), np.ceil(reach.max(0)).astype(int)
    j, i = (a.ravel() for a in np.mgrid[first[1] : last[1] + 1, first[0] : last[0] + 1])
    index = np.stack([i, j], axis=1)
    node = origin + index @ basis
    return index[((node >= low) & (node < high)).all(1)]


# Phase from the symmetry of the mean cell ----------------------------------------------------------------------------


def _find_phase(image: np.ndarray, basis: np.ndarray, layout: str) -> np.ndarray:
    """Place of a lens centre (column, row) [pixel] near the image's middle, good to about a pixel.

    The mean cell looks the same after a quarter (sixth) turn about a lens centre. In a square array also about the
    gaps between four lenses, which are darker.
    """
    pitch = _pitch(basis, layout)
    crop = _evened(_middle(image), pitch)
    bins = 2 * int(np.clip(pitch / 2, 3, 16))
    cell = _mean_cell(crop, basis, bins)

    turn = np.array([[0, -1], [1, 1]]) if layout == "hexagonal" else np.array([[0, -1], [1, 0]])
    place = np.stack(np.meshgrid(np.arange(bins), np.arange(bins), indexing="ij"), -1).reshape(-1, 2)
    offset = place[:, None] - place[None]  # (point, centre, 2): lattice coordinates about every possible centre
    turned = (place[None] + offset @ turn.T) % bins
    symmetry = (cell.reshape(-1, 1) * cell[turned[..., 0], turned[..., 1]]).sum(0)
    centre = place[np.argmax(symmetry)]
    if layout == "square":
        inner = (offset + bins // 2) % bins - bins // 2
        disc = (np.hypot(*(inner @ basis / bins).T) <= 0.3 * np.hypot(*basis[0])).T
        brightness = [(cell.ravel()[disc[:, c[0] * bins + c[1]]]).mean() for c in (centre, (centre + bins // 2) % bins)]
        centre = centre if brightness[0] >= brightness[1] else (centre + bins // 2) % bins
    start = [max(0, (n - TILE_PX) // 2) for n in image.shape[::-1]]
    return centre / bins @ basis + start


def _mean_cell(crop: np.ndarray, basis: np.ndarray, bins: int) -> np.ndarray:
    """Crop folded into one lattice cell of bins x bins (i, j), each pixel shared by the four nearest bins."""
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


# Centres and lattice -------------------------------------------------------------------------------------------------


def _fit_lattice(
    image: np.ndarray, origin: np.ndarray, basis: np.ndarray, layout: str
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Measure the microimages and put a lattice through their centres: origin, basis, rms [pixel], number measured."""
    pitch = _pitch(basis, layout)
    half = math.ceil(pitch * min(0.5 * np.abs(basis).sum(0).max() / pitch, 0.71))  # of a square that holds a cell
    for _ in range(MAX_PASSES):
        index = _whole_microimages(image.shape, origin, basis, half)
        index = index[:: math.ceil(len(index) / SAMPLE_LENSES)]
        nodes = origin + index @ basis
        shift, lit, microimage = _measure(_patches(image, nodes, half), nodes, basis)
        origin, basis, _ = _robust_lattice(index[lit], (nodes + shift)[lit], origin, basis)
        if np.abs(origin + index @ basis - nodes).max() < PASS_TOLERANCE_PX:
            break

    index = _whole_microimages(image.shape, origin, basis, half)
    centres = origin + index @ basis
    for _ in range(2):  # the second time from its own centre, where the linear fit is exact
        shift, lit, _ = _measure(_patches(image, centres, half), centres, basis, microimage)
        centres = centres + shift
    if lit.mean() < 0.5:
        log.warning("lens array: only %d of %d microimages are lit; the others are extrapolated.", lit.sum(), len(lit))
    index, centres = index[lit], centres[lit]
    origin, basis, kept = _robust_lattice(index, centres, origin, basis)
    residual = centres - origin - index @ basis
    rms = math.sqrt((residual[kept] ** 2).sum(1).mean())
    if kept.mean() < 0.5 or rms > 0.1 * pitch:
        raise InputError(
            f"white: no regular array of microimages found: {kept.sum()} of {len(kept)} lit places on a {layout} "
            f"lattice of pitch {pitch:.2f} px agree with it, to {rms:.2f} px. Expected most of them, to a tenth of the "
            "pitch. Check the file, the layout and the exposure."
        )
    _warn_of_distortion(index[kept] @ basis, residual[kept])
    return origin, basis, rms, int(kept.sum())


def _whole_microimages(shape: tuple[int, int], origin: np.ndarray, basis: np.ndarray, half: int) -> np.ndarray:
    """List the indices (i, j) of the microimages whose patch lies in the image, the blur's reach included."""
    margin = half + BLUR_REACH_PX + 1
    index = _indices_inside(origin, basis, (margin, margin), (shape[1] - 1 - margin, shape[0] - 1 - margin))
    _check_count(index, basis)
    return index


def _check_count(index: np.ndarray, basis: np.ndarray) -> None:
    if len(index) < MIN_LENSES or (np.ptp(index, axis=0) < 2).any():
        raise InputError(
            f"white: expected at least {MIN_LENSES} whole and lit microimages, three along each direction, got "
            f"{len(index)} at a pitch of about {np.hypot(*basis[0]):.1f} px. Use an uncropped, evenly lit image."
        )


def _patches(image: np.ndarray, centres: np.ndarray, half: int) -> np.ndarray:
    """Blurred image at whole pixels from each centre, shape (lens, 2 half + 1, 2 half + 1).

    The blur is sampled about the sub-pixel centre, so it interpolates as well; every microimage is seen alike.
    """
    tap = np.arange(-BLUR_REACH_PX, BLUR_REACH_PX + 1)
    nearest = np.rint(centres).astype(int)
    distance = tap - (centres - nearest)[:, :, None]  # (lens, axis, tap)
    weight = np.exp(-0.5 * (distance / BLUR_PX) ** 2)
    weight = (weight / weight.sum(-1, keepdims=True)).astype(np.float32)[..., None, None]
    span = np.arange(-half - BLUR_REACH_PX, half + BLUR_REACH_PX + 1)
    width = 2 * half + 1
    patches = np.empty((len(centres), width, width), np.float32)
    for first in range(0, len(centres), PATCH_BLOCK):
        part = slice(first, first + PATCH_BLOCK)
        column, row = nearest[part, 0, None, None] + span, nearest[part, 1, None, None] + span[:, None]
        block = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
        block = sum(weight[part, 1, k] * block[:, k : k + width] for k in range(len(tap)))
        patches[part] = sum(weight[part, 0, k] * block[:, :, k : k + width] for k in range(len(tap)))
    return patches


def _measure(
    patches: np.ndarray, places: np.ndarray, basis: np.ndarray, microimage: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shift of each microimage from its patch's middle [pixel], shape (lens, 2), which are lit, the mean microimage T.

    Least squares of brightness * T(x - shift) * (1 + slope . x) + background, linear in shift and slope. T is made
    symmetric about its middle: that defines the centre. Vignetting may act on pixels, so that brightness slopes within
    a microimage, or on whole lenses, so that neighbours that overlap it differ; the slope, a smooth field over the
    sensor, is their share, and keeps either from moving the centres.
    """
    half = patches.shape[1] // 2
    row, column = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    window = _cell_window(column, row, basis)
    brightness = np.tensordot(patches, window.astype(np.float32), 2) / window.sum()
    usual = max(np.percentile(brightness, 90), 1e-30)  # a part of the sensor may be dark
    brightness = np.maximum(brightness / usual, 0.1)
    patches = patches / (usual * brightness)[:, None, None].astype(np.float32)
    if microimage is None:
        bright = np.flatnonzero(brightness >= 0.5)
        microimage = np.median(patches[bright[:: math.ceil(len(bright) / TEMPLATE_LENSES)]], axis=0)
        microimage = (microimage + microimage[::-1, ::-1]) / 2

    moved = [ndimage.convolve1d(microimage, SHIFT_DIFFERENCE, axis=axis, mode="nearest") for axis in (1, 0)]
    overlap = _neighbours_light(microimage, column, row, basis)
    terms = [microimage, np.ones_like(row), *moved, column * microimage - overlap[0], row * microimage - overlap[1]]
    design = np.stack([term.ravel() for term in terms], axis=1)
    weighted = design * window.reshape(-1, 1)
    normal, moments = weighted.T @ design, patches.reshape(len(patches), -1) @ weighted.astype(np.float32)

    size = np.ptp(places, axis=0).max()
    x, y = ((places - places.mean(0)) / size).T
    field = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    c = _robust_fit(field, np.log(brightness)[:, None])[0][:, 0]
    gradient = np.stack([c[1] + 2 * c[3] * x + c[4] * y, c[2] + c[4] * x + 2 * c[5] * y], axis=1) / size
    moments = moments - gradient @ (overlap.reshape(2, -1) @ weighted)

    free = moments @ np.linalg.pinv(normal)
    slopes = free[:, 4:] / np.maximum(free[:, :1], 0.1)
    coefficients, kept = _robust_fit(field, slopes)
    smooth = field @ coefficients
    noise = ((slopes - smooth)[kept] ** 2).mean() * field.shape[1] / len(field)
    signal = (gradient**2).mean()  # bounds the slope where blurred microimages hardly tell it from a shift
    moments = moments - smooth * (signal / max(signal + noise, 1e-30)) @ normal[4:]
    solution = moments[:, :4] @ np.linalg.pinv(normal[:4, :4])
    limit = 0.25 * math.sqrt(abs(np.linalg.det(basis)))
    shift = np.clip(solution[:, 2:] / np.maximum(solution[:, :1], 0.1), -limit, limit)
    contrast = brightness * solution[:, 0]
    lit = contrast > LIT_FRACTION * np.percentile(contrast, 90)
    return shift, lit, microimage


def _neighbours_light(microimage: np.ndarray, column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Light of the nearest neighbour where microimages overlap, times the neighbour's offset [pixel], shape (2, ...).

    One microimage alone is nowhere brighter than at its heart; what is brighter overlaps.
    """
    heart = np.hypot(column, row) < 0.3 * np.hypot(*basis[0])
    light = np.where(heart, 0, np.maximum(microimage - microimage[heart].max(), 0))
    offsets = np.array([i * basis[0] + j * basis[1] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
    distance = (column - offsets[:, 0, None, None]) ** 2 + (row - offsets[:, 1, None, None]) ** 2
    return light * offsets[distance.argmin(0)].transpose(2, 0, 1)


def _cell_window(column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Part of each pixel that is nearest to the middle's lattice node."""
    inside = np.full(column.shape, np.inf)
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        neighbour = i * basis[0] + j * basis[1]
        distance = np.hypot(*neighbour)
        inside = np.minimum(inside, distance / 2 - np.abs(column * neighbour[0] + row * neighbour[1]) / distance)
    return np.clip(inside + 0.5, 0, 1)


def _robust_lattice(
    index: np.ndarray, centres: np.ndarray, origin: np.ndarray, basis: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lattice through centres: origin, basis and which centres counted."""
    _check_count(index, basis)
    design = np.column_stack([np.ones(len(index)), index])
    change, kept = _robust_fit(design, centres - origin - index @ basis)
    return origin + change[0], basis + change[1:], kept


def _robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit values (row, axis) by iterated least squares with Tukey's weights: solution and which rows counted."""
    solution = np.zeros((design.shape[1], values.shape[1]))
    offset = np.median(values, axis=0)
    residual = values - offset
    median = MEDIAN_DISTANCE[values.shape[1]]
    for _ in range(MAX_PASSES):
        distance = np.sqrt((residual**2).sum(1))
        scale = max(np.median(distance) / median, 1e-9)
        reduced = distance / (OUTLIER_SCALES * scale)
        root = np.where(reduced < 1, 1 - reduced**2, 0)[:, None]  # square root of the biweight
        last, solution = solution, np.linalg.lstsq(root * design, root * values, rcond=None)[0]
        residual = values - design @ solution
        if np.abs(design @ (solution - last)).max() <= 1e-3 * scale:
            break
    return solution, reduced < 1


def _warn_of_distortion(places: np.ndarray, residual: np.ndarray) -> None:
    """Log a warning where a cubic field through the residuals is both certain and large."""
    x, y = (places / np.abs(places).max()).T
    terms = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)
    smooth = terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
    rms, rest = (math.sqrt((part**2).sum(1).mean()) for part in (smooth, residual - smooth))
    chance = rest * math.sqrt(terms.shape[1] / len(places))
    if rms > max(DISTORTION_PX, 3 * chance):
        log.warning(
            "lens array: the microimages leave their lattice by a smooth distortion of %.3f px rms, %.3f px at most; "
            "centres follow the lattice.",
            rms,
            np.hypot(*smooth.T).max(),
        )
