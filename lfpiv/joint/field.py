"""`joint_field`: the fitted displacement of a joint fit itself, with vorticity and divergence.

Vectors are means over windows, so they damp what is smaller. The fit has no windows: its displacement is a cubic spline
whose nodes lie closer. Its derivatives are derivatives of the spline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

from lfpiv.geometry.grid import AXES
from lfpiv.joint.pair import MOVED
from lfpiv.joint.spline_field import SPACING_VOXEL
from lfpiv.joint.vectors import is_joint

STEP = int(SPACING_VOXEL) // 2
"""Distance of the places at which the field is stated [voxel]: half of the nodes' distance."""
WIDENED = 2.5
"""Standard deviation at a place over the standard deviation of the vector, which is a mean over its window."""

_COMPONENTS = {"x": "u", "y": "v", "z": "w"}
_CURL = {"x": ("zy", "yz"), "y": ("xz", "zx"), "z": ("yx", "xy")}  # d(first)/d(second), plus and minus


def joint_field(volumes: Sequence[xr.DataArray], vectors: xr.Dataset) -> xr.Dataset:
    """Return the displacement field of a joint fit, which is finer than its vectors.

    Parameters
    ----------
    volumes : sequence of two DataArrays, shape (z, y, x)
        From `reconstruct_pair` with ``estimate="joint"``.
    vectors : Dataset
        Their vectors, from `joint_vectors` with ``dt_s``.

    Returns
    -------
    Dataset
        Over z, y, x [mm], every `STEP` voxels: ``u``, ``v``, ``w`` [m/s], ``displacement_x``, ``_y``, ``_z`` [voxel],
        ``vorticity_x``, ``_y``, ``_z`` and ``divergence`` [1/s] from the derivatives of the fitted spline,
        ``uncertainty_x``, ``_y``, ``_z`` [voxel], the standard deviation, and ``valid``: the nearest vector is valid,
        comes from the fit, and lies no farther away than `STEP` along each axis beyond the outermost vectors.

    Raises
    ------
    ValueError
        If the volumes are not from a joint fit, or the vectors have no ``dt_s`` or are not the vectors of a joint fit.
    """
    if not is_joint(*volumes):
        raise ValueError("volumes: expected volumes of a joint fit, got others: use reconstruct_pair(estimate='joint')")
    if "joint" not in vectors or "dt_s" not in vectors.attrs:
        raise ValueError("vectors: expected the result of joint_vectors(volumes, dt_s=...), got others.")
    first, dt_s = volumes[0], float(vectors.attrs["dt_s"])
    edges = dict(zip(AXES, np.asarray(vectors.attrs["voxel_mm"], float), strict=True))
    places = {axis: np.arange((n - 1) % STEP // 2, n, STEP) for axis, n in zip(AXES, first.shape, strict=True)}
    moved = {axis: first[MOVED[axis]].values.astype(float) for axis in AXES}
    variables = {}
    for axis, name in _COMPONENTS.items():
        displacement = moved[axis][np.ix_(*places.values())]
        variables[f"displacement_{axis}"] = _variable(displacement, "voxel", f"displacement along {axis}")
        variables[name] = _variable(1e-3 * edges[axis] / dt_s * displacement, "m/s", f"velocity along {axis}")
    slopes = {
        f"{component}{along}": edges[component] / edges[along] / dt_s * _slope(moved[component], places, along)
        for component in AXES
        for along in AXES
    }
    for axis, (plus, minus) in _CURL.items():
        variables[f"vorticity_{axis}"] = _variable(slopes[plus] - slopes[minus], "1/s", f"vorticity along {axis}")
    total = slopes["xx"] + slopes["yy"] + slopes["zz"]
    variables["divergence"] = _variable(total, "1/s", "divergence of the velocity")
    axes = {axis: (axis, first[axis].values[places[axis]], {"units": "mm"}) for axis in AXES}
    field = xr.Dataset(variables, axes)
    near = vectors.sel({axis: field[axis] for axis in AXES}, method="nearest")
    for axis in _COMPONENTS:
        deviation = WIDENED * near[f"uncertainty_{axis}"].values
        field[f"uncertainty_{axis}"] = _variable(
            deviation, "voxel", f"standard deviation of the displacement along {axis}"
        )
    about = {"long_name": "the nearest vector is valid, near, and a mean of the fit"}
    valid = (near["valid"] & near["joint"]).values
    for number, axis in enumerate(AXES):
        beyond = np.maximum(vectors[axis].values[0] - field[axis], field[axis] - vectors[axis].values[-1])
        valid &= np.expand_dims(beyond.values <= STEP * edges[axis], [k for k in range(3) if k != number])
    field["valid"] = (AXES, valid, about)
    return field.assign_attrs(dt_s=dt_s, voxel_mm=[edges[axis] for axis in AXES])


def _slope(moved: np.ndarray, places: Mapping[str, np.ndarray], along: str) -> np.ndarray:
    """Return the derivative of a component (z, y, x) along an axis, at places [voxel per voxel]."""
    axis = AXES.index(along)
    chosen = [np.arange(n) if one == along else places[one] for one, n in zip(AXES, moved.shape, strict=True)]
    lines = moved[np.ix_(*chosen)]
    if moved.shape[axis] == 1:
        return np.zeros_like(lines)
    return CubicSpline(np.arange(moved.shape[axis]), lines, axis=axis)(places[along], 1)


def _variable(values: np.ndarray, units: str, about: str) -> tuple[tuple[str, ...], np.ndarray, dict[str, str]]:
    return AXES, values.astype(np.float32), {"units": units, "long_name": about}
