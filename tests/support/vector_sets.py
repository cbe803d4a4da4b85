"""Make vector datasets of known content, in memory and as the files of a run."""

import numpy as np
import xarray as xr

from lfpiv.results import netcdf

SHAPE = (4, 5, 6)  # (z, y, x)
DT_S = 1e-3
VOXEL_MM = 0.1


def axes(shape=SHAPE, spacing_mm=(0.6, 0.5, 0.4), first_mm=(-1.0, 2.0, 0.3)):
    """Return coordinates with different spacings along z, y, x, so that a swapped axis shows."""
    return {
        name: (name, first + step * np.arange(n), {"units": "mm"})
        for name, n, step, first in zip("zyx", shape, spacing_mm, first_mm, strict=True)
    }


def from_flow(flow, places=None):
    """Return u, v, w [m/s] of `flow(x, y, z)`, a function of metres that returns the three components."""
    places = axes() if places is None else places
    z, y, x = np.meshgrid(*(1e-3 * places[name][1] for name in "zyx"), indexing="ij")
    parts = [np.broadcast_to(part, x.shape).astype(float) for part in flow(x, y, z)]
    return xr.Dataset(
        {name: (("z", "y", "x"), part, {"units": "m/s"}) for name, part in zip("uvw", parts, strict=True)}, places
    )


def random_vectors(seed, shape=SHAPE):
    """Return random vectors in the form of `correlate`, with velocities that follow from the displacements."""
    rng = np.random.default_rng(seed)
    variables = {}
    for name, unit in netcdf.VECTOR_UNITS.items():
        variables[name] = (("z", "y", "x"), rng.normal(size=shape).astype(np.float32), {"units": unit})
    for name, axis in zip("uvw", "xyz", strict=True):
        velocity = variables[f"displacement_{axis}"][1] * np.float32(1e-3 * VOXEL_MM / DT_S)
        variables[name] = (("z", "y", "x"), velocity, {"units": "m/s"})
    variables["valid"] = (("z", "y", "x"), rng.random(shape) > 0.2)
    variables["uncertainty"][1][~variables["valid"][1]] = np.nan
    return xr.Dataset(
        variables, axes(shape), {"dt_s": DT_S, "voxel_mm": [VOXEL_MM] * 3, "settings": '{"overlap": 0.5}'}
    )


def random_volume(seed, **attributes):
    """Return a random volume of 3 x 4 x 5 voxels."""
    places = {name: (name, np.arange(n) * 0.1, {"units": "mm"}) for name, n in zip("zyx", (3, 4, 5), strict=True)}
    values = np.random.default_rng(seed).random((3, 4, 5), np.float32)
    return xr.DataArray(values, places, ("z", "y", "x"), attrs=attributes)


def write_run(folder, numbers, *, shape=SHAPE, **attributes):
    """Write random vectors of pairs, each with its number as seed; return them."""
    written = {number: random_vectors(number, shape) for number in numbers}
    for number, vectors in written.items():
        stamp = {"pair": number, "smart": {"iterations": 20}, "experiment": "test", **attributes}
        netcdf.write_vectors(vectors, folder / "vectors" / f"pair_{number:04d}.nc", attributes=stamp)
    return written
