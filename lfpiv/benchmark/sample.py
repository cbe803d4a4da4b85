"""Compare the vectors of a result with the truth, pair by pair, and compute the benchmark's figures of all pairs.

The figures take a weight of each vector, so that a bootstrap over blocks of vectors can ask for them again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv import metrics
from lfpiv.benchmark import figures
from lfpiv.benchmark.measured import MeasuredField, lattice_of, represented_by
from lfpiv.benchmark.truth import SLACK_VOXEL, Truth

NAN = float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class PairErrors:
    """Vectors of one pair or instant beside the truth; displacements in voxels.

    It holds the vectors that are numbers, lie in the fluid of the volume, and have a known true displacement.
    """

    number: int
    positions_mm: np.ndarray
    """Positions (x, y, z) [mm], shape (vector, 3)."""
    measured: np.ndarray
    """Measured displacements, shape (vector, 3)."""
    true: np.ndarray
    """True displacements over the result's window, shape (vector, 3)."""
    true_point: np.ndarray
    """True displacements at the points, shape (vector, 3). From particles, they are means over the reference window."""
    sigma: np.ndarray
    """Stated standard deviations, shape (vector, 3); NaN where there is none."""
    kept: np.ndarray
    """Which vectors the result calls valid, shape (vector,)."""
    scored: np.ndarray
    """Which kept vectors lie in the measurable region, or within `SLACK_VOXEL` of it, shape (vector,)."""
    interior: np.ndarray
    """Which vectors lie at least a reference window inside the faces, shape (vector,)."""
    size: np.ndarray
    """Part of the measurable region that each vector stands for, shape (vector,); 0 for vectors that are not kept."""
    outside: int
    """Number of vectors beyond the volume or in walls."""
    source: str
    """`truth.FLOW` or `truth.PARTICLES`; empty for a pair without vectors."""

    @property
    def error(self) -> np.ndarray:
        """Measured minus true displacement, shape (vector, 3)."""
        return self.measured - self.true

    @property
    def completeness(self) -> float:
        """Part of the measurable region for which a kept vector stands."""
        return float(self.size.sum())


def pair_errors(measured: MeasuredField, truth: Truth) -> PairErrors:
    """Compare one pair or instant with the truth."""
    count, voxel = len(measured.positions_mm), truth.voxel_mm
    stands = represented_by(measured, truth)
    size = np.bincount(stands[stands >= 0], minlength=count) / max(len(stands), 1)
    use = measured.finite.copy()
    use[use] = truth.inside(measured.positions_mm[use])
    places = measured.positions_mm[use]
    true, source = truth.displacement(measured.number, places, measured.window_mm)
    point = truth.displacement(measured.number, places)[0] if measured.window_mm is not None else true
    known = np.isfinite(true).all(1)
    spread = np.full((count, 3), NAN) if measured.uncertainty_mm is None else measured.uncertainty_mm
    kept = measured.valid[use] & known
    return PairErrors(
        number=measured.number,
        positions_mm=places[known],
        measured=measured.displacement_mm[use][known] / voxel,
        true=true[known] / voxel,
        true_point=point[known] / voxel,
        sigma=spread[use][known] / voxel,
        kept=kept[known],
        scored=(kept & truth.inside(places, 0.5, SLACK_VOXEL))[known],
        interior=truth.inside(places, 1.0)[known],
        size=np.where(kept, size[use], 0.0)[known],
        outside=int(measured.finite.sum() - use.sum()),
        source=source,
    )


def missing_pair(number: int) -> PairErrors:
    """Return the errors of a pair for which the result has no vectors."""
    rows, flags = np.empty((0, 3)), np.empty(0, bool)
    return PairErrors(
        number=number, positions_mm=rows, measured=rows, true=rows, true_point=rows, sigma=rows, kept=flags,
        scored=flags, interior=flags, size=np.empty(0), outside=0, source="",
    )  # fmt: skip


class Sample:
    """Vectors of all pairs of a result, sorted by the length of their errors. All arrays have this order.

    Parameters
    ----------
    pairs : sequence of PairErrors
        All pairs that are scored, also pairs without vectors.
    outlier_voxel : float
        Length of the error above which a vector is an outlier [voxel].
    """

    def __init__(self, pairs: Sequence[PairErrors], truth: Truth, outlier_voxel: float = figures.OUTLIER_VOXEL):
        self.pairs, self.truth, self.outlier_voxel = tuple(pairs), truth, outlier_voxel
        length = np.concatenate([np.linalg.norm(one.error, axis=1) for one in pairs])
        order = np.argsort(length, kind="stable")  # a bootstrap takes many quantiles, which is fast in sorted values

        def joined(parts: Iterable[np.ndarray]) -> np.ndarray:
            return np.concatenate(list(parts))[order]

        self.length = length[order]
        self.measured = joined(one.measured for one in pairs)
        self.true = joined(one.true for one in pairs)
        self.sigma = joined(one.sigma for one in pairs)
        self.scored = joined(one.scored for one in pairs)
        self.interior = joined(one.interior for one in pairs)
        self.size = joined(one.size for one in pairs) / len(pairs)
        self.error = self.measured - self.true
        self.length_point = joined(np.linalg.norm(one.measured - one.true_point, axis=1) for one in pairs)
        places = joined(one.positions_mm for one in pairs)
        self.measurable = truth.inside(places, 0.5, SLACK_VOXEL)
        self.block = _blocks(places, joined(np.full(len(one.kept), one.number) for one in pairs), truth)

    @property
    def completeness(self) -> float:
        """Mean completeness of the pairs."""
        return float(np.mean([one.completeness for one in self.pairs]))

    def curve(self, weight: np.ndarray | float = 1.0) -> metrics.ErrorCurve:
        """Return the error against the part of the measurable region in which it is not exceeded."""
        return metrics.error_curve(self.length, weight * self.size, 1.0)

    def statistics(self, weight: np.ndarray) -> dict[str, float]:
        """Return the figures of `figures` that follow from the vectors.

        Parameters
        ----------
        weight : ndarray, shape (vector,)
            How often each vector counts, such as its number of draws in a bootstrap.
        """
        chosen = weight * self.scored
        median = metrics.weighted_quantile(self.length, 0.5, chosen)
        bound = figures.OUTLIER_NORMALISED * (median + figures.OUTLIER_FLOOR_VOXEL)
        mean = _mean(self.length, chosen)
        found = {
            "error": mean,
            "error_mm": mean * self.truth.voxel_mm,
            "error_percent": mean * self.truth.voxel_mm / self.truth.peak_mm if self.truth.peak_mm > 0 else NAN,
            "rms": math.sqrt(_mean(self.length**2, chosen)),
            "median": median,
            "error_point": _mean(self.length_point, chosen),
            "error_all": _mean(self.length, weight * self.measurable),
            "error_interior": _mean(self.length, chosen * self.interior),
            "error_edge": _mean(self.length, chosen * ~self.interior),
            "outliers": _mean(self.length > self.outlier_voxel, chosen),
            "outliers_normalised": _mean(self.length > bound, chosen) if np.isfinite(bound) else NAN,
        }
        curve = self.curve(weight)
        found |= {f"error_at_{round(100 * part)}": curve.bound_at(part) for part in figures.PARTS}
        for number, axis in enumerate("xyz"):
            response = metrics.linear_response(self.measured[:, number], self.true[:, number], chosen)
            found[f"rms_{axis}"] = math.sqrt(_mean(self.error[:, number] ** 2, chosen))
            found[f"slope_{axis}"], found[f"offset_{axis}"] = response.slope, response.offset
        calibration = metrics.uncertainty_calibration(self.error.ravel(), self.sigma.ravel(), np.repeat(chosen, 3))
        return found | {
            "within_one": calibration.within_one,
            "within_two": calibration.within_two,
            "sigma_width": calibration.width,
        }


def _mean(values: np.ndarray, weight: np.ndarray) -> float:
    total = weight.sum()
    return float(values @ weight / total) if total > 0 else NAN


def _blocks(places_mm: np.ndarray, pair: np.ndarray, truth: Truth) -> np.ndarray:
    """Return the number of each vector's block of the bootstrap, shape (vector,).

    A block holds the vectors of one pair in one box of the size of the reference window.
    """
    cell = np.floor((places_mm - truth.scene.volume.centre_mm) / np.asarray(truth.reference_window_mm)).astype(int)
    if not len(cell):
        return np.empty(0, int)
    return np.unique(np.column_stack([pair, cell]), axis=0, return_inverse=True)[1].ravel()


def divergence(pair: PairErrors, truth: Truth) -> float:
    """Return the rms divergence of the errors of a pair's kept vectors on their lattice.

    Of a flow free of divergence it is the divergence of the measured vectors. Differences are central.

    Returns
    -------
    float
        Root mean square of the divergence [voxel/voxel]; NaN without a lattice with three kept neighbours along each
        axis.
    """
    kept = pair.kept
    lattice = lattice_of(pair.positions_mm[kept], truth.voxel_mm) if kept.any() else None
    if lattice is None or min(lattice.vector.shape) < 3:
        return NAN
    field = np.where((lattice.vector >= 0)[..., None], pair.error[kept][lattice.vector], NAN)
    axes = [axis / truth.voxel_mm for axis in lattice.axes_mm]
    total = sum(np.gradient(field[..., axis], places, axis=axis) for axis, places in enumerate(axes))
    inner = np.asarray(total)[1:-1, 1:-1, 1:-1]
    known = inner[np.isfinite(inner)]
    return _rms(known) if len(known) else NAN


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def in_time(pairs: Sequence[PairErrors]) -> Mapping[str, float]:
    """Split the rms error of pairs with the same vector positions into a steady and an unsteady part.

    Vectors that are scored in all pairs count. Both parts are NaN for fewer than three pairs, pairs with other
    positions, and where no vector is scored in all pairs.
    """
    unknown = {"error_steady": NAN, "error_unsteady": NAN}
    first = pairs[0].positions_mm
    if len(pairs) < 3 or not len(first):
        return unknown
    places = [one.positions_mm for one in pairs]
    if not all(some.shape == first.shape and np.allclose(some, first, atol=1e-9) for some in places):
        return unknown
    error = np.stack([np.where(one.scored[:, None], one.error, NAN) for one in pairs])
    always = np.isfinite(error).all((0, 2))
    if not always.any():
        return unknown
    error = error[:, always]
    mean = error.mean(0)
    return {
        "error_steady": _rms(np.linalg.norm(mean, axis=-1)),
        "error_unsteady": _rms(np.linalg.norm(error - mean, axis=-1)),
    }
