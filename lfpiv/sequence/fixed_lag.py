"""Correct the volumes of a time series by those before and after each: a smoother of fixed lag.

`lfpiv.sequence.solver` follows particles forward in time, so that a volume holds what the frames before it
show. The frames after it show as much again. Here the volumes of a few frames on each side are moved along the
flow to the present one, as in simultaneous motion tracking enhancement [1]_. Particles are in all of them. A ghost
moves with the mean of the particles whose lines of sight cross in it, so it is elsewhere in most of them.

The guess is E ((G E_1 ... G E_n)^(1 / n) / G E)^S, with E the present volume, E_1 to E_n the volumes of all frames
moved to it, the present one included, and G a Gaussian of the size of a particle. So a volume keeps its own particles
in their places, and only their brightness changes: the mean of moved volumes itself would draw displacements to the
flow by which they were moved. Volumes are smoothed once and moved then. They are moved to bright voxels only, as dark
ones stay dark. A step by a part of the rays follows (`RowSubsets.correcting`).

.. [1] K. P. Lynch, F. Scarano, "An efficient and accurate approach to MTE-MART for time-resolved tomographic PIV", Exp.
   Fluids 56 (2015) 66, doi:10.1007/s00348-015-1934-6.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.sieve import coefficients
from lfpiv.sequence.motion_field import FAINTEST, LARGEST_GAIN, MotionField
from lfpiv_kernels import runtime

SHARPNESS = 1.3
"""Exponent S of the mean's ratio to the volume."""
DARK_SHARE = 0.005
"""Light added to all volumes before their ratio is taken, as a share of the smoothed volume's brightness,
sum E^2 / sum E."""
ROUGHEST = 0.18
"""Largest roughness of a displacement by which particles are moved [voxel]."""
FAINT = 0.01
"""Share of the light in the voxels that are left out of the guess before frames are compared, without a sieve."""


def agreed_guess(own: Reconstruction, others: Mapping[int, Reconstruction], flow: xr.Dataset) -> np.ndarray:
    """Return the guess of a frame from its volume and the volumes of the frames beside it.

    Parameters
    ----------
    own : Reconstruction
        The frame from its images and the frames before it.
    others : mapping of int to Reconstruction
        Number of frames from each to the present frame, negative for later ones -> the frame.
    flow : Dataset
        From `mean_flow`: displacement from one frame to the next [voxel of the vectors' volumes].

    Returns
    -------
    ndarray, shape (z, y, x), float32
        Coefficients of the sieve of `own`, with the light of its volume; zero where that is zero, and without a sieve
        in its faintest voxels.
    """
    volume, light = own.volume, float(own.volume.sum(dtype=np.float64))
    if not light > 0:
        return volume
    bright = volume if own.sieve_voxel > 0 else _bright(volume)
    blurred = own.blurred
    dark = np.float32(DARK_SHARE * np.square(blurred, dtype=np.float64).sum() / blurred.sum(dtype=np.float64))
    place = np.flatnonzero(bright)
    logarithm = np.log(blurred.ravel()[place] + dark)
    motion = MotionField(own.grid.axes_mm, flow)
    trust = motion.trust.ravel()[place]
    steps = list(others)
    ratios = [np.float32(0)] * len(steps)

    def compare(_: int, first: int, last: int) -> None:
        for number in range(first, last):
            other = others[steps[number]]
            total = float(other.volume.sum(dtype=np.float64))
            if total > 0:
                moved, inside = motion.carried(other.spline, -steps[number], place)
                there = np.log(np.maximum(moved, 0) * np.float32(light / total) + dark)
                ratios[number] = trust * np.where(inside > 0.5, inside, 0) * (there - logarithm)

    runtime.run_chunks(len(steps), compare, chunks=len(steps))
    change = np.exp(np.float32(SHARPNESS / (len(others) + 1)) * sum(ratios))
    gain = np.zeros_like(volume)
    gain.ravel()[place] = np.minimum(change, np.float32(LARGEST_GAIN))
    guess: np.ndarray = coefficients(bright, own.sieve_voxel) * gain
    np.maximum(guess, FAINTEST * guess.max(), out=guess, where=bright > 0)
    guess *= np.float32(light / guess.sum(dtype=np.float64))
    return guess


def _bright(volume: np.ndarray) -> np.ndarray:
    """Return a volume whose faintest voxels, with `FAINT` of its light, are 0."""
    ordered = np.sort(volume, axis=None)
    below = np.cumsum(ordered, dtype=np.float64)
    return np.where(volume >= ordered[np.searchsorted(below, FAINT * below[-1])], volume, np.float32(0))


def mean_flow(flows: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the mean of displacements from one frame to the next, over those that are valid.

    A vector of the mean is valid if one of them is. Where none is, it is the mean of the replaced ones.
    """
    valid = np.array([flow["valid"].values for flow in flows], bool)
    weights = np.where(valid.any(0), valid, True)
    mean = {}
    for name in (f"displacement_{axis}" for axis in "zyx"):
        values = np.array([flow[name].values for flow in flows])
        mean[name] = (AXES, np.where(weights, values, 0).sum(0) / weights.sum(0), flows[0][name].attrs)
    return flows[0].assign(mean | {"valid": (AXES, valid.any(0), flows[0]["valid"].attrs)})


def roughness(flow: xr.Dataset) -> float:
    """Return the root mean square second difference of displacements between neighbouring vectors [voxel].

    Windows do not resolve how the flow varies within them, and neither does a linear interpolation between vectors. A
    particle is off its predicted place by about twice this (docs/notebook/reconstruction.md). 0 for fewer than three
    vectors along each axis.
    """
    field = np.stack([flow[f"displacement_{axis}"].values for axis in "zyx"], -1)
    curved = [np.diff(field, 2, axis=axis) for axis in range(3) if field.shape[axis] > 2]
    squares = [float(np.nanmean(part**2)) for part in curved if np.isfinite(part).any()]
    return math.sqrt(sum(squares) / len(squares)) if squares else 0.0
