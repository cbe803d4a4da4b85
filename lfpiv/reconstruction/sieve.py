"""The sieve: a Gaussian blur of SMART's flat volumes.

With a sieve G the volume is E = G c, and SMART iterates the coefficients c with W G in place of W [1]_.

.. [1] D. L. Snyder, M. I. Miller, "The use of sieves to stabilize images produced with the EM algorithm for emission
   tomography", IEEE Trans. Nucl. Sci. 32 (1985) 3864-3872, doi:10.1109/TNS.1985.4334521.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lfpiv_kernels.filters.blur import GaussianBlur
from lfpiv_kernels.reconstruction.voxels import divide, multiply
from lfpiv_kernels.transfer import Given, duplicate, to_device, to_host

TRUNCATE = 3.5
"""Reach of the sieve's Gaussian [standard deviation]."""
UNBLURRED = 5
"""Steps that undo the sieve's blur of a volume."""
FAINTEST = 1e-6
"""Least light of a voxel that blurred coefficients are divided by, as a share of the brightest one."""


@dataclass(frozen=True)
class Sieve:
    """Gaussian blur of volumes, shape (voxel,), zero outside the volume. Its matrix is symmetric: its own adjoint."""

    sigma_voxel: float
    """Standard deviation [voxel]; 0 for the identity."""
    shape: tuple[int, int, int]
    """Voxel counts in stored order."""

    def __call__(self, volume: Given) -> Given:
        """Return the blurred volume, on the device if `volume` is. The identity returns `volume` itself."""
        if self.sigma_voxel == 0:
            return volume
        return self._blur(volume)

    @cached_property
    def _blur(self) -> GaussianBlur:
        return GaussianBlur(self.sigma_voxel, self.shape, truncate=TRUNCATE, border="constant")


def coefficients(volume: np.ndarray, sieve_voxel: float) -> np.ndarray:
    """Return coefficients c >= 0 of a sieve G with G c near a volume (z, y, x): c <- c G (E / G c), `UNBLURRED` times.

    These are the steps of Richardson and Lucy; they keep the light. SMART takes its first guess as coefficients.
    """
    if sieve_voxel == 0:
        return volume
    nz, ny, nx = volume.shape
    sieve, flat = Sieve(sieve_voxel, (nz, ny, nx)), to_device(np.ascontiguousarray(volume, np.float32).ravel(), float)
    found, least = duplicate(flat), float(np.float32(FAINTEST * volume.max()))
    for _ in range(UNBLURRED):
        ratio = divide(flat, sieve(found), least)
        multiply(found, sieve(ratio), found)
    return to_host(found).reshape(volume.shape)
