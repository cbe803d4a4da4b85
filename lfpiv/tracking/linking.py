"""`link_particles`: the displacement of single particles between two frames, with a correlation field as predictor.

Particles are linked where each is the other's best match in position and light, and no other match is nearly as good.
The first pass measures how far links lie from the predictor, the second one searches as far as that. Links that do not
agree with those nearby are outliers: the normalised test of [1]_, with a plane through the neighbours in place of their
median.

.. [1] J. Duncan et al., "Universal outlier detection for particle image velocimetry (PIV) and particle tracking
   velocimetry (PTV) data", Meas. Sci. Technol. 21 (2010) 057002, doi:10.1088/0957-0233/21/5/057002.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.interpolate import NearestNDInterpolator, RegularGridInterpolator
from scipy.spatial import cKDTree

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import is_finite
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.table import link_table

FIRST_SPREAD_VOXEL = 0.7
"""Standard deviation of true displacements about the predictor that the first pass assumes [voxel]."""
SPREAD_PERCENTILE = 95.0
"""Percentile of the distances of links from their neighbours' median that counts as two standard deviations."""
LEAST_SPREAD_VOXEL = 0.1
"""Least spread that the second pass assumes [voxel]."""
REACH = 4.0
"""Largest distance of a link from the predictor [standard deviation]."""
LIGHT_SPREAD = 0.35
"""Standard deviation of the logarithm of a particle's light between two frames."""
AMBIGUOUS = 6.0
"""Least difference of cost between a link and the next best link; nearer rivals drop both."""
NEIGHBOURS = 10
"""Links about a link that judge it."""
RESIDUAL_LIMIT = 4.0
"""Largest normalised residual of a valid link."""
SCATTER_FLOOR_VOXEL = 0.1
"""Least scatter of neighbours that is assumed [voxel]."""
GRADIENT = 0.1
"""Usual gradient of the displacement, which holds the plane through few links [voxel/voxel]. Correlation, the usual
predictor, bears hardly more."""
OUTLIER_SIGMA = 2.0
"""Residual at which a link counts half [standard deviation]."""
FITS = 5
"""Fits of the plane, each with weights from the one before."""
NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def link_particles(
    first: FoundParticles,
    second: FoundParticles,
    vectors: xr.Dataset | None = None,
    *,
    dt_s: float,
    spread_voxel: float = FIRST_SPREAD_VOXEL,
) -> xr.Dataset:
    """Link the particles of two frames.

    Parameters
    ----------
    first, second : FoundParticles
        From `find_particles`, with equal voxels.
    vectors : Dataset, optional
        Displacement field of the pair, from `correlate`. Default: no displacement, so that only particles that move
        less than about `REACH` times `spread_voxel` are linked.
    dt_s : float
        Time between the frames, > 0 [s].
    spread_voxel : float
        Standard deviation of true displacements about the predictor that is assumed at first, > 0 [voxel].

    Returns
    -------
    Dataset
        A table over ``particle``, see `lfpiv.tracking.table`. Positions are midway between both frames.

    Raises
    ------
    ValueError
        If an argument is out of its range, or the voxels differ.
    """
    if not (is_finite(dt_s) and dt_s > 0):
        raise ValueError(f"dt_s: expected a number > 0, got {dt_s!r}.")
    links = linked(first, second, vectors, spread_voxel=spread_voxel)
    return link_table(first, second, links.pairs, links.valid, dt_s=dt_s)


@dataclass(frozen=True, kw_only=True)
class Links:
    """Links between the particles of two frames, and the flow that they show."""

    pairs: np.ndarray
    """Numbers of the first and the second particle of each link, shape (link, 2)."""
    valid: np.ndarray
    """Links that passed validation, shape (link,), bool."""
    flow: Flow

    def unlinked(self, frame: int, count: int) -> np.ndarray:
        """Return the numbers of those of `count` particles of a frame, 0 or 1, that have no valid link."""
        return np.setdiff1d(np.arange(count), self.pairs[self.valid, frame])


@dataclass(frozen=True, kw_only=True)
class Flow:
    """Displacement of particles: a predictor, corrected by the links nearby."""

    predictor: _Predictor
    places_voxel: np.ndarray
    """First particles of valid links [voxel], shape (link, 3)."""
    off_voxel: np.ndarray
    """Their displacement beyond the predictor [voxel], shape (link, 3)."""

    @property
    def known(self) -> bool:
        """Whether there are links enough about every place."""
        return len(self.places_voxel) > NEIGHBOURS

    def __call__(self, positions_mm: np.ndarray) -> np.ndarray:
        """Return the displacement [mm] of particles at places in the first frame, shape (particle, 3)."""
        voxel_mm, found = self.predictor.voxel_mm, self.predictor(positions_mm)
        if self.known:
            found = found + nearby(self.places_voxel, self.off_voxel, positions_mm / voxel_mm)[0]
        return found * voxel_mm

    def back(self, positions_mm: np.ndarray) -> np.ndarray:
        """Return the displacement [mm] of particles at places in the second frame to the first one."""
        moved = np.zeros_like(positions_mm)
        for _ in range(3):  # the flow is known at the first place
            moved = -self(positions_mm + moved)
        return moved


def linked(
    first: FoundParticles,
    second: FoundParticles,
    vectors: xr.Dataset | None = None,
    *,
    spread_voxel: float = FIRST_SPREAD_VOXEL,
) -> Links:
    """Link the particles of two frames; arguments and exceptions as of `link_particles`."""
    if not (is_finite(spread_voxel) and spread_voxel > 0):
        raise ValueError(f"spread_voxel: expected a number > 0, got {spread_voxel!r}.")
    if not np.isclose(first.voxel_mm, second.voxel_mm, rtol=1e-6):
        raise ValueError(f"second: expected voxels of {first.voxel_mm:g} mm, got {second.voxel_mm:g} mm.")
    predictor = _Predictor(vectors, first.voxel_mm)
    predicted = own = predictor(first.positions_mm)
    pairs = np.zeros((0, 2), int)
    if len(first) and len(second):
        pairs = _matched(first, second, predicted, np.full(3, spread_voxel))
        if len(pairs) > NEIGHBOURS:
            predicted, spread = _corrected(first, second, pairs, predicted)
            pairs = _matched(first, second, predicted, spread)
    valid = _validated(first, second, pairs, predicted)
    a, b = pairs[valid].T
    places = first.positions_mm[a] / first.voxel_mm
    off = second.positions_mm[b] / first.voxel_mm - places - own[a]
    return Links(pairs=pairs, valid=valid, flow=Flow(predictor=predictor, places_voxel=places, off_voxel=off))


@dataclass
class _Predictor:
    """Displacement field between the centres of windows, nearest valid vectors beyond them."""

    vectors: xr.Dataset | None
    voxel_mm: float

    def __call__(self, positions_mm: np.ndarray) -> np.ndarray:
        """Return the displacement of particles of the first frame, shape (particle, 3) [voxel]."""
        if self.vectors is None or not bool(self.vectors["valid"].any()):
            return np.zeros_like(positions_mm)
        found = np.zeros_like(positions_mm)
        for _ in range(2):  # the field is known midway
            found = self._at(positions_mm + found * self.voxel_mm / 2)
        return found

    def _at(self, positions_mm: np.ndarray) -> np.ndarray:
        assert self.vectors is not None
        axes = [self.vectors[axis].values for axis in AXES]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        valid = self.vectors["valid"].values.reshape(-1)
        scale = np.atleast_1d(self.vectors.attrs["voxel_mm"])[::-1] / self.voxel_mm
        field = np.stack([self.vectors[f"displacement_{axis}"].values.reshape(-1) for axis in "xyz"], axis=1) * scale
        filled = NearestNDInterpolator(nodes[valid], field[valid])(nodes)
        several = [len(axis) > 1 for axis in axes]
        place = np.clip(positions_mm[:, ::-1], [axis[0] for axis in axes], [axis[-1] for axis in axes])
        if not any(several):
            return np.repeat(filled[:1], len(positions_mm), axis=0)
        grid = filled.reshape(*map(len, axes), 3).squeeze(axis=tuple(np.flatnonzero(~np.array(several))))
        kept = [axis for axis, more in zip(axes, several, strict=True) if more]
        return RegularGridInterpolator(kept, grid)(place[:, several])


def _matched(
    first: FoundParticles, second: FoundParticles, predicted: np.ndarray, spread_voxel: np.ndarray
) -> np.ndarray:
    """Return the links of particles about a prediction, shape (link, 2), in the order of the first particles."""
    expected = first.positions_mm / first.voxel_mm + predicted
    found = second.positions_mm / first.voxel_mm
    variances = [np.square(one.errors_mm / first.voxel_mm) for one in (first, second)]
    return matched(expected, found, (variances[0] + np.square(spread_voxel), variances[1]), (first.light, second.light))


def matched(
    predicted: np.ndarray,
    found: np.ndarray,
    variances: tuple[np.ndarray, np.ndarray],
    lights: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return unambiguous mutual best matches of predicted and found particles.

    Parameters
    ----------
    predicted, found : ndarray, shape (predicted, 3) and (found, 3)
        Positions [voxel].
    variances : tuple of ndarray, shapes as of the positions
        Variances of both [voxel^2].
    lights : tuple of ndarray, shape (predicted,) and (found,)
        Light of both [counts].

    Returns
    -------
    ndarray, shape (link, 2)
        Numbers of both, in the order of the predicted particles.
    """
    if not (len(predicted) and len(found)):
        return np.zeros((0, 2), int)
    widest = np.sqrt(variances[0].max() + variances[1].max())
    near = cKDTree(predicted).sparse_distance_matrix(cKDTree(found), REACH * widest, output_type="coo_matrix")
    row, column = near.row, near.col
    variance = variances[0][row] + variances[1][column]
    distance = (np.square(found[column] - predicted[row]) / variance).sum(1)
    ratio = np.log(np.maximum(lights[1][column], 1e-9) / np.maximum(lights[0][row], 1e-9))
    cost = distance + np.square(ratio / LIGHT_SPREAD) + np.log(variance).sum(1)
    close = distance < REACH**2
    row, column, cost = row[close], column[close], cost[close]
    best_row, margin_row = _best(row, cost, len(predicted))
    best_column, margin_column = _best(column, cost, len(found))
    entry = best_row[best_row >= 0]
    mutual = entry[best_column[column[entry]] == entry]
    clear = mutual[(margin_row[row[mutual]] > AMBIGUOUS) & (margin_column[column[mutual]] > AMBIGUOUS)]
    return np.stack([row[clear], column[clear]], axis=1)


def _best(group: np.ndarray, cost: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the entry of least cost of each group, -1 for none, and how much more the next one costs."""
    order = np.lexsort((cost, group))
    ordered = group[order]
    first = np.searchsorted(ordered, np.arange(size))
    count = np.searchsorted(ordered, np.arange(size), side="right") - first
    best, margin = np.full(size, -1), np.full(size, np.inf)
    some, more = count > 0, count > 1
    best[some] = order[first[some]]
    margin[more] = cost[order[first[more] + 1]] - cost[order[first[more]]]
    return best, margin


def _corrected(
    first: FoundParticles, second: FoundParticles, links: np.ndarray, predicted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the predictor corrected by the links nearby, and the spread about it [voxel]."""
    places = first.positions_mm[links[:, 0]] / first.voxel_mm
    off = second.positions_mm[links[:, 1]] / first.voxel_mm - places - predicted[links[:, 0]]
    around, _ = nearby(places, off)
    spread = np.percentile(np.abs(off - around), SPREAD_PERCENTILE, axis=0) / 2
    correction, _ = nearby(places, off, first.positions_mm / first.voxel_mm)
    return predicted + correction, np.maximum(spread, LEAST_SPREAD_VOXEL)


def _validated(first: FoundParticles, second: FoundParticles, links: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return which links agree with those nearby."""
    places = first.positions_mm[links[:, 0]] / first.voxel_mm
    off = second.positions_mm[links[:, 1]] / first.voxel_mm - places - predicted[links[:, 0]]
    error = np.sqrt(np.square(first.errors_mm[links[:, 0]]) + np.square(second.errors_mm[links[:, 1]])) / first.voxel_mm
    return agreeing(places, off, error)


def agreeing(places: np.ndarray, off: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return which displacements agree with those nearby, normalised by their scatter and the standard error.

    Parameters
    ----------
    places, off, error : ndarray, shape (link, 3)
        Places, displacements beyond a predictor, and their standard errors [voxel].

    Returns
    -------
    ndarray, shape (link,), bool
        All true where there are too few to tell.
    """
    if len(places) <= NEIGHBOURS:
        return np.ones(len(places), bool)
    around, scatter = nearby(places, off)
    usual = NORMAL_MAD * np.median(np.abs(off - around), axis=0)  # a plane fits few links closely
    scatter = np.maximum(scatter, usual)
    limit = RESIDUAL_LIMIT * np.sqrt(np.square(scatter) + np.square(error))
    return (np.abs(off - around) < limit).all(1)


def nearby(places: np.ndarray, off: np.ndarray, at: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return what the nearest links tell about displacements: a plane through theirs, outliers counting less.

    Few particles are as close as the flow is uniform, so a median of theirs is off by its gradient.

    Parameters
    ----------
    places, off : ndarray, shape (link, 3)
        First particles of links, and their displacement beyond the predictor [voxel].
    at : ndarray, shape (place, 3), optional
        Places [voxel]. Default: those of the links, each without the link itself.

    Returns
    -------
    value, scatter : ndarray, shape (place, 3)
        Displacement beyond the predictor at each place, and scatter of the links about it [voxel].
    """
    own = int(at is None)
    at = places if at is None else at
    _, near = cKDTree(places).query(at, NEIGHBOURS + own)
    near = near[:, own:]
    apart = places[near] - at[:, None]
    terms = np.concatenate([np.ones((*near.shape, 1)), apart], axis=2)
    value = np.median(off[near], axis=1)
    slope = np.zeros((len(at), 3, 3))  # of each component along each axis
    held = np.diag([0.0, 1.0, 1.0, 1.0]) / GRADIENT**2
    for _ in range(FITS):
        left = off[near] - value[:, None] - np.einsum("pcj,pnj->pnc", slope, apart)
        scatter = np.maximum(NORMAL_MAD * np.median(np.abs(left), axis=1), SCATTER_FLOOR_VOXEL)
        weight = 1 / (np.square(scatter)[:, None] + np.square(left / OUTLIER_SIGMA))
        matrix = np.einsum("pnc,pni,pnj->pcij", weight, terms, terms) + held
        right = np.einsum("pnc,pni,pnc->pci", weight, terms, off[near])
        found = np.linalg.solve(matrix, right[..., None])[..., 0]
        value, slope = found[..., 0], found[..., 1:]
    return value, scatter
