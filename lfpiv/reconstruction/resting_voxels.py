"""Dark voxels rest: in most epochs only those voxels take part that hold nearly all of the light.

Most voxels of a particle volume are nearly dark after a few epochs [1]_. They change little, but a dark voxel has as
many weights as a bright one. So after the first `ALL` epochs, each epoch lays to rest the faintest voxels that hold
`LIGHT` of the light of those that still take part. Their light stays in the projections as it is, and their weights
are not visited. After `CYCLE` such epochs all voxels take part in one. Then the next cycle begins.

Where a camera stores the weights of nodes between voxels (`lfpiv.weights.depth_planes`), none rests: most nodes have
some bright voxel.

No voxel is lost: one that rests and should be brighter is found in the next epoch of all voxels, or in the last passes,
in which none rests. The light that the sieve spreads from active voxels into resting ones counts when these wake.

A first guess from other instants shows where particles are. `without_dark` leaves its faintest voxels out for good, and
`leave_out` those that become dark later.

.. [1] C. Atkinson, J. Soria, "An efficient simultaneous reconstruction technique for tomographic particle image
   velocimetry", Exp. Fluids 47 (2009) 553-568, doi:10.1007/s00348-009-0728-0. It leaves such voxels out for good.
"""

from __future__ import annotations

import numpy as np

from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.smart import ImageEquations
from lfpiv_kernels.reconstruction.sums import brightest_share
from lfpiv_kernels.reconstruction.voxels import multiply, part_bright
from lfpiv_kernels.transfer import DeviceArray, duplicate, to_device, to_host

ALL = 2
"""Epochs at the start in which no voxel rests."""
CYCLE = 4
"""Epochs from one of all voxels to the next in which voxels rest."""
FEWEST_VOXELS = 100_000
"""Voxels of a volume from which on some rest. In smaller ones the launches take the time that rest would save."""
LIGHT = 0.01
"""Share of the active voxels' light that rests from the next epoch on."""
DARK = 0.03
"""Share of the light in the voxels that are left out of a good first guess, and again before each epoch from it."""


def without_dark(guess: np.ndarray, share: float = DARK) -> np.ndarray:
    """Return a first guess whose faintest voxels, with a share of its light, are 0.

    SMART leaves zeros as they are and does not visit their weights. So this is for a guess that shows where particles
    are, such as one from other instants.

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


class RestingVoxels:
    """The voxels that rest, epoch by epoch.

    Parameters
    ----------
    equations : ImageEquations
        Locked. They hold the light of the voxels that rest.
    """

    def __init__(self, equations: ImageEquations):
        self._equations = equations
        self._active: DeviceArray | None = None
        self._possible = all(camera.projector.rests for camera in equations.cameras)

    def active_in(self, epoch: int, volume: DeviceArray) -> DeviceArray | None:
        """Choose the voxels that take part in the next epoch.

        Parameters
        ----------
        epoch : int
            Number of the epoch, from 0 on.
        volume : array, shape (voxel,), float32
            The volume before it, on the device.

        Returns
        -------
        array or None
            1 for voxels that take part, 0 for those that rest, shape (voxel,), float32. None for all.
        """
        few = volume.size < FEWEST_VOXELS
        if few or not self._possible or epoch < ALL or (epoch - ALL) % (CYCLE + 1) == CYCLE:
            self.wake()
            return None
        light = duplicate(volume) if self._active is None else multiply(volume, self._active)
        self._active = part_bright(light, brightest_share(light, LIGHT))
        self._equations.hold(light)
        return self._active

    def wake(self) -> None:
        """Let all voxels take part again."""
        if self._active is not None:
            self._equations.release()
        self._active = None
