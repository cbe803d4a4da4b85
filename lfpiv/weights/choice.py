"""Counted rays (Eq. 10): of a few voxels, the judge of integrated weights and of their form; of all, weights."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.lightfield.microimage_layout import plain
from lfpiv.warn import Code, Warning, warn
from lfpiv.weights.blocks import (
    WHOLE,
    Cuts,
    Progress,
    StoredGrid,
    blocks_of,
    count_voxels,
    pack_camera,
    require_numbers,
)
from lfpiv.weights.ray_fit import fit_rays, ray_models
from lfpiv_kernels.rays.count import POWERS
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, LEVELS

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

VOXELS = 6
"""Voxels counted per camera."""
POOLS = 1 << 12, 1 << 18
"""Random voxels among which those that the camera sees are looked for; the more where the fewer hold too few."""
POINTS, SAMPLES = 16, 36
"""Object points per voxel edge and pupil points per axis of each of two counts: 4e6 rays per voxel, 0.3 to 0.5 % noise,
known from the two and subtracted. Where a voxel is in focus its points alone decide; with 8 and 100 it was 1 to 2 %."""
PROFILES_MEAN, PROFILES_WORST = 0.015, 0.025
"""Largest relative L2 difference from counted rays, mean and worst voxel of the sample, with which profiles serve:
three quarters of the aims below, for a small sample may miss the worst; straight rays have about 0.010, 0.017."""
AIM_MEAN, AIM_WORST = 0.02, 0.035
"""Difference from counted rays, mean and worst voxel of the sample, above which a warning is due."""
CLEARLY = 0.8
"""Pixels, of three times the memory, are taken where their mean difference is at most this part of that of profiles."""
CUTS: tuple[Cuts, ...] = (
    *(WHOLE, (2, 2, 1), (2, 1, 2), (1, 2, 2), (2, 2, 2), (3, 3, 1), (3, 1, 3), (1, 3, 3)),
    *((4, 4, 1), (4, 1, 4), (1, 4, 4), (3, 3, 3), (4, 4, 4)),
)
"""Cuts of a voxel, in the order of their cost. One edge alone is never cut: its projection has a covariance, only all
three together have none, or two where the third lies along an axis of the lenses."""
CUT_NEAR = 0.0125
"""Mean relative L2 difference from the finest cut with which a coarser one serves: with the 0.8 % that straight rays
have anyway it stays below `PROFILES_MEAN`."""
BENT, WIDE = 0.01, 2.0
"""Rays beyond second order, and a voxel's projected edge [microlens pitch], above which they explain a difference: rays
off by a hundredth change weights by about 2 %."""
COUNT_SAMPLES = 36
"""Pupil points per axis when every voxel is counted, about 1,000 per object point."""
COUNT_CHUNK = 64
"""Voxels counted at once: each has a window of the sensor."""
COUNT_TALLEST = 128
"""Rows of a block of counts at most."""


class CountedVoxels:
    """A few random voxels that a camera sees, counted twice with independent rays; none where it sees none."""

    def __init__(self, stored: StoredGrid, camera: CalibratedCamera, seed: int = 0):
        self.stored, self.camera = stored, camera
        self.voxels = draw_seen(stored, camera, seed)
        self.centres_mm = stored.centres_mm(self.voxels)
        if not len(self.voxels):
            return
        counts, total, corner = count_voxels(
            camera,
            np.repeat(self.centres_mm, 2, axis=0),
            stored.grid.voxel_mm,
            samples=SAMPLES,
            points=POINTS,
            seed=seed,
        )
        shares = counts / np.maximum(total, 1)[:, None, None]
        self._corner = corner.reshape(-1, 2, 2).min(1)
        extent = np.array(counts.shape[:0:-1]) + (corner.reshape(-1, 2, 2).max(1) - self._corner).max(0)
        self._halves = np.zeros((len(self.voxels), 2, extent[1], extent[0]), np.float32)
        for number, (share, (column, row)) in enumerate(zip(shares, corner, strict=True)):
            column, row = (column, row) - self._corner[number // 2]
            window = self._halves[number // 2, number % 2, row : row + share.shape[0], column : column + share.shape[1]]
            window[:] = share
        for half, start in zip(self._halves, self._corner, strict=True):
            half *= _cut(camera.gain, start, half.shape[1:])

    def errors(self, blocks: Blocks, voxels: Sequence[int] | None = None) -> list[float]:
        """Relative L2 difference of stored weights from the counts, their noise subtracted; voxels seen only.

        `voxels` are the indices of the counted voxels in `blocks`; default: those of the grid.
        """
        errors = []
        columns = blocks.microimages.sensor_shape[1]
        for number, voxel in enumerate(self.voxels if voxels is None else voxels):
            first, second = self._halves[number].astype(np.float64)
            mean = (first + second) / 2
            light = np.linalg.norm(mean)
            if light == 0:
                continue
            image, corner = np.zeros(mean.shape), self._corner[number]
            ray, weight = blocks.entries(int(voxel))
            pixel = blocks.microimages.pixel[ray]
            seen = pixel >= 0
            row, column = np.divmod(pixel[seen], columns)
            weight = weight[seen] * blocks.microimages.share[ray[seen]] * self.camera.gain[row, column]
            row, column = row - corner[1], column - corner[0]
            inside = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
            np.add.at(image, (row[inside], column[inside]), weight[inside])
            outside = (weight[~inside] ** 2).sum()
            noise = np.linalg.norm(first - second) / 2  # of the mean of the two
            error = np.linalg.norm(image - mean) ** 2 + outside - noise**2
            errors.append(float(np.sqrt(max(error, 0.0)) / light))
        return errors

    def errors_of_form(self, form: str, cuts: Cuts = WHOLE) -> list[float]:
        """Errors of the footprint in a form, of the counted voxels alone."""
        if not len(self.voxels):
            return []
        model = ray_models(self.camera, self.centres_mm, self.stored.grid.voxel_mm)
        blocks = blocks_of(pack_camera(self.camera), [model], form, (0, 0), cuts)
        return self.errors(blocks, range(len(model)))

    def warn(self, form: str, errors: Sequence[float], *, asked: bool) -> None:
        """Warn where the weights of a form were compared with nothing, or are further from the counts than aimed at.

        `asked` tells whether the user asked for the form.
        """
        name = self.camera.name
        if not errors:
            warn(log, Warning(code=Code.WEIGHTS_UNCHECKED, subject=name))
        elif np.mean(errors) > AIM_MEAN or max(errors) > AIM_WORST:
            bent, wide = self._bent(), self._wide()
            if form == "profiles" and asked:
                cause = "profiles suit straight rays and upright arrays; set compute.weights_form to 'auto'"
            elif bent > BENT:
                cause = "aberrations beyond the second order in the pupil point, which weights follow"
            elif wide > WIDE:
                cause = "voxels larger than microlenses; lower volume.voxel_mm"
            else:
                cause = "not known; neither aberrations nor the voxels' size explain it"
            figures = {"form": form, "mean": float(np.mean(errors)), "worst": max(errors), "cause": cause}
            figures |= {"aim_mean": AIM_MEAN, "aim_worst": AIM_WORST, "bent_pitch": bent, "wide_pitch": wide}
            warn(log, Warning(code=Code.WEIGHTS_DIFFER, subject=name, figures=figures))

    def _bent(self) -> float:
        """Furthest that rays depart from their model, second order in the pupil point [microlens pitch]."""
        third, second = (fit_rays(self.camera, self.centres_mm, degree=degree) for degree in (3, 2))
        third[..., : second.shape[-1]] -= second
        angle = np.arange(0, 2 * np.pi, np.pi / 8)
        u, v = self.camera.optics.pupil_radius_mm * np.array([np.cos(angle), np.sin(angle)])
        rays = third @ np.stack([u**a * v**b for a, b in POWERS])
        return float(np.hypot(rays[:, 0], rays[:, 1]).max() / self.camera.lattice.pitch_mm)

    def _wide(self) -> float:
        """Longest edge of a voxel on the array [microlens pitch]."""
        edges = ray_models(self.camera, self.centres_mm, self.stored.grid.voxel_mm)[:, 12:18].reshape(-1, 2)
        return float(np.hypot(*edges.T).max() / self.camera.lattice.pitch_mm)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """How one camera's footprints are computed and stored."""

    form: str
    """"profiles" or "pixels"."""
    cuts: Cuts = WHOLE
    """Parts of the voxels, where the form is "pixels"."""
    profile_errors: list[float] = field(default_factory=list)
    """Difference of profiles from counted rays, where these decided."""


def choose_form(counted: CountedVoxels) -> Choice:
    """Profiles where they are near enough to counted rays, or pixels hardly nearer; says why, and warns."""
    profiles = errors = counted.errors_of_form("profiles")
    choice = Choice(form="profiles", profile_errors=profiles)
    if not profiles_serve(profiles):
        cuts = choose_cuts(counted.stored, counted.camera)
        pixels = counted.errors_of_form("pixels", cuts)
        if np.mean(pixels) <= CLEARLY * np.mean(profiles):
            choice, errors = Choice(form="pixels", cuts=cuts, profile_errors=profiles), pixels
        log.info("%s: pixel by pixel weights differ by %.1f %%", counted.camera.name, 100 * np.mean(pixels))
    if profiles:
        log.info(
            "%s: profiles differ from counted rays by %.1f %% (worst voxel %.1f %%): weights %s",
            *(counted.camera.name, 100 * np.mean(profiles), 100 * max(profiles)),
            "as products of profiles" if choice.form == "profiles" else "pixel by pixel",
        )
    counted.warn(choice.form, errors, asked=False)
    return choice


def profiles_serve(errors: Sequence[float]) -> bool:
    """Whether profiles are near enough to counted rays; where no voxel is seen, the smaller form does."""
    return not errors or bool(np.mean(errors) <= PROFILES_MEAN and max(errors) <= PROFILES_WORST)


def choose_cuts(stored: StoredGrid, camera: CalibratedCamera) -> Cuts:
    """Cut of the voxels that footprints pixel by pixel need: the cheapest one near the finest, in a few voxels."""
    voxels = draw_seen(stored, camera)
    if not len(voxels):
        return WHOLE
    model, pack = ray_models(camera, stored.centres_mm(voxels), stored.grid.voxel_mm), pack_camera(camera)
    finest = blocks_of(pack, [model], "pixels", (0, 0), CUTS[-1])
    for cuts in CUTS[:-1]:
        blocks = blocks_of(pack, [model], "pixels", (0, 0), cuts)
        if np.mean([_difference(blocks, finest, voxel) for voxel in range(len(model))]) <= CUT_NEAR:
            break
    else:
        cuts = CUTS[-1]
    if cuts != WHOLE:
        text = "%s: voxels lie aslant to the microlenses: footprints of %d x %d x %d parts along x, y, z are added"
        log.info(text, camera.name, *cuts)
    return cuts


def _difference(blocks: Blocks, others: Blocks, voxel: int) -> float:
    """Relative L2 difference of one voxel's weights on the sensor."""
    pixels, weights = [], []
    for part, sign in ((blocks, -1), (others, 1)):
        ray, weight = part.entries(voxel)
        pixels.append(part.microimages.pixel[ray])
        weights.append(sign * weight * part.microimages.share[ray])
    _, place = np.unique(np.concatenate(pixels), return_inverse=True)
    difference = np.bincount(place, np.concatenate(weights))
    light = np.bincount(place[len(pixels[0]) :], weights[1])
    return float(np.linalg.norm(difference) / max(np.linalg.norm(light), np.finfo(float).tiny))


def draw_seen(stored: StoredGrid, camera: CalibratedCamera, seed: int = 0) -> np.ndarray:
    """Draw random voxels whose chief rays meet the sensor, `VOXELS` or as many as are found; stored indices, sorted."""
    rng, size = np.random.default_rng(seed), stored.grid.size
    half_mm = np.array(camera.optics.sensor_shape[::-1]) / 2 * camera.optics.pixel_mm
    for pool in POOLS:
        drawn = rng.choice(size, min(pool, size), replace=False)
        chief = camera.map(stored.centres_mm(drawn), np.zeros((len(drawn), 2))) * (1 + camera.optics.sensor_per_pupil)
        seen = drawn[(np.abs(chief) < half_mm).all(-1)]
        if len(seen) >= VOXELS or pool >= size:
            break
    return np.sort(seen[:VOXELS])


def add_entries(image: np.ndarray, blocks: Blocks, voxel: int) -> None:
    """Add one voxel's stored weights to a sensor image, in place."""
    ray, weight = blocks.entries(voxel)
    share = blocks.microimages.share[ray]
    lit = share > 0
    np.add.at(image.ravel(), blocks.microimages.pixel[ray[lit]], weight[lit] * share[lit])


def add_window(image: np.ndarray, window: np.ndarray, corner: np.ndarray) -> None:
    """Add a window whose first pixel is `corner` (column, row) to a sensor image, in place."""
    column, row = (int(c) for c in corner)
    rows = slice(max(row, 0), min(row + window.shape[0], image.shape[0]))
    columns = slice(max(column, 0), min(column + window.shape[1], image.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] += window[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]


def _cut(image: np.ndarray, corner: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cut a window out of a sensor image, zero outside it."""
    out = np.zeros(shape, image.dtype)
    column, row = (int(c) for c in corner)
    rows = slice(max(row, 0), min(row + shape[0], image.shape[0]))
    columns = slice(max(column, 0), min(column + shape[1], image.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        out[rows.start - row : rows.stop - row, columns.start - column : columns.stop - column] = image[rows, columns]
    return out


def count_blocks(stored: StoredGrid, camera: CalibratedCamera, progress: Progress) -> Blocks:
    """Count the rays of every voxel and pack the counts into blocks."""
    rays, size = plain(camera.optics.sensor_shape), stored.grid.size
    warn(log, Warning(code=Code.COUNT_SLOW, subject=camera.name, figures={"voxels": size}))
    parts = []
    for first in range(0, size, COUNT_CHUNK):
        last = min(first + COUNT_CHUNK, size)
        counts, total, corner = count_voxels(
            camera, stored.centres_mm(np.arange(first, last)), stored.grid.voxel_mm, samples=COUNT_SAMPLES, seed=first
        )
        parts.append(_pack_windows(counts / total[:, None, None], corner, camera.optics.sensor_shape, rays.edge))
        progress(last / size)
    blocks, rows, ray, height, value, scale = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    require_numbers(blocks.sum(dtype=np.int64), stored.grid.shape)
    return Blocks(
        form="pixels",
        first_block=np.concatenate([[0], np.cumsum(blocks)]).astype(np.int32),
        first_value=np.concatenate([[0], BLOCK_WIDTH * np.cumsum(rows)]).astype(np.int64),
        ray=ray,
        height=height,
        width=np.full(len(ray), BLOCK_WIDTH, np.uint8),
        value=np.append(value, np.zeros(BLOCK_WIDTH, np.uint8)),
        scale=scale,
        microimages=rays,
    )


def _pack_windows(
    windows: np.ndarray, corner: np.ndarray, sensor_shape: tuple[int, int], stride: int
) -> tuple[np.ndarray, ...]:
    """Pack windows of weights, shape (voxel, rows, columns), into blocks of one column of tiles each.

    Returns blocks and rows per voxel, and the arrays ray, height, value, scale of `Blocks`.
    """
    lanes = BLOCK_WIDTH
    row = corner[:, 1, None] + np.arange(windows.shape[1])
    column = corner[:, 0, None] + np.arange(windows.shape[2])
    seen = ((row >= 0) & (row < sensor_shape[0]))[:, :, None] & ((column >= 0) & (column < sensor_shape[1]))[:, None]
    windows = np.where(seen, windows, 0.0)
    windows = np.pad(windows, ((0, 0), (0, 0), (0, -windows.shape[2] % lanes)))
    tiles = windows.reshape(*windows.shape[:2], -1, lanes).transpose(0, 2, 1, 3)  # voxel, tile column, row, lane
    scale = tiles.max((1, 2, 3)) / LEVELS
    lit = tiles.any(-1)
    place = np.arange(lit.shape[2]) % COUNT_TALLEST
    starts = np.argwhere(lit & ~(np.pad(lit, ((0, 0), (0, 0), (1, 0)))[:, :, :-1] & (place > 0)))
    ends = np.argwhere(lit & ~(np.pad(lit, ((0, 0), (0, 0), (0, 1)))[:, :, 1:] & (place < COUNT_TALLEST - 1)))
    voxel, tile, first = starts.T
    # a tile may begin left of the sensor: its block's pixel then lies at the end of the row above, where weights are 0
    pixel = (corner[voxel, 1] + first) * stride + corner[voxel, 0] + tile * lanes
    unit = np.where(scale > 0, scale, 1.0)
    value = np.rint(tiles[lit] / unit[np.nonzero(lit)[0], None]).astype(np.uint8)
    shift = np.maximum(-pixel, 0)  # above the sensor's first pixel: move the block's lanes instead
    if shift.any():
        rows_of = np.repeat(shift, ends[:, 2] - first + 1)
        for amount in np.unique(rows_of[rows_of > 0]):
            some = rows_of == amount
            value[some] = np.roll(value[some], -amount, axis=1)
        pixel = pixel + shift
    return (
        np.bincount(voxel, minlength=len(windows)),
        np.bincount(voxel, weights=ends[:, 2] - first + 1, minlength=len(windows)).astype(np.int64),
        pixel.astype(np.int32),
        (ends[:, 2] - first + 1).astype(np.uint8),
        value,
        scale.astype(np.float32),
    )
