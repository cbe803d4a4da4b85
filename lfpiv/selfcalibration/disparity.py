"""Disparity: distance between the positions at which two cameras show the same particles, in parts of a volume.

The volume reconstructed from the images of a single camera shows every particle, elongated along the camera's line of
sight. The displacement at which the volumes of two cameras correlate best is their disparity. Only its part across both
lines of sight is used: in their plane the peak is so long that noise decides its place, and a movement there moves all
particles alike. The roots of the intensities are correlated, or few bright particles would decide. Input: weights and
particle images of some instants. Output: a `Disparity` per pair of cameras and part of the volume.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import convolve, gaussian_filter

from lfpiv.geometry.resampling import volume_on
from lfpiv.progress import StepProgress, part_of
from lfpiv.reconstruction.settings import PLAIN, SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.selfcalibration.masked_correlation import masked_correlation, mirrored_window

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.geometry.grid import Grid
    from lfpiv.weights.operator import Weights

ITERATIONS = 5
"""SMART iterations of the volume of a single camera."""
STILL = 1.25
"""Multiple of the light that stays in place that is subtracted from images. Pulses of a laser differ in energy."""
SMOOTHING_VOXEL, MEAN_VOXEL = 0.7, 4.0
"""Standard deviations of the Gaussians that smooth the roots of a volume, and that make the local mean subtracted from
them [voxel]."""
SEARCH_VOXEL = 16
"""Largest disparity along each axis [voxel]."""
SLANT_VOXEL = 4.0
"""Largest disparity in the plane of both lines of sight [voxel]. Long particles correlate there over many lags, so that
peaks farther away say nothing about the cameras."""
MIDDLE_VOXEL = 128
"""Largest edge of the middle part of the volume, which is correlated first [voxel]."""
NEAR_VOXEL = 4
"""Largest distance of a window's disparity from that of the middle part along each axis [voxel]. Peaks farther away are
chance peaks."""
WINDOW_VOXEL, MOST_WINDOWS = 12, 3
"""Least edge of the windows into which the volume is cut [voxel], and their largest number along an axis."""
FIT_REACH = 1
"""Lags on either side of the highest one to which a peak's paraboloid is fitted."""
AVERAGED, SLANT_STD, ACROSS_STD = 4, 2.0, 0.3
"""Half edge of the lags over which coefficients are averaged, and standard deviations of their weight in the plane of
the lines of sight and across it [voxel]."""
FLATTEST = 1e-3
"""Least curvature of a peak, as a share of the largest one."""
NEARLY_PARALLEL = 0.3
"""Two lines of sight count as parallel if their smaller singular value is less: some 25 degrees between them."""
LEVEL = 0.1
"""The lines of sight count as normal to y if the square of the sine is less: 18 degrees."""
SIGNIFICANT = 1.5
"""Least ratio of a peak to the highest coefficient with one volume mirrored, which is due to chance."""
SAME_VOXEL = 2.0
"""Distance across the lines of sight within which two lags are on the same peak [voxel]."""
ELSEWHERE = 3.0
"""Least excess of a peak farther away over the coefficients of the expected place [standard deviation of chance]."""


@dataclass(frozen=True, kw_only=True)
class Disparity:
    """Disparity of two cameras in one part of the volume."""

    cameras: tuple[str, str]
    centre_mm: np.ndarray
    """Centre of the part, shape (3,) [mm]."""
    shift_mm: np.ndarray
    """Position in the second camera's volume of a particle at 0 in the first camera's, shape (3,) [mm]."""
    sharpness: np.ndarray
    """Curvature of the peak over its height, shape (3, 3) [1/mm^2]; 0 in the plane of both lines of sight."""
    peak: float
    """Correlation coefficient."""
    rival: float
    """Highest coefficient with one volume mirrored."""

    @property
    def weight(self) -> np.ndarray:
        """Weight of each direction in a fit, at most 1, shape (3, 3): the square of the relative sharpness.

        The error of a peak grows faster than its width, because elongated particles disturb each other's peaks.
        """
        relative = self.sharpness / np.linalg.eigvalsh(self.sharpness)[-1]
        weight: np.ndarray = relative @ relative
        return weight

    def observable_mm(self, shift_mm: np.ndarray) -> float:
        """Return the length of the part of a shift that the cameras can observe [mm]."""
        return float(np.sqrt(shift_mm @ self.weight @ shift_mm))


def still_light(instants: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the light that all instants have at the same pixels: reflections, hot pixels, stray light.

    Particles that hardly move between the instants count, too. So instants of several pairs tell it better than two.

    Parameters
    ----------
    instants : iterable of dict
        Particle images, camera name -> image (rows, columns) [counts], background removed. Two instants or more. One
        after the other is held.

    Returns
    -------
    dict
        Camera name -> the lowest positive count of each pixel, shape (rows, columns), else 0; empty without instants.
    """
    still: dict[str, np.ndarray] = {}
    for images in instants:
        for name, image in images.items():
            lowest = np.maximum(image, 0)
            still[name] = np.minimum(still[name], lowest) if name in still else lowest
    return still


def without_still_light(images: Mapping[str, np.ndarray], still: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the images of an instant less `STILL` times the light of `still_light`."""
    return {name: image - np.float32(STILL) * still[name] for name, image in images.items()}


class CameraVolumes:
    """Volumes of single cameras, from which disparities are measured.

    Parameters
    ----------
    weights : Weights
        The operator of two or more cameras. Volumes are correlated on the voxels of its `volume`.
    """

    def __init__(self, weights: Weights):
        self.weights = weights
        settings = SmartSettings(iterations=ITERATIONS, **PLAIN)
        self._solvers = {name: SmartSolver(weights.of_camera(name), settings) for name in weights.cameras}
        self._volumes: dict[str, list[np.ndarray]] = {name: [] for name in weights.cameras}

    def add(self, images: Mapping[str, np.ndarray], progress: StepProgress | None = None) -> None:
        """Add one instant: particle images, camera name -> image (rows, columns) [counts], background removed."""
        for number, (name, solver) in enumerate(self._solvers.items()):
            if progress is not None:
                progress(number / len(self._solvers))
            found = volume_on(solver.solve({name: images[name]}).to_dataarray(), self.weights.volume)
            self._volumes[name].append(_flattened(found.values))

    def own(self) -> dict[str, list[np.ndarray]]:
        """Return the volumes of each camera, flattened, one an instant, shape (z, y, x)."""
        return self._volumes

    def each(self, instants: int) -> list[CameraVolumes]:
        """Return the volumes of each run of so many instants alone."""
        count = len(next(iter(self._volumes.values())))
        return [self._part(slice(first, first + instants)) for first in range(0, count, instants)]

    def every(self, period: int) -> list[CameraVolumes]:
        """Return the volumes of the first instants of each run of so many, of the second ones, and so on."""
        return [self._part(slice(first, None, period)) for first in range(period)]

    def _part(self, instants: slice) -> CameraVolumes:
        part = copy.copy(self)
        part._volumes = {name: known[instants] for name, known in self._volumes.items()}
        return part

    def disparities(self) -> tuple[Disparity, ...]:
        """Measure the disparities of all pairs of cameras in the parts of the volume that have a clear peak.

        Returns
        -------
        tuple of Disparity
            Empty if no two cameras show the same particles in any part of the volume.
        """
        grid, found = self.weights.volume, list[Disparity]()
        middle = tuple(slice((n - m) // 2, (n + m) // 2) for n in grid.shape for m in [min(n, MIDDLE_VOXEL)])
        for pair in combinations(self.weights.cameras, 2):
            volumes = self._volumes[pair[0]], self._volumes[pair[1]]
            slanted = slant([self.weights.cameras[name] for name in pair], grid)
            in_middle = disparity_in(volumes, middle, grid, pair, slanted)
            if in_middle is not None:
                parts = [
                    disparity_in(volumes, window, grid, pair, slanted, near_mm=in_middle.shift_mm)
                    for window in cut_into_windows(grid)
                ]
                found += [part for part in parts if part is not None] or [in_middle]
        return tuple(found)


def disparities(
    weights: Weights,
    images: Sequence[Mapping[str, np.ndarray]],
    progress: StepProgress | None = None,
) -> tuple[Disparity, ...]:
    """Measure the disparities of all pairs of cameras by particle images of some instants.

    Parameters as of `CameraVolumes` and `CameraVolumes.add`; result as of `CameraVolumes.disparities`.
    """
    volumes = CameraVolumes(weights)
    for number, instant in enumerate(images):
        part = None if progress is None else part_of(progress, number / len(images), (number + 1) / len(images))
        volumes.add(instant, part)
    return volumes.disparities()


def slant(cameras: Sequence[CalibratedCamera], grid: Grid) -> np.ndarray:
    """Return the projection onto the plane of two cameras' lines of sight in the middle of a volume, shape (3, 3).

    If the lines are nearly parallel, it is the projection onto their common direction.
    """
    step = grid.voxel_mm * np.vstack([np.eye(3), -np.eye(3)])
    sights = []
    for camera in cameras:
        ends = camera.map(grid.centre_mm + step, np.zeros((6, 2)))
        sights.append(np.linalg.svd((ends[:3] - ends[3:]).T)[2][-1])  # what leaves the place on the array as it is
    _, size, directions = np.linalg.svd(np.array(sights))
    plane = directions[:2][size > NEARLY_PARALLEL]
    projection: np.ndarray = plane.T @ plane
    return projection


def _flattened(volume: np.ndarray) -> np.ndarray:
    """Return the roots of a volume, smoothed, less their local mean; beyond the volume nothing counts."""
    roots: np.ndarray = np.sqrt(volume)
    inside = np.ones_like(volume)

    def mean(sigma: float) -> np.ndarray:
        smoothed: np.ndarray = gaussian_filter(roots, sigma, mode="constant")
        smoothed /= gaussian_filter(inside, sigma, mode="constant")
        return smoothed

    flattened: np.ndarray = mean(SMOOTHING_VOXEL) - mean(MEAN_VOXEL)
    return flattened


def unlinked(found: Sequence[Disparity], cameras: Iterable[str]) -> list[str]:
    """Name the cameras that share no particles with any other one."""
    linked = {name for one in found for name in one.cameras}
    return [name for name in cameras if name not in linked]


def cut_into_windows(grid: Grid) -> list[tuple[slice, ...]]:
    """Cut the volume into windows, (z, y, x)."""
    counts = [int(np.clip(edge // WINDOW_VOXEL, 1, MOST_WINDOWS)) for edge in grid.shape]
    edges = [np.linspace(0, edge, count + 1).astype(int) for edge, count in zip(grid.shape, counts, strict=True)]
    return [
        tuple(slice(int(edge[i]), int(edge[i + 1])) for edge, i in zip(edges, place, strict=True))
        for place in np.ndindex(*counts)
    ]


def disparity_in(
    volumes: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
    window: tuple[slice, ...],
    grid: Grid,
    cameras: tuple[str, str],
    slanted: np.ndarray,
    near_mm: np.ndarray | None = None,
) -> Disparity | None:
    """Measure the disparity of two cameras' volumes in a window; None if there is no clear peak.

    The highest of many chance peaks may exceed the right one in dense seeding. So a peak where none is expected must
    stand out from the coefficients where it is: at cameras that stand still, or at `near_mm`. `slanted` is from
    `slant`. `near_mm` limits the search to `NEAR_VOXEL` around another disparity.
    """
    first, second = volumes
    centre, reach = np.zeros(3, int), SEARCH_VOXEL
    if near_mm is not None:
        centre, reach = np.rint(near_mm[::-1] / grid.voxel_mm).astype(int), NEAR_VOXEL + FIT_REACH
    coefficient = masked_correlation(first, second, window, centre=centre, reach=reach)
    axes = (1,) if slanted[1, 1] < LEVEL else (0, 1, 2)  # mirrors that keep lines of sight: along y, in the middle
    opposite = mirrored_window(window, grid.shape, axes)
    mirrored = masked_correlation(first, [np.flip(volume, axes) for volume in second], opposite, centre, reach=reach)
    coefficient, mirrored = (_along(values, slanted) for values in (coefficient, mirrored))
    lags = np.indices(coefficient.shape).reshape(3, -1) - reach + centre[:, None]
    searched = np.linalg.norm(slanted @ lags[::-1], axis=0) <= SLANT_VOXEL
    searched &= (np.abs(lags - centre[:, None]) <= reach - FIT_REACH).all(0)
    searched = searched.reshape(coefficient.shape)
    highest = np.unravel_index(int(np.where(searched, coefficient, -1).argmax()), coefficient.shape)
    peak, rival = float(coefficient[highest]), float(mirrored[searched].max())
    across = np.eye(3) - slanted
    from_peak, from_expected = (
        np.linalg.norm(across @ (lags - place[:, None])[::-1], axis=0).reshape(coefficient.shape)
        for place in (lags[:, np.ravel_multi_index(highest, coefficient.shape)], centre)
    )
    expected = coefficient[searched & (from_expected <= SAME_VOXEL) & (from_peak > SAME_VOXEL)]
    needed = SIGNIFICANT * rival
    if from_expected[highest] > SAME_VOXEL and expected.size:
        needed = max(needed, float(expected.max()) + ELSEWHERE * float(mirrored[searched].std()))
    if not peak >= needed:
        return None
    fitted = fit_peak(coefficient[tuple(slice(i - FIT_REACH, i + FIT_REACH + 1) for i in highest)])
    if fitted is None:
        return None
    offset, curvature = fitted
    lag = np.array(highest)[::-1] - reach + centre[::-1] + offset
    corner = [grid.axis_mm(axis)[part.start : part.stop] for axis, part in enumerate(window)]
    return Disparity(
        cameras=cameras,
        centre_mm=np.array([values.mean() for values in reversed(corner)]),
        shift_mm=lag * grid.voxel_mm,
        sharpness=across @ curvature @ across / peak / grid.voxel_mm**2,
        peak=peak,
        rival=rival,
    )


def _along(coefficient: np.ndarray, slanted: np.ndarray) -> np.ndarray:
    """Average coefficients in the plane of the lines of sight, over which a particle's peak extends."""
    lags = np.indices((2 * AVERAGED + 1,) * 3)[::-1] - AVERAGED
    inside, across = (np.einsum("ij,j...->i...", part, lags) for part in (slanted, np.eye(3) - slanted))
    kernel = np.exp(-0.5 * (inside**2).sum(0) / SLANT_STD**2 - 0.5 * (across**2).sum(0) / ACROSS_STD**2)
    averaged: np.ndarray = convolve(coefficient, kernel / kernel.sum(), mode="nearest")
    return averaged


def fit_peak(around: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Fit a paraboloid to coefficients around a peak; return its place and curvature (x, y, z), None without a peak.

    In the plane of the lines of sight a peak may be a ridge. Its place there is limited to the fitted lags.
    """
    steps = np.indices(around.shape).reshape(3, -1) - FIT_REACH
    z, y, x = steps
    design = np.stack([np.ones(steps.shape[1]), z, y, x, z * z, y * y, x * x, z * y, z * x, y * x], axis=1)
    _, *slope, zz, yy, xx, zy, zx, yx = np.linalg.lstsq(design, around.ravel(), rcond=None)[0]
    curvature = -np.array([[2 * xx, yx, zx], [yx, 2 * yy, zy], [zx, zy, 2 * zz]])  # order x, y, z from here on
    sizes, axes = np.linalg.eigh(curvature)
    if not sizes[-1] > 0:
        return None
    sizes = np.maximum(sizes, FLATTEST * sizes[-1])
    along = axes.T @ np.array(slope[::-1]) / sizes
    if abs(along[-1]) > FIT_REACH:
        return None
    return axes @ np.clip(along, -FIT_REACH, FIT_REACH), axes * sizes @ axes.T
