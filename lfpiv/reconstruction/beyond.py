"""Light beyond the volume: how far particles are lit beyond each face of a grid.

Reconstructed intensity outside the volume proves nothing, because ghosts lie there too. But the images of two cameras
by themselves show whether particles are there. From the sub-aperture images of one camera each point of a coarse padded
grid gets the mean logarithm of the light that its rays meet. Where a particle is, both cameras show it, so their
fluctuations are correlated. Ghosts are crossings of rays from different particles. They appear in the covariance of
different frames as well, as do static light and the edges of the lit region, and this is subtracted. What is left,
averaged over layers parallel to a face and relative to the volume, is the profile of lit particles beyond the face.

Particles inside the volume blur beyond its faces. So light that was found is compared with a null: images of random
particles inside the volume, as many as give images of the same contrast, are measured in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from lfpiv.geometry.grid import Grid, Layers
from lfpiv.geometry.optics import spread_over_pupil

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration

MOST_CELLS = 160_000
"""Largest number of cells. Where the padded volume has more voxels, a cell is larger than a voxel."""
MARGIN = 0.5
"""Distance up to which light is sought beyond every face, as a share of the volume's shortest edge."""
EXTRAPOLATION = 0.25
"""Distance beyond the calibrated region up to which a thin lens is trusted, as a share of the region's edge."""
PUPIL_POINTS, PUPIL_SHARE = 19, 0.75
"""Number of sub-aperture images, and the distance of the outermost from the pupil's centre [pupil radius]."""
BLUR_PX = 3
"""Edge of the square over which raw images are averaged before they are sampled [pixel]."""
BLUR = 0.4
"""Standard deviation of the Gaussian that smooths sub-aperture images [image of a cell, and at least lens]."""
DARK = 0.3
"""Light added before the logarithm, as a share of the image's mean."""
FINE, WIDE = 0.7, 2.5
"""Standard deviations of the Gaussians between which fluctuations lie [cell]."""
LEAST_LIT = 0.25
"""Least profile of a layer that counts as lit, relative to the mean of the volume."""
SIGNIFICANT, CONFIRMED = 3.8, 3.0
"""Detection limits of light [standard deviation of chance]: for the first face with light beyond it, and for the others
after it."""
LEAST_SEEN = 0.5
"""Least share of a layer that two cameras must see."""
SEEN_RAYS = 0.9
"""Least share of the rays of a cell that a camera must see."""
LEAST_RESPONSE = 0.3
"""Least response of a pixel to white light that is used, relative to the median."""
CLEAR = 4.0
"""Least covariance within the volume for a measurement [standard deviation of chance]."""
SHIFTS = (5, 11)
"""Shifts of one camera's light at which chance is measured: the first, and the one after the last [cell]."""
DRAWS = 16
"""Sets of random particles inside the volume that light beyond it is compared with."""
DRAWN, MOST_DRAWN = 1000, 100_000
"""Particles whose contrast tells the number for the images' contrast, and the largest number."""
GRAIN = 2.0
"""Standard deviation of the Gaussian above which light counts as grains, the particles [lens]."""


@dataclass(frozen=True, kw_only=True)
class FaceLight:
    """Light beyond one face of the volume."""

    axis: int
    """Axis across the face: 0, 1, 2 for z, y, x."""
    side: int
    """0 for the face at the low end of the axis, 1 for the other."""
    reach_mm: float
    """Distance up to which particles are lit [mm]."""
    share: float
    """Light beyond the face relative to that of the volume."""
    guard_mm: float
    """Thickness of the guard layers that hold this light, as far as the cameras see and are calibrated [mm]."""
    farther: bool
    """Whether the light may reach farther than it is measured. What cameras do not see sends them no light."""
    limit: str
    """What limits the measurement."""


def light_beyond(
    calibration: Calibration, grid: Grid, pairs: Sequence[Sequence[Mapping[str, np.ndarray]]]
) -> tuple[FaceLight, ...]:
    """Measure how far particles are lit beyond the faces of a grid.

    Parameters
    ----------
    calibration : Calibration
        Cameras. With one camera nothing can be measured.
    pairs : sequence of sequence of dict
        Particle images of some frames, in groups of frames that show the same particles, such as the frames of a
        pair: camera name -> image (rows, columns), background removed [counts].

    Returns
    -------
    tuple of FaceLight
        Faces with significant light beyond them.

    Raises
    ------
    ValueError
        If no images are given.
    """
    if not pairs or not all(pairs):
        raise ValueError("pairs: expected the images of at least one frame in each group, got none.")
    if len(calibration.cameras) < 2:
        return ()
    search = _Search.around(grid, calibration)
    group = np.repeat(np.arange(len(pairs)), [len(frames) for frames in pairs])
    views = [_View(camera, search.grid) for camera in calibration.cameras.values()]
    images = [one for frames in pairs for one in frames]
    light = [[view.light(one[name]) for one in images] for name, view in zip(calibration.cameras, views, strict=True)]
    profiles = _profiles(views, light, search, group)
    if not _lit_faces(profiles, search, [np.zeros((1, n)) for n in search.grid.shape]):
        return ()
    return tuple(_lit_faces(profiles, search, _null(views, light, search, grid)))


def _profiles(
    views: Sequence[_View], light: Sequence[Sequence[np.ndarray]], search: _Search, group: np.ndarray
) -> list[_Profile]:
    """Return the profile along each axis of the sub-aperture images of all views."""
    fluctuations = [np.stack([*map(view.fluctuation, each)]) for view, each in zip(views, light, strict=True)]
    return [_profile(fluctuations, [view.seen for view in views], search, group, axis) for axis in range(3)]


def _lit_faces(profiles: Sequence[_Profile], search: _Search, null: Sequence[np.ndarray]) -> list[FaceLight]:
    """Return the significant faces, beyond what `null` expects in the layers of each axis."""
    clear = [axis for axis, profile in enumerate(profiles) if profile.is_clear(search.inner(axis))]
    each = (_face(profiles[axis], search, axis, side, null[axis]) for axis in clear for side in (0, 1))
    found = [face for face in each if face is not None]
    some = any(significance > SIGNIFICANT for significance, _ in found)
    return [face for significance, face in found if some and significance > CONFIRMED]


def _null(
    views: Sequence[_View], light: Sequence[Sequence[np.ndarray]], search: _Search, volume: Grid
) -> list[np.ndarray]:
    """Return the relative profiles of particles inside the volume alone, for each axis, shape (draw, layer)."""
    rng = np.random.default_rng(0)

    def draw(count: int) -> np.ndarray:
        size = volume.voxel_mm * np.array(volume.shape[::-1])
        return volume.centre_mm + rng.uniform(-0.5, 0.5, (count, 3)) * size

    def contrast(images: Sequence[Sequence[np.ndarray]]) -> float:
        found = [view.contrast(one) for view, each in zip(views, images, strict=True) for one in each]
        return float(np.mean(found))

    some = draw(DRAWN)
    known = contrast([[view.light_of(some)] for view in views])
    count = int(np.clip(DRAWN * known / max(contrast(light), 1e-9), 2, MOST_DRAWN))
    profiles = [list[np.ndarray]() for _ in range(3)]
    for _ in range(DRAWS):
        points = draw(count)
        drawn = _profiles(views, [[view.light_of(points)] for view in views], search, np.zeros(1, int))
        for axis, (found, profile) in enumerate(zip(profiles, drawn, strict=True)):
            found.append(profile.same / profile.same[search.inner(axis)].mean())
    return [np.array(found) for found in profiles]


@dataclass(frozen=True, kw_only=True)
class _Search:
    """Coarse grid of the volume and its surroundings."""

    grid: Grid
    layers: Layers
    """Layers of cells beyond the faces."""
    limits: Mapping[tuple[int, int], str]
    """Axis and side -> what limits the number of layers."""

    @classmethod
    def around(cls, volume: Grid, calibration: Calibration) -> _Search:
        """Pad the volume as far as the cameras are calibrated, `MARGIN` at most."""
        edges = [n * volume.voxel_mm for n in reversed(volume.shape)]
        padded = math.prod(edge + 2 * MARGIN * min(edges) for edge in edges)
        cell = max(volume.voxel_mm, (padded / MOST_CELLS) ** (1 / 3))
        x, y, z = volume.centre_mm.tolist()
        inner = Grid.from_extent(
            centre_mm=(x, y, z), size_mm=(max(edges[0], cell), max(edges[1], cell), max(edges[2], cell)), voxel_mm=cell
        )
        counts, limits = [[0, 0], [0, 0], [0, 0]], {}
        for axis, side in product(range(3), (0, 1)):
            face = volume.centre_mm[2 - axis] + (side - 0.5) * edges[2 - axis]
            calibrated = min(_calibrated_mm(camera, 2 - axis, side, face) for camera in calibration.cameras.values())
            distance = min(MARGIN * min(edges), max(calibrated, 0.0))
            counts[axis][side] = math.floor(distance / cell + 1e-6)
            limits[axis, side] = (
                "the end of the calibrated region" if calibrated < MARGIN * min(edges) else "the end of the search"
            )
        (z0, z1), (y0, y1), (x0, x1) = counts
        layers = ((z0, z1), (y0, y1), (x0, x1))
        return cls(grid=inner.padded(layers), layers=layers, limits=limits)

    def inner(self, axis: int) -> slice:
        """Return the layers across an axis that lie within the volume."""
        low, high = self.layers[axis]
        return slice(low, self.grid.shape[axis] - high)


def _calibrated_mm(camera: CalibratedCamera, column: int, side: int, face: float) -> float:
    """Return the distance beyond a face up to which the mapping of a camera is trusted [mm]."""
    if camera.region_mm is None:
        return math.inf
    low, high = camera.region_mm[:, column]
    more = 0.0 if camera.baseline is None else EXTRAPOLATION * (high - low)
    return float(high + more - face if side else face - low + more)


class _View:
    """Light of a camera's rays at the cells of a grid."""

    def __init__(self, camera: CalibratedCamera, grid: Grid):
        optics, lattice, decoder = camera.optics, camera.lattice, camera.decoder
        self._shape, self._sensor = grid.shape, optics.sensor_shape
        self._blur_lenses = BLUR * max(grid.voxel_mm * abs(optics.magnification) / lattice.pitch_mm, 1.0)
        pupil = spread_over_pupil(1.0)[:PUPIL_POINTS]
        pupil *= PUPIL_SHARE * optics.pupil_radius_mm / np.linalg.norm(pupil, axis=1).max()
        lenses = decoder.lens_grid()
        self._camera, self._pupil, self._first_lens = camera, pupil, lenses[0, 0]
        self._places = self._places_of(grid.centres_mm())
        at = lattice.centres_mm(lenses) * (1 + optics.sensor_per_pupil)
        pixels = np.rint(optics.sensor_px(at - pupil[:, None, None] * optics.sensor_per_pupil)).astype(int)
        column, row = np.moveaxis(pixels, -1, 0)
        inside = (row >= 0) & (row < self._sensor[0]) & (column >= 0) & (column < self._sensor[1])
        self._pixels = np.where(inside, row * self._sensor[1] + column, 0)
        response = ndimage.uniform_filter(np.asarray(decoder.coverage * camera.gain, np.float32), BLUR_PX)
        self._response = np.where(inside, response.reshape(-1)[self._pixels], 0.0)
        self._response[self._response < LEAST_RESPONSE * np.median(self._response[inside])] = 0.0
        self._weight = self._smooth(self._response > 0)
        reached = [self._at_cells(one, number) for number, one in enumerate((self._weight > 0.5).astype(np.float32))]
        self.seen: np.ndarray = np.mean(reached, axis=0) > SEEN_RAYS
        """Cells of which the camera sees nearly all rays, shape (z, y, x)."""

    def light(self, image: np.ndarray) -> np.ndarray:
        """Return the smoothed sub-aperture images of a raw image, shape (pupil point, row, column)."""
        light = ndimage.uniform_filter(np.asarray(image, np.float32), BLUR_PX).reshape(-1)[self._pixels]
        light = np.divide(light, self._response, out=np.zeros_like(light), where=self._response > 0)
        return self._smooth(light) / np.maximum(self._weight, 1e-3)

    def light_of(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the smoothed sub-aperture images of points of equal brightness, shape (pupil point, row, column)."""
        light = np.zeros(self._weight.shape, np.float32)
        place = self._places_of(points_mm)  # pupil point, 2, point
        for number, (row, column) in enumerate(place):
            low = np.floor([row, column]).astype(int)
            part = np.array([row, column]) - low
            for i, j in product((0, 1), repeat=2):
                share = np.abs(1 - i - part[0]) * np.abs(1 - j - part[1])
                at = low + [[i], [j]]
                inside = np.all((at >= 0) & (at < np.array(light.shape[1:])[:, None]), axis=0)
                np.add.at(light[number], tuple(at[:, inside]), share[inside])
        return self._smooth(light * (self._response > 0)) / np.maximum(self._weight, 1e-3)

    def contrast(self, light: np.ndarray) -> float:
        """Return the variance of the grains of sub-aperture images over their squared mean, 1 / n for n particles."""
        grains = light - ndimage.gaussian_filter(light, (0, GRAIN, GRAIN))
        seen = self._weight > 0.5
        return float(grains[seen].var() / max(float(light[seen].mean()), 1e-9) ** 2)

    def fluctuation(self, light: np.ndarray) -> np.ndarray:
        """Return the fluctuation of the mean logarithm of the light at the cells, shape (z, y, x)."""
        logarithm = np.log(np.maximum(light / max(float(light.mean()), 1e-9), 0.0) + DARK)
        mean = sum(self._at_cells(one, number) for number, one in enumerate(logarithm)) / len(logarithm)
        return ndimage.gaussian_filter(mean, FINE) - ndimage.gaussian_filter(mean, WIDE)

    def _places_of(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the places of points in the sub-aperture images, shape (pupil point, 2, point) [lens]."""
        lattice = self._camera.lattice
        rays = np.moveaxis(self._camera.map_fan(points_mm, self._pupil), 1, 0) - np.asarray(lattice.origin_mm)
        lenses = rays @ np.linalg.inv(np.asarray(lattice.basis_mm)) - self._first_lens
        return np.moveaxis(lenses, -1, 1)

    def _smooth(self, values: np.ndarray) -> np.ndarray:
        """Return blurred sub-aperture images, shape (pupil point, row, column)."""
        size = (0.0, self._blur_lenses, self._blur_lenses)
        return ndimage.gaussian_filter(values.astype(np.float32), size, mode="constant")

    def _at_cells(self, values: np.ndarray, number: int) -> np.ndarray:
        """Return the values of sub-aperture image `number` at the cells, shape (z, y, x)."""
        sampled: np.ndarray = ndimage.map_coordinates(values, self._places[number], order=1, cval=0.0, prefilter=False)
        return sampled.reshape(self._shape)


@dataclass(frozen=True, kw_only=True)
class _Profile:
    """Covariance of two cameras in the layers across one axis."""

    same: np.ndarray
    """Of frames with themselves, less what chance gives, shape (layer,)."""
    chance: np.ndarray
    """Deviations of products that only chance correlates from their mean, shape (layer, sample)."""
    frames: int
    groups: int
    """Groups of frames, each of which shows particles of its own."""
    seen: np.ndarray
    """Whether two cameras see most of the layer, shape (layer,), bool."""

    def deviation(self, layers: np.ndarray) -> float:
        """Return the standard deviation of the sum of `same` over layers if they hold no particles."""
        return float(self.chance[layers].sum(0).std() / np.sqrt(self.frames))

    def is_clear(self, inner: slice) -> bool:
        """Return whether the layers inside the volume show particles beyond chance."""
        return bool(self.same[inner].sum() > CLEAR * self.deviation(np.arange(len(self.same))[inner]))


def _profile(
    fluctuations: Sequence[np.ndarray], seen: Sequence[np.ndarray], search: _Search, group: np.ndarray, axis: int
) -> _Profile:
    """Average the covariances of all pairs of cameras over the layers across an axis."""
    window = tuple(slice(None) if other == axis else search.inner(other) for other in range(3))

    def layered(values: np.ndarray) -> np.ndarray:
        """Return the part in the window, shape (layer, frame, cell)."""
        moved = np.moveaxis(values[(slice(None), *window)], axis + 1, 0)
        return moved.reshape(*moved.shape[:2], -1)

    along = 3 if axis == 1 else 2  # shifts lie within the layers
    shifts = [sign * lag for lag in range(*SHIFTS) for sign in (1, -1)]
    different = group[:, None] != group[None, :]
    parts = []
    for a, b in combinations(range(len(fluctuations)), 2):
        both = layered((seen[a] & seen[b])[None].astype(np.float32))
        first, second = layered(fluctuations[a]) * both, layered(fluctuations[b])
        covariance = first @ np.swapaxes(second, 1, 2)  # layer, frame, frame
        moved = [(first * layered(np.roll(fluctuations[b], shift, along))).sum(2) for shift in shifts]
        shifted = np.stack(moved, axis=2)  # layer, frame, shift
        others = covariance[:, different] if different.any() else shifted.reshape(len(both), -1)
        same = np.einsum("lii->l", covariance) / len(group) - others.mean(1)
        mean, free = shifted.mean(1 if len(group) > 1 else (1, 2), keepdims=True), max(len(group) - 1, 1)
        chance = [others - others.mean(1, keepdims=True), (shifted - mean) * np.sqrt(len(group) / free)]
        parts.append((same, np.hstack([each.reshape(len(both), -1) for each in chance]), both.sum((1, 2))))
    same, chance, counts = (sum(part) for part in zip(*parts, strict=True))
    covered = counts > LEAST_SEEN * len(parts) * both.shape[2]
    counts = np.maximum(counts, 1.0)
    return _Profile(
        same=same / counts,
        chance=chance / counts[:, None],
        frames=len(group),
        groups=len(np.unique(group)),
        seen=covered,
    )


def _face(profile: _Profile, search: _Search, axis: int, side: int, null: np.ndarray) -> tuple[float, FaceLight] | None:
    """Find how far light reaches beyond a face, and its significance; None if there is none.

    `null` is the relative profile without light beyond the face, of several draws, shape (draw, layer). The layer next
    to the face is blurred by light from within, so light must reach the second one.
    """
    inner, cell = search.inner(axis), search.grid.voxel_mm
    count = search.layers[axis][side]
    outside = inner.stop + np.arange(count) if side else inner.start - 1 - np.arange(count)
    outside = outside[np.logical_and.accumulate(profile.seen[outside])]
    if len(outside) < 2:
        return None
    level = profile.same[inner].mean()
    relative = profile.same / level - null.mean(0)
    excess = np.cumsum(relative[outside[1:]] - LEAST_LIT)
    lit = int(excess.argmax()) + 2
    layers = outside[1:lit]
    deviation = math.hypot(profile.deviation(layers) / level, null[:, layers].sum(1).std() / profile.groups**0.5)
    if not (excess[lit - 2] > 0 and deviation > 0):
        return None
    return float(relative[layers].sum()) / deviation, FaceLight(
        axis=axis,
        side=side,
        reach_mm=round(lit * cell, 3),
        share=round(float(relative[outside[:lit]].sum() / (inner.stop - inner.start)), 4),
        guard_mm=round(min(lit + 1, len(outside)) * cell, 3),
        farther=lit == count,
        limit=search.limits[axis, side],
    )
