"""Leave dark voxels out of a reconstruction whose first guess shows where particles are, such as one of a series.

`without_dark` sets the faintest voxels of the guess to 0, and `leave_out` those that become dark later. SMART leaves
zeros as they are [1]_.

.. [1] C. Atkinson, J. Soria, "An efficient simultaneous reconstruction technique for tomographic particle image
   velocimetry", Exp. Fluids 47 (2009) 553-568, doi:10.1007/s00348-009-0728-0.
"""

from __future__ import annotations

import numpy as np

from lfpiv.reconstruction.momentum import Momentum
from lfpiv_kernels.reconstruction.sums import brightest_share
from lfpiv_kernels.reconstruction.voxels import multiply, part_bright
from lfpiv_kernels.transfer import DeviceArray, duplicate, to_device, to_host

DARK = 0.03
"""Share of the light in the voxels that are left out of a good first guess, and again before each epoch from it."""


def without_dark(guess: np.ndarray, share: float = DARK) -> np.ndarray:
    """Return a first guess whose faintest voxels, with a share of its light, are 0.

    SMART leaves zeros as they are and does not visit their weights. So this is for a guess that shows where particles
    are, such as one from other frames.

    Parameters
    ----------
    guess : ndarray, shape (z, y, x), float32
        Light of each voxel, >= 0.
    share : float
        Share of the light.

    Returns
    -------
    ndarray, shape (z, y, x), float32
        With the light of the guess.
    """
    light = to_device(np.ascontiguousarray(guess).ravel(), float)
    bright = to_host(multiply(light, part_bright(duplicate(light), brightest_share(light, share))))
    total = bright.sum(dtype=np.float64)
    if not total > 0:
        return guess
    bright *= np.float32(guess.sum(dtype=np.float64) / total)
    return bright.reshape(guess.shape)


def leave_out(coefficients: DeviceArray, momentum: Momentum, share: float) -> None:
    """Set the faintest coefficients, with a share of their light, to 0, and the momentum's memory of them."""
    bright = part_bright(duplicate(coefficients), brightest_share(coefficients, share))
    for values in (coefficients, momentum.previous):
        multiply(values, bright, values)
