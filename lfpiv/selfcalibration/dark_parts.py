"""Dark parts of sensors: regions where a camera shows no particles although the other cameras see them there.

The white image tells which pixels are lit, the volume of the other cameras where they would show particles. Regions
beyond a light sheet stay dark in that projection, too. How far image and projection differ in the rest of the same
sensor is the measure of chance: it grows where particles are few or unequal. Besides, so few particles may miss a
region by chance: their number is counted in the images.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from lfpiv.reconstruction.settings import PLAIN, SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.selfcalibration.belonging import ITERATIONS, PART_LENSES
from lfpiv.selfcalibration.mistakes import Images
from lfpiv.weights.operator import Weights

CLEAR = 6.0
"""Least lack of light of a dark part [standard errors]. The darkest rectangle of a sound sensor lacks up to 5."""
STANDS_OUT = 2.0
"""Least lack of light of a dark part, over the lack in any other camera: where particles are few, all lack some."""
CELLS = 12
"""Largest number of cells along each edge of the region of a sensor that sees the volume."""
DARK = 0.25
"""Largest root of a dark region's light, over the root of the expected light."""
LEAST_SHARE = 0.1
"""Least share of a sensor's expected light in a dark region. Other cameras smear dim light beyond an edge of the
seeding, and its root would seem much."""
LARGEST_SHARE = 0.75
"""Largest share: the rest is what the region is compared with."""
BLOCK = 3
"""Edge of the blocks whose scatter is measured [cell]: the light of a particle reaches over neighbouring cells."""
BRIGHTEST = 99.9
"""Percentile to which counts are limited, so that hot pixels have no weight."""
CHANCE = 0.01
"""Largest number of rectangles that counted particles miss by chance, as far as they miss a dark part."""


@dataclass(frozen=True)
class DarkPart:
    """Region of a sensor that shows no particles where other cameras see some."""

    camera: str
    rows: tuple[int, int]
    columns: tuple[int, int]
    """First and last pixel."""
    lack: float
    """Missing light [standard errors]."""
    share: float
    """Share of the sensor's expected light that the region would show."""
    seen: float
    """Share of the sensor's light that it shows."""
    rectangles: int
    """Number of rectangles with this share or more that might be dark by chance. Of those that differ in their last
    column only, the smallest one counts."""

    def by_chance(self, particles: float) -> float:
        """Return how many rectangles so many particles miss by chance, as far as they miss this one."""
        missed = stats.binom.cdf(round(self.seen * particles), round(particles), self.share)
        return self.rectangles * float(missed)


class _Cells:
    """Cells of one camera's sensor, within the region that sees the volume."""

    def __init__(self, weights: Weights, name: str):
        self.camera, camera = name, weights.cameras[name]
        self.weights = weights.of_camera(name)
        self.weights.cameras[name] = replace(camera, standing=None)  # a part that repeats one count is unusable, too
        optics, usable = camera.optics, camera.white_gain > 0
        if camera.standing is not None:
            usable &= ~(camera.standing.unusable & camera.standing.region)
        pixels = weights.projector(name).map.pixel
        self._pixels = np.unique(pixels[usable.ravel()[pixels]])
        places = np.stack(np.divmod(self._pixels, optics.sensor_shape[1]))
        low, extent = places.min(1, keepdims=True), np.ptp(places, 1, keepdims=True) + 1
        counts = np.clip(extent / (PART_LENSES * optics.microimage_pitch_px), 1, CELLS).astype(int)
        cell = (places - low) * counts // extent
        self._shape = int(counts[0, 0]), int(counts[1, 0])
        self._cell = np.ravel_multi_index((cell[0], cell[1]), self._shape)
        self._edges = [
            start + np.arange(n + 1) * size // n for start, size, n in np.column_stack((low, extent, counts)).tolist()
        ]

    def projected(self, volume: np.ndarray) -> np.ndarray:
        """Return the light that a volume projects into each cell, shape (row, column)."""
        return self.light(self.weights(volume)[self.camera])

    def light(self, image: np.ndarray) -> np.ndarray:
        """Return the light in each cell, shape (row, column)."""
        seen = image.ravel()[self._pixels]
        seen = np.minimum(seen, np.percentile(seen, BRIGHTEST))
        return np.bincount(self._cell, seen, self._shape[0] * self._shape[1]).reshape(self._shape)

    def particles(self, images: Sequence[np.ndarray]) -> float:
        """Return the number of particles of equal light that images show; a particle that rests counts once.

        Light counts as far as it exceeds the median. Images of particles that overlap count less, so that dense seeding
        gives a lower bound.
        """
        seen = [image.ravel()[self._pixels] for image in images]
        lit = [light for one in seen if (light := np.maximum(one - np.median(one), 0)).any()]
        apart = np.zeros(self.weights.grid.shape, np.float32)  # four voxels whose images do not overlap
        for corner, (y, x) in enumerate(np.ndindex(2, 2)):
            quarters = (1 + 2 * (corner in (1, 2)), 1 + 2 * y, 1 + 2 * x)
            apart[tuple(size * far // 4 for size, far in zip(apart.shape, quarters, strict=True))] = 1
        particle = _spread(self.weights(apart)[self.camera].ravel()[self._pixels]) / 4
        if not lit or not particle:
            return 0.0
        some = np.any(lit, axis=0)
        alike = np.maximum(np.corrcoef([light[some] for light in lit]), 0).sum()
        return float(sum(map(_spread, lit)) * len(lit) / (alike * particle))

    def darkest(self, seen: np.ndarray, expected: np.ndarray) -> DarkPart | None:
        """Return the rectangle of cells that lacks most light, if one is dark.

        Roots make cells alike whose particles are unequal. Light outside a rectangle gives the scale of the projection.
        """
        rows, columns = (np.triu_indices(size + 1, 1) for size in self._shape)
        share, shown = (_sums(light, rows, columns) / light.sum() for light in (expected, seen))
        seen, expected = (np.sqrt(np.maximum(light, 0)) for light in (seen, expected))
        inside, due = (_sums(light, rows, columns) for light in (seen, expected))
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = (seen.sum() - inside) / (expected.sum() - due)
            lack = (scale * due - inside) / np.sqrt(scale * due)
            lack[~((share >= LEAST_SHARE) & (share <= LARGEST_SHARE) & (inside <= DARK * scale * due))] = 0
        at = np.unravel_index(lack.argmax(), lack.shape)
        if not lack[at] > 0:
            return None
        top, bottom = (int(ends[at[0]]) for ends in rows)
        left, right = (int(ends[at[1]]) for ends in columns)
        rest = np.ones(self._shape)
        rest[top:bottom, left:right] = 0
        error, due_there = rest * (seen - scale[at] * expected), rest * scale[at] * expected
        corners = [np.arange(0, size, BLOCK) for size in self._shape]
        blocks = np.add.reduceat(np.add.reduceat(error, corners[0], 0), corners[1], 1)
        chance = np.sqrt((blocks**2).sum() / due_there.sum())
        return DarkPart(
            camera=self.camera,
            rows=(int(self._edges[0][top]), int(self._edges[0][bottom]) - 1),
            columns=(int(self._edges[1][left]), int(self._edges[1][right]) - 1),
            lack=float(lack[at] / chance) if chance > 0 else np.inf,
            share=float(share[at]),
            seen=float(shown[at]),
            rectangles=sum(int((share[:, columns[0] == first] >= share[at]).any(1).sum()) for first in set(columns[0])),
        )


def _spread(light: np.ndarray) -> float:
    """Return the number of pixels of equal light that would scatter as much about zero."""
    return float(light.sum(dtype=float) ** 2 / np.square(light).sum(dtype=float)) if light.any() else 0.0


def _sums(light: np.ndarray, rows: tuple[np.ndarray, ...], columns: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return the sums over all rectangles of cells, shape (pair of rows, pair of columns)."""
    total = np.pad(light, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    strips = total[rows[1]] - total[rows[0]]
    found: np.ndarray = strips[:, columns[1]] - strips[:, columns[0]]
    return found


def find(weights: Weights, pairs: Iterable[Sequence[Images]]) -> list[DarkPart]:
    """Find the dark parts of all sensors, the largest of each.

    Cameras without a dark region among the pixels that see the volume cost a single projection.

    Parameters
    ----------
    weights : Weights
        The operator of two or more cameras.
    pairs : iterable of sequence of Images
        Images of both frames of each pair. Later pairs are used while a region is in doubt.
    """
    cells = {name: _Cells(weights, name) for name in weights.cameras}
    seen = {name: np.zeros(()) for name in cells}
    expected, solvers, clear, used = dict(seen), dict[str, SmartSolver](), list[DarkPart](), list[Images]()
    for number, pair in enumerate(pairs):
        used.append(pair[0])
        for name in solvers if number else cells:
            seen[name] = seen[name] + sum(cells[name].light(images[name]) for images in pair)
        if not number:
            solvers = _solvers_of_others(weights, cells, seen)
        for name, solver in solvers.items():
            for volume in _volumes(solver, pair):
                expected[name] = expected[name] + cells[name].projected(volume)
        found = [part for name in solvers if (part := cells[name].darkest(seen[name], expected[name]))]
        clear = [part for part in found if part.lack > CLEAR and _stands_out(part, found)]
        particles = {one.camera: cells[one.camera].particles([images[one.camera] for images in used]) for one in clear}
        clear = [one for one in clear if one.by_chance(particles[one.camera]) < CHANCE]
        if clear or not any(STANDS_OUT * part.lack > CLEAR for part in found):
            break
    return clear


def _solvers_of_others(
    weights: Weights, cells: Mapping[str, _Cells], seen: Mapping[str, np.ndarray]
) -> dict[str, SmartSolver]:
    """Return, for each camera with a dark region in the light that it has seen, a solver of the other cameras."""
    even = np.ones(weights.grid.shape, np.float32)
    dark = [name for name, one in cells.items() if one.darkest(seen[name], one.projected(even))]
    settings = SmartSettings(iterations=ITERATIONS, **PLAIN)
    return {name: SmartSolver(weights.without(name), settings) for name in dark}


def _volumes(solver: SmartSolver, pair: Sequence[Images]) -> Iterator[np.ndarray]:
    """Yield the volumes of a pair by the cameras of a solver."""
    for images in pair:
        yield solver.solve({name: images[name] for name in solver.weights.cameras}).volume


def _stands_out(part: DarkPart, found: Iterable[DarkPart]) -> bool:
    return all(part.lack > STANDS_OUT * other.lack for other in found if other is not part)
