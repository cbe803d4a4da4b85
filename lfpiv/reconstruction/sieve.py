"""Gaussian blurs of SMART's flat volumes: the sieve, and the smoothing between iterations.

With a sieve G the volume is E = G c, and SMART iterates the coefficients c with W G in place of W [1]_. Smoothing blurs
the volume itself after an iteration.

.. [1] D. L. Snyder, M. I. Miller, "The use of sieves to stabilize images produced with the EM algorithm for emission
   tomography", IEEE Trans. Nucl. Sci. 32 (1985) 3864-3872, doi:10.1109/TNS.1985.4334521.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lfpiv_kernels.filters.blur import GaussianBlur
from lfpiv_kernels.reconstruction.voxels import divide, multiply
from lfpiv_kernels.transfer import DeviceArray, Given, duplicate, to_device, to_host

TRUNCATE = 3.5
"""Reach of the sieve's Gaussian [standard deviation]."""
SMOOTHING_TRUNCATE = 3.0
"""Reach of the Gaussian that smooths between iterations [standard deviation]."""
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


@dataclass(frozen=True)
class Smoothing:
    """Gaussian blur of volumes, shape (voxel,), continued constantly outside the volume."""

    sigma_voxel: float
    """Standard deviation, above 0 [voxel]."""
    shape: tuple[int, int, int]
    """Voxel counts in stored order."""
    lit: DeviceArray
    """1 for voxels that some camera sees, shape (voxel,), float32. The others stay dark."""

    def __call__(self, volume: DeviceArray) -> DeviceArray:
        """Return the blurred volume; all on the device."""
        smoothed = self._blur(volume)
        return multiply(smoothed, self.lit, smoothed)

    @cached_property
    def _blur(self) -> GaussianBlur:
        return GaussianBlur(self.sigma_voxel, self.shape, truncate=SMOOTHING_TRUNCATE, border="nearest")


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
