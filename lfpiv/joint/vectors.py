"""Vectors of a joint fit: means of its displacement over the windows, where the frames by themselves agree.

A joint fit can believe itself: volumes that share their light move against each other as they were made. So the volumes
of each frame by itself are deformed onto each other by the displacement and correlated once more. Where they still move
by more than their uncertainty, the vector of their own correlation stays.

The curvature of the misfit is no measure of the error of the fit, since the light was fitted to the same images. The
uncertainty of the frames by themselves is independent of the fit, which more than halves it. Errors that both frames
share show between the cameras only: these ask for unlike light. In simulated pairs twice the standard deviation stated
holds 90 to 100 % of the errors of a component, and as little as 73 % in turbulence whose eddies are hardly larger than
the windows (docs/notebook/joint.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage
from threadpoolctl import threadpool_limits

from lfpiv.geometry.grid import AXES
from lfpiv.joint.pair import MOVED, UNSHARED, Estimate
from lfpiv.joint.spline_field import window_shares
from lfpiv.velocity.changed_vectors import with_displacement
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.velocity.multi_pass import UndeformedPair, peak_ratio
from lfpiv.velocity.peak_width import peak_reach, refine_search
from lfpiv.velocity.predictor import CONTROL_SPACING, Predictor
from lfpiv.velocity.seeding import unseeded_voxels
from lfpiv.velocity.settings import CorrelationSettings, triple
from lfpiv.velocity.volume_pair import either, missing_smoothing, preprocess, solid_voxels, voxel_axes
from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation.correlate import correlate_windows
from lfpiv_kernels.correlation.uncertainty import displacement_deviation

CONTRADICTION = 8.0
"""Separate frames contradict a fitted vector if they are displaced against each other by more than this many of the
median standard deviations. Ghosts displace them by up to 6 in sound pairs."""
ALONE_SHARE, LEFT_SHARE, LOSSY = 0.43, 0.39, 1.64
"""Standard deviation of a fitted vector: parts that the uncertainty of the frames by themselves and the displacement
that is left between them add in squares, and the factor of both where particles are lost between the frames."""
UNLIKE_SHARE = 4.7
"""Part of the uncertainty of the frames by themselves that is added in squares, times how much the cameras ask for
unlike light."""
EDGE_VOXEL = 1
"""Error of the edge of a region without particles, where it is found and not stated [voxel]."""
LEAST_PART = 0.25
"""Least wet part of a window by which its uncertainty is divided. Beside a wall, particles lie on one side only."""
FARTHEST_VOXEL = 0.5
"""Separate frames that are displaced by more contradict a fitted vector in any case [voxel]."""
FIELD_CORRELATION_VOXEL = 5.9
"""Length over which errors of the fitted displacement at single places correlate [voxel]."""


ATTRIBUTES = ("estimate", "rounds", "misfit_ratio", "lossy", "unlike")
"""Attributes of volumes that their vectors have, too."""


def is_joint(*volumes: xr.DataArray) -> bool:
    """Return whether volumes come from a joint fit."""
    has_field = all(name in volumes[0].coords for name in MOVED.values())
    return has_field and all(UNSHARED in volume.coords for volume in volumes)


def joint_vectors(volumes: Sequence[xr.DataArray], *, dt_s: float | None = None, **correlation: Any) -> xr.Dataset:
    """Return the vectors of a joint fit.

    Parameters
    ----------
    volumes : sequence of two DataArrays, shape (z, y, x)
        From `reconstruct_pair` with ``estimate="joint"``; of others the vectors of `correlate` are returned.
    dt_s : float, optional
        Time between the frames [s].
    **correlation
        Settings of `correlate`.

    Returns
    -------
    Dataset
        As `correlate` returns it. ``joint`` is true where the vector is the mean of the fitted displacement over the
        fluid with particles in the window. It is false where the frames by themselves contradict the fit and their
        correlation gives the vector.
        ``uncertainty_z``, ``_y``, ``_x`` of fitted vectors combine the uncertainty of the frames by themselves, lowered
        as the fit lowers the error, with the displacement that is left between these frames. Beside a wall they are
        divided by the part of the window that is fluid with particles, since the fit sees one side only. A wall that is
        found, not stated, adds what a shift by a voxel changes. ``valid`` is taken from
        the correlation of these frames, ``correlation`` and ``peak_ratio`` from the same frames deformed by the fitted
        displacement. Errors of fitted vectors that lie r_z, r_y, r_x voxels apart correlate as the product of
        ``exp(-(r / L)^2)`` over the axes. The attribute ``error_correlation_voxel`` has L along z, y and x.

    Raises
    ------
    ValueError
        As `correlate`.
    """
    about = {name: volumes[0].attrs[name] for name in ATTRIBUTES if name in volumes[0].attrs}
    if about.get("estimate") == Estimate.ALONE.value:
        del about["estimate"]
    if not is_joint(*volumes):
        vectors = correlate(*volumes, dt_s=dt_s, **correlation).assign_attrs(about)
        if "estimate" in about:  # a fit that was not started: its file has the variables of the other pairs
            vectors["joint"] = _flags(np.zeros(vectors["valid"].shape, bool), vectors)
        return vectors
    alone = [volume.copy(data=volume[UNSHARED].values) for volume in volumes]
    for volume in alone:
        volume.attrs.pop("unlike", None)  # of the fit, whose vectors count it
    vectors = correlate(*alone, dt_s=dt_s, **correlation)
    with threadpool_limits(1, "blas"):  # its sums depend on its number of threads
        return _merged(vectors, compare(vectors, volumes, alone), about).assign_attrs(about)


@dataclass(frozen=True)
class Evidence:
    """What the frames by themselves say about a fitted displacement, of each vector; shapes (z, y, x, 3) [voxel]."""

    fitted: np.ndarray
    """Mean of the fitted displacement over the part of the window that is fluid and holds particles; 0 without."""
    part: np.ndarray
    """This part of the window, shape (z, y, x, 1)."""
    edge: np.ndarray
    """Change of this mean if a region without particles, as found, is smaller by `EDGE_VOXEL`."""
    left: np.ndarray
    """Displacement that is left between the frames by themselves."""
    scatter: np.ndarray
    """Standard deviation of `left`, from the correlation statistics."""
    correlation: np.ndarray
    """Coefficient, shape (z, y, x)."""
    peak_ratio: np.ndarray

    def agrees(self, valid: np.ndarray) -> np.ndarray:
        """Return whether nothing is left beyond its typical uncertainty in valid vectors, shape (z, y, x)."""
        typical = np.nanmedian(self.scatter[valid], axis=0) if valid.any() else np.zeros(3)
        return (np.abs(self.left) <= np.minimum(CONTRADICTION * typical, FARTHEST_VOXEL)).all(-1)


def compare(vectors: xr.Dataset, volumes: Sequence[xr.DataArray], alone: Sequence[xr.DataArray]) -> Evidence:
    """Deform the frames by themselves onto each other by the fitted displacement, and correlate them once more."""
    settings = CorrelationSettings.from_vectors(vectors)
    window, edges = settings.windows[-1], np.asarray(vectors.attrs["voxel_mm"], float)
    moved = np.stack([volumes[0][MOVED[axis]].values for axis in AXES], -1)
    solid = solid_voxels(None, volumes[0], volumes[1], voxel_axes(volumes[0], volumes[1], None))
    empty = unseeded_voxels([one.values for one in alone], solid)
    shares = [
        window_shares(volumes[0][name].values, vectors[name].values, window[axis] * edges[axis])
        for axis, name in enumerate(AXES)
    ]
    fitted, part = _means(moved, either(solid, empty), shares)
    edge = np.zeros_like(fitted)
    if empty is not None:
        smaller = ndimage.binary_erosion(empty, iterations=EDGE_VOXEL, border_value=1)
        edge = np.abs(_means(moved, either(solid, smaller), shares)[0] - fitted)
    missing = missing_smoothing(settings.smoothing_voxel, *alone)
    first, second = (
        preprocess((one.values - np.median(one.values)).astype(np.float32), missing, settings.intensity_power)
        for one in alone
    )
    shape = triple(first.shape)
    (first, second), _ = UndeformedPair((first, second), solid).deformed(_predictor(moved), window)
    step = triple(
        round((at[1] - at[0]) / edge) if len(at) > 1 else n
        for at, edge, n in zip((vectors[name].values for name in AXES), edges, shape, strict=True)
    )
    windows = Windows.covering(shape, window, step)
    scatter = displacement_deviation(
        first, second, window=window, origin=windows.origin, step=step, count=windows.count
    )
    reach = peak_reach(first, second, window)
    left = correlate_windows(
        first, second, window=window, step=step, search=refine_search(reach), symmetric=True, reach=reach
    )
    return Evidence(
        fitted=fitted,
        part=part,
        edge=edge,
        left=left.displacement,
        scatter=scatter,
        correlation=left.correlation,
        peak_ratio=peak_ratio(left),
    )


def _means(moved: np.ndarray, dry: np.ndarray | None, shares: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of a displacement (z, y, x, 3) over the wet part of windows, 0 without, and this part.

    `shares` has the matrix of each axis from voxels to means over windows.
    """
    part = np.ones((*moved.shape[:3], 1)) if dry is None else (~dry[..., None]).astype(float)
    mean = moved * part
    for axis, share in enumerate(shares):
        mean, part = (np.moveaxis(np.tensordot(share, one, (1, axis)), 0, axis) for one in (mean, part))
    mean = np.divide(mean, part, out=np.zeros_like(mean), where=part > 0)
    return mean, np.ones_like(part) if dry is None else part


def _predictor(moved: np.ndarray) -> Predictor:
    """Return a displacement (z, y, x, 3) on the control points of a deformation."""
    places = [np.unique(np.r_[np.arange(0, n, CONTROL_SPACING), n - 1]) for n in moved.shape[:3]]
    return Predictor.between(places, moved[np.ix_(*places)].astype(float), triple(moved.shape[:3]))


def _merged(vectors: xr.Dataset, evidence: Evidence, about: Mapping[str, Any]) -> xr.Dataset:
    """Return the vectors with the fitted displacement where the frames agree with it; `about` has `ATTRIBUTES`."""
    valid = vectors["valid"].values
    own = np.stack([vectors[f"displacement_{axis}"].values for axis in AXES], -1)
    joint = evidence.agrees(valid) & np.isfinite(own).all(-1)
    displacement = np.where(joint[..., None], evidence.fitted, own)
    stated = np.stack([vectors[f"uncertainty_{axis}"].values for axis in AXES], -1)
    shared = ALONE_SHARE**2 + (UNLIKE_SHARE * float(about.get("unlike", 0.0))) ** 2  # of a file it is a NumPy scalar
    fitted = np.sqrt(shared * stated**2 + (LEFT_SHARE * evidence.left) ** 2) * (LOSSY if about.get("lossy") else 1.0)
    part, edge = (one.astype(fitted.dtype) for one in (evidence.part, evidence.edge))
    fitted = np.hypot(fitted / np.maximum(part, fitted.dtype.type(LEAST_PART)), edge)
    merged = with_displacement(vectors, displacement, np.where(joint[..., None], fitted, stated))
    found = {
        name: vectors[name].copy(data=np.where(joint, deformed, vectors[name].values).astype(np.float32))
        for name, deformed in (("correlation", evidence.correlation), ("peak_ratio", evidence.peak_ratio))
    }
    found["joint"] = _flags(joint, vectors)
    share = float(joint[valid].mean()) if valid.any() else 0.0
    return merged.assign(found).assign_attrs(
        joint_fraction=share,
        error_correlation_voxel=error_correlation_voxel(CorrelationSettings.from_vectors(vectors).windows[-1]),
    )


def error_correlation_voxel(window: Sequence[int]) -> list[float]:
    """Return the length L over which errors of means over windows correlate, along each axis [voxel].

    The mean over a window of edge w adds w^2 / 3 to the square of the length at single places.
    """
    return [round(math.sqrt(FIELD_CORRELATION_VOXEL**2 + edge**2 / 3), 1) for edge in window]


def _flags(joint: np.ndarray, vectors: xr.Dataset) -> xr.DataArray:
    """Return the variable that says which vectors come from the fit."""
    about = {"long_name": "mean of the fitted displacement; false: contradicted, and measured by correlation"}
    return xr.DataArray(joint, vectors["valid"].coords, vectors["valid"].dims, attrs=about)
