"""Flow of a time series: the displacement between two successive volumes, by which the next one is predicted.

A flow that is not known is measured by all passes of `lfpiv.correlate`. Later the flow known from the frames before
deforms the volumes, and one pass in the last window is left. Where the flow has changed so much that this pass fails,
all passes are done again. The uncertainty is left out: nobody reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.sequence.motion_field import MotionField
from lfpiv.settings.processing import DEFAULT_WINDOWS
from lfpiv.velocity.cross_correlation import GOOD_SHARE, correlate
from lfpiv.velocity.multi_pass import correlate_known
from lfpiv.velocity.prepared_pair import CheckedPair
from lfpiv.velocity.settings import DEFAULTS, CorrelationSettings, cut_windows, triple, windows_of

WINDOWS = (*DEFAULT_WINDOWS[:-1], 8, 8)
"""Windows in which the flow is measured where none are stated [voxel], cut to the volume. They are smaller than those
of vectors: the motion within them is not resolved, and the scatter of few particles is averaged over the frames."""
OVERLAP = 0.6
"""Overlap of these windows."""


def measure_flow(
    first: xr.DataArray, second: xr.DataArray, correlation: Mapping[str, Any], known: xr.Dataset | None = None
) -> xr.Dataset:
    """Measure the displacement between two successive volumes of a series.

    Parameters
    ----------
    first, second : DataArray, shape (z, y, x)
        Volumes with coordinates in mm.
    correlation : mapping
        Settings of `lfpiv.correlate`. Windows that are None are `WINDOWS`, with `OVERLAP`.
    known : Dataset, optional
        Displacement between two frames before, from this function.

    Returns
    -------
    Dataset
        Of those that `lfpiv.correlate` returns, at least ``displacement_z``, ``_y``, ``_x`` [voxel] and ``valid``, with
        the attributes ``voxel_mm``, ``valid_fraction`` and ``measurable_fraction``.

    Raises
    ------
    ValueError
        If `lfpiv.correlate` refuses the volumes or the settings.
    """
    settings = {**DEFAULTS.model_dump(), **correlation}
    if settings["windows"] is None:
        settings |= {"windows": cut_windows(WINDOWS, first.shape), "overlap": OVERLAP}
    if known is not None:
        near = _near(first, second, settings, known)
        if near.attrs["valid_fraction"] >= GOOD_SHARE * near.attrs["measurable_fraction"]:
            return near
    return correlate(first, second, **settings)


def _near(first: xr.DataArray, second: xr.DataArray, correlation: Mapping[str, Any], known: xr.Dataset) -> xr.Dataset:
    """Measure the displacement in one pass, near the one that is known."""
    checked = CheckedPair.from_volumes(first, second)
    windows = windows_of(correlation["windows"], triple(first.shape))
    settings = CorrelationSettings(**{**correlation, "windows": windows})
    pair = checked.prepared(settings)
    midway = MotionField([first[axis].values for axis in AXES], known).midway
    last = pair.without_standing_light(correlate_known(pair.first, pair.second, settings, pair.voxels, midway))
    axes, coordinates = checked.axes, {}
    for axis, voxels, spacing, centres in zip(AXES, axes.centres, axes.spacing, last.given.centres, strict=True):
        coordinates[axis] = voxels[0] + spacing * centres
    moved = {f"displacement_{axis}": (AXES, last.field[..., k].astype("f4")) for k, axis in enumerate(AXES)}
    attributes = {
        "voxel_mm": list(axes.spacing),
        "valid_fraction": last.valid_fraction,
        "measurable_fraction": last.fraction(last.coverage.measurable),
    }
    return xr.Dataset({**moved, "valid": (AXES, last.valid)}, coordinates, attributes)
