"""`correlate`: measure the displacement between two particle volumes by multi-pass 3D cross-correlation.

`volume_pair` prepares the volumes, `multi_pass` correlates and validates. This module adds a verdict and returns a
dataset in physical units.
"""

from __future__ import annotations

import enum
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import is_finite
from lfpiv.velocity.multi_pass import Pass, correlate_passes, peak_ratio
from lfpiv.velocity.prepared_pair import CheckedPair
from lfpiv.velocity.settings import DEFAULTS, CorrelationSettings, triple, windows_of
from lfpiv.velocity.systematic import systematic_share, with_systematic
from lfpiv.velocity.volume_pair import VoxelAxes, moves_beyond
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

LEAST_TOLD = 0.005
"""Least part of the volume without particles that is told; less rounds to nothing."""
GOOD_SHARE = 0.8
"""Smallest part of valid vectors of a good measurement."""
POOR_SHARE = 0.3
"""Smallest part of valid vectors of a poor measurement. With less, the measurement has failed."""

UNCERTAINTY_PARTS = "correlation statistics, and light that the volumes do not explain"
"""What the stated standard deviations include."""

Variable = tuple[tuple[str, ...], np.ndarray, dict[str, str]]
"""Dims, values and attributes of a variable."""


class Verdict(enum.Enum):
    """Quality of the measurement, from the part of the vectors in the last pass that are valid, of those that can be.

    Masked windows, and windows with too few particles or of which two cameras see too little, do not enter. The text is
    advice to the user.
    """

    GOOD = "most vectors are valid"
    POOR = (
        "many vectors were replaced: use larger windows, or look at the seeding, at the volumes, and whether particles "
        "move as far as is searched (correlation.max_displacement_voxel, by default a quarter of the first window)"
    )
    FAILED = "hardly any vector is valid: check that both volumes show the same particles and that displacements fit"
    UNCONFIRMED = (
        "both volumes show the same particles, but hardly any vector confirms its neighbours: displacements change too "
        "much from vector to vector, or ghosts hide them. Use smaller windows, whose vectors lie closer "
        "(correlation.windows), or a shorter dt_s; in a smooth flow more light or less seeding"
    )
    TOO_FAR = (
        "particles move farther than is searched, so that valid vectors may be chance: raise "
        "correlation.max_displacement_voxel, use a larger first window, or a shorter dt_s"
    )


def correlate(
    volume_a: xr.DataArray | np.ndarray,
    volume_b: xr.DataArray | np.ndarray,
    *,
    dt_s: float | None = None,
    windows: int | Sequence[int | Sequence[int]] | None = DEFAULTS.windows,
    overlap: float = DEFAULTS.overlap,
    voxel_mm: float | None = None,
    max_displacement_voxel: float | None = DEFAULTS.max_displacement_voxel,
    smoothing_voxel: float = DEFAULTS.smoothing_voxel,
    intensity_power: float = DEFAULTS.intensity_power,
    mask: xr.DataArray | np.ndarray | None = None,
) -> xr.Dataset:
    """Measure the displacement of the particles between two volumes.

    The first pass correlates windows over a wide range of lags. Each later pass deforms both volumes by the field of
    the pass before (`lfpiv_kernels.correlation.deform`) and correlates over a narrow range. A three-point Gaussian fit
    locates the peaks. The normalised median test validates them. Where a vector fails the test, the second peak is
    taken if it passes, otherwise the prediction from the neighbours. With more than one pass, swapping the volumes
    negates the result. A single pass takes windows of the first volume only: it is twice as fast and less accurate.

    It has more than 8 parameters because each setting of the table ``[correlation]`` is one keyword. Their defaults are
    the table's (`lfpiv.settings.processing.Correlation`).

    Parameters
    ----------
    volume_a, volume_b : DataArray or ndarray, shape (z, y, x)
        Intensities at the first and the second instant, finite, of any sign. Either two DataArrays with coordinates z,
        y, x [mm], or two arrays, of which nothing else need be known.
    dt_s : float, optional
        Time between the two volumes [s]. Without it there are no velocities.
    windows : int or sequence, optional
        Window of each pass [voxel]: (z, y, x) or one edge, within the volume; a number is the window of a single pass.
        The last window sets the vector grid. All others overlap by at least `multi_pass.COARSE_OVERLAP`. Repeat a
        window to iterate. Default: `lfpiv.settings.processing.DEFAULT_WINDOWS`, cut to the volume.
    overlap : float
        Part of a window that its neighbour shares, 0 <= overlap < 1.
    voxel_mm : float, optional
        Voxel edge [mm] of arrays, whose first voxel is centred at 0; not allowed for DataArrays. Without it the
        coordinates are indices of voxels, and there are no velocities.
    max_displacement_voxel : float, optional
        Largest displacement along each axis that the first pass searches [voxel]. Default: a quarter of its window.
    smoothing_voxel : float
        Standard deviation of a Gaussian that smooths both volumes first [voxel]; 0: none. The attribute ``sieve_voxel``
        of a volume counts as smoothing that it already has: only sqrt(smoothing_voxel^2 - sieve_voxel^2) is added.
    intensity_power : float
        Power of the smoothed intensities that is correlated, negative intensities as 0; 1: no change. Below 1, bright
        particles and their ghosts weigh less against the others.
    mask : DataArray or ndarray, shape (z, y, x), optional
        True, or a number of 0.5 to 1, where a voxel holds no fluid. What the volumes hold there has no effect. Default:
        the coordinate ``masked`` of the volumes, if they have one.

    Returns
    -------
    Dataset
        Dims z, y, x: window centres [mm], of arrays without `voxel_mm` [voxel]. All vectors are means over the window.
        Where part of a window is masked, its fluid is correlated, and the field of the pass before continues the vector
        to the window's centre.

        ``u``, ``v``, ``w`` [m/s], where `dt_s` and the size of the voxels are known, and ``displacement_x``, ``_y``,
        ``_z`` [voxel]: finite unless no vector is valid; NaN where masked.
        ``valid``: true where the vector was measured and passed validation, false where it was replaced. If the volumes
        have the coordinate ``views``, vectors are also replaced where two cameras see less than three quarters of the
        window. So are vectors of windows in which light brighter than moving particles stays in place
        (`lfpiv.velocity.standing_light`), and where less than half of the window's fluid holds particles
        (`lfpiv.velocity.seeding`).
        ``masked``: true where less than half of the window is fluid, so that nothing is measured; ``valid`` is false.
        ``fluid_share``: part of the window that is fluid. ``seeded_share``: part of this fluid that holds particles.
        ``peak_ratio``: highest correlation over the highest one beyond the reach of its peak: two lags, or more where
        particles are sampled finely (`lfpiv.velocity.peak_width`).
        ``correlation``: coefficient at the peak.
        ``uncertainty`` [voxel]: standard deviation of the displacement vector, the root of the summed variances of
        ``uncertainty_x``, ``_y``, ``_z``. NaN where the vector was replaced and after a single pass. A variance is
        that of the correlation statistics of [1]_, and for volumes with the attribute ``residual`` a systematic part
        (`lfpiv.velocity.systematic`). Errors of the calibration and of ``dt_s`` are not included.

        Attributes: ``verdict``, from the vectors that can be measured; ``masked_fraction``, the part of all vectors
        that are masked; ``valid_fraction``, ``seen_fraction`` and ``measurable_fraction``, the parts of the others that
        are valid, where two cameras see enough, and where these show particles too; ``unseeded_fraction``, the part of
        the volume that has fluid, is seen and holds no particles; ``settings`` and ``passes``, the figures of each
        pass, as JSON.

    Raises
    ------
    ValueError
        If the volumes differ in kind, shape or coordinates, are not finite, an argument is out of range, a window does
        not fit into the volume, or `dt_s` is given for arrays without `voxel_mm`.

    Examples
    --------
    >>> import numpy as np, lfpiv
    >>> volume = np.random.default_rng(0).random((24, 24, 24))
    >>> moved = lfpiv.correlate(volume, np.roll(volume, 1, axis=2), windows=(12, 12))
    >>> float(moved.displacement_x.median().round(1)), moved.x.values.round().tolist(), moved.x.units
    (1.0, [6.0, 12.0, 18.0], 'voxel')

    References
    ----------
    .. [1] B. Wieneke, "PIV uncertainty quantification from correlation statistics", Meas. Sci. Technol. 26 (2015)
       074002, doi:10.1088/0957-0233/26/7/074002.
    """
    checked = CheckedPair.from_volumes(volume_a, volume_b, voxel_mm=voxel_mm, mask=mask)
    axes, shape = checked.axes, triple(checked.values[0].shape)
    if dt_s is not None and not (is_finite(dt_s) and dt_s > 0):
        raise ValueError(f"dt_s: expected a positive time [s], got {dt_s!r}.")
    if dt_s is not None and axes.spacing_mm is None:
        raise ValueError("dt_s: velocities of arrays need the voxel edge too: state voxel_mm [mm], or leave dt_s out.")
    settings = CorrelationSettings(
        windows=windows_of(windows, shape),
        overlap=overlap,
        max_displacement_voxel=max_displacement_voxel,
        smoothing_voxel=smoothing_voxel,
        intensity_power=intensity_power,
    )
    first_search = settings.first_search(shape)
    pair = checked.prepared(settings)
    voxels = pair.voxels
    last, figures = correlate_passes(pair.first, pair.second, settings, voxels)
    last = pair.without_standing_light(last)
    measurable = last.coverage.measurable
    share = float(last.valid[measurable].mean()) if measurable.any() else 0.0
    verdict = verdict_of(share)
    if verdict is not Verdict.GOOD:
        if moves_beyond(pair.first, pair.second, first_search):
            verdict = Verdict.TOO_FAR
        elif verdict is Verdict.FAILED and measurable.any() and pair.in_common():
            verdict = Verdict.UNCONFIRMED
        warn(log, Warning(code=Code.FEW_VALID, figures={"share": share, "verdict": verdict.value}))
    if voxels.unseeded is not None and voxels.unseeded_fraction >= LEAST_TOLD:
        log.info("correlation: %.0f %% of the volume holds no particles", 100 * voxels.unseeded_fraction)
    attributes = {
        "title": f"displacement {'' if dt_s is None else 'and velocity '}of particles between two volumes",
        **({} if dt_s is None else {"dt_s": float(dt_s)}),
        **({} if axes.spacing_mm is None else {"voxel_mm": [float(spacing) for spacing in axes.spacing_mm]}),
        "valid_fraction": last.valid_fraction,
        "seen_fraction": last.fraction(last.coverage.seen),
        "masked_fraction": float(last.coverage.masked.mean()),
        "measurable_fraction": last.fraction(measurable),
        "unseeded_fraction": voxels.unseeded_fraction,
        "verdict": verdict.value,
        "settings": settings.to_json(),
        "passes": json.dumps([asdict(one) for one in figures]),
    }
    deviation = with_systematic(last.deviation(), last.field, last.valid, systematic_share(volume_a, volume_b))
    return xr.Dataset(_variables(last, deviation, axes, dt_s), _coordinates(last, axes), attributes)


def verdict_of(share: float) -> Verdict:
    """Return the verdict on vectors of which a share is valid, of those that can be."""
    return Verdict.GOOD if share >= GOOD_SHARE else Verdict.POOR if share >= POOR_SHARE else Verdict.FAILED


def _variables(result: Pass, deviation: np.ndarray, axes: VoxelAxes, dt_s: float | None) -> dict[str, Variable]:
    """Return velocity, displacement, uncertainty and quality of the last pass as variables over (z, y, x)."""
    coverage = result.coverage
    known = np.where(coverage.masked, np.nan, 1.0)
    displacements = {axis: result.field[..., k] * known for k, axis in enumerate(AXES)}
    fields: dict[str, tuple[np.ndarray, str, str]] = {}
    if dt_s is not None and axes.spacing_mm is not None:
        edges_mm = dict(zip(AXES, axes.spacing_mm, strict=True))
        for name, axis in zip("uvw", "xyz", strict=True):
            metres = edges_mm[axis] * 1e-3
            fields[name] = (displacements[axis] * metres / dt_s, "m/s", f"velocity along {axis}")
    for axis in "xyz":
        text = f"displacement along {axis}, mean over the window"
        fields[f"displacement_{axis}"] = (displacements[axis], "voxel", text)
    text = f"standard deviation of the displacement vector: {UNCERTAINTY_PARTS}"
    fields["uncertainty"] = (np.sqrt((deviation**2).sum(-1)), "voxel", text)
    for axis in "xyz":
        text = f"standard deviation of the displacement along {axis}: {UNCERTAINTY_PARTS}"
        fields[f"uncertainty_{axis}"] = (deviation[..., AXES.index(axis)], "voxel", text)
    text = f"highest correlation over the highest more than {result.given.reach} lags away"
    fields["peak_ratio"] = (peak_ratio(result.peaks) * known, "1", text)
    fields["correlation"] = (result.peaks.correlation * known, "1", "correlation coefficient at the peak")
    fields["fluid_share"] = (coverage.fluid_share, "1", "part of the window that is fluid")
    fields["seeded_share"] = (coverage.seeded_share, "1", "part of the window's fluid that holds particles")
    variables: dict[str, Variable] = {
        name: (AXES, values.astype(np.float32), {"units": units, "long_name": text})
        for name, (values, units, text) in fields.items()
    }
    text = "measured and passed validation; false: replaced or masked"
    variables["valid"] = (AXES, result.valid, {"long_name": text})
    variables["masked"] = (AXES, coverage.masked, {"long_name": "too little fluid in the window to be measured"})
    return variables


def _coordinates(result: Pass, axes: VoxelAxes) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
    """Return the window centres along each axis."""
    attributes = {"units": axes.unit, "long_name": "centre of the window"}
    return {
        axis: (axis, voxels[0] + spacing * centres, dict(attributes))
        for axis, voxels, spacing, centres in zip(AXES, axes.centres, axes.spacing, result.given.centres, strict=True)
    }
