"""Model of both frames: a volume midway in time, displaced by half the displacement to each frame, with loss of light.

With the light c of voxels midway in time, their displacement d and s = -1, +1 for the two frames, the volume of a frame
is ``E_f = G' T(s d / 2) c exp(s rho) g_f``. T moves each voxel's light and spreads it as a cubic B-spline
(`lfpiv_kernels.reconstruction.transport`). G' is a Gaussian; together with this spread it is the sieve. g_f is the
power of the frame's laser. rho is 0 unless particles are lost between the frames. Then it is half the logarithm of the
second frame's brightness over the first frame's, smoothed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from lfpiv.joint.spline_field import SPACING_VOXEL, SplineField
from lfpiv.reconstruction.frame import PreparedFrame
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.sieve import TRUNCATE, Sieve, coefficients
from lfpiv.weights.operator import Weights
from lfpiv_kernels.filters.blur import GaussianBlur
from lfpiv_kernels.reconstruction.transport import SPREAD, Transport
from lfpiv_kernels.transfer import to_device, to_host

LEAST_BLUR_VOXEL = 0.2
"""Standard deviation of G' below which it is left out, since it hardly blurs [voxel]."""
SMOOTH_VOXEL = 2.0
"""Standard deviation of the Gaussian that smooths rho [voxel]: wider than a particle, so that a change of brightness
cannot imitate a displacement."""
LEAST_LIGHT = 1e-3
"""Least light of a voxel at the start of the fit, as a share of the mean of the volume."""
DARK_SHARE = 0.1
"""Light added to both volumes before the logarithm of their ratio, as a share of their mean."""
LARGEST_LOSS = 3.0
"""Largest absolute rho."""
SIGNS = (-1, 1)
"""s: the first frame is before the middle in time, the second after it."""


class JointModel:
    """Volumes of two frames from the light midway in time and its displacement.

    Parameters
    ----------
    weights : Weights
        Weights of both frames.
    frames : sequence of two PreparedFrame
        Prepared images of both frames.
    """

    def __init__(self, weights: Weights, frames: Sequence[PreparedFrame]):
        self.weights, self.frames = weights, tuple(frames)
        self.field = SplineField(weights.grid, SPACING_VOXEL * weights.volume.voxel_mm / weights.grid.voxel_mm)
        self.sieve_voxel = frames[0].normalisation.sieve.sigma_voxel
        light = [
            sum(float(seen.image.sum(dtype=np.float64)) / seen.camera_gain for seen in frame.images.values())
            for frame in frames
        ]
        self.power = [np.float32(of_frame / math.sqrt(light[0] * light[1])) for of_frame in light]
        """Power of each frame's laser, relative to the geometric mean of both."""
        self.rho: np.ndarray | None = None
        """Half the logarithm of the frames' brightness, shape (z, y, x), float32; None for equally bright frames."""
        lit = [weights.stored.restore(to_host(frame.normalisation.lit)) > 0 for frame in frames]
        self.lit = (lit[0] | lit[1]).astype(np.float32)
        """1 for voxels that a camera sees and that hold fluid in some frame, else 0, shape (z, y, x)."""

    @property
    def rest_voxel(self) -> float:
        """Standard deviation of G', the part of the sieve that the spline leaves [voxel]."""
        sigma = math.sqrt(max(self.sieve_voxel**2 - SPREAD, 0.0))
        return 0.0 if sigma < LEAST_BLUR_VOXEL else sigma

    @cached_property
    def _rest(self) -> Sieve:
        return Sieve(self.rest_voxel, self.weights.grid.shape)

    @cached_property
    def _wide(self) -> GaussianBlur:
        return GaussianBlur(SMOOTH_VOXEL, self.weights.grid.shape, truncate=TRUNCATE, border="nearest")

    def sieved(self, volume: np.ndarray) -> np.ndarray:
        """Return G' applied to a volume (z, y, x). G' is its own adjoint."""
        return _blurred(self._rest, volume)

    def smoothed(self, volume: np.ndarray) -> np.ndarray:
        """Return a volume (z, y, x) blurred by `SMOOTH_VOXEL`."""
        return _blurred(self._wide, volume)

    def transports(self, nodes: np.ndarray) -> tuple[Transport, Transport]:
        """Return the transport from midway in time to each frame, for the displacement at the nodes of `field`."""
        moved = self.field.values(nodes)
        first, second = (Transport(moved, sign / 2) for sign in SIGNS)
        return first, second

    def light_of(self, frame: int, light: np.ndarray) -> np.ndarray:
        """Return the light midway in time with the brightness of a frame, 0 or 1, shape (z, y, x), float32."""
        bright: np.ndarray = light * self.power[frame]
        return bright if self.rho is None else bright * np.exp(SIGNS[frame] * self.rho)

    def volume(self, frame: int, light: np.ndarray, transport: Transport) -> np.ndarray:
        """Return the volume of a frame, 0 or 1, from the light midway in time, shape (z, y, x), float32."""
        return self.sieved(transport.push(self.light_of(frame, light)))

    def start(self, found: Sequence[Reconstruction], nodes: np.ndarray) -> np.ndarray:
        """Return the light midway in time from separate reconstructions of the frames, shape (z, y, x), float32.

        It is the geometric mean of both volumes, moved midway. If rho is not None, it is set, too.
        """
        own = [coefficients(reconstruction.volume, self.sieve_voxel) for reconstruction in found]
        parts = [
            transport.pull(volume, self.lit) for transport, volume in zip(self.transports(nodes), own, strict=True)
        ]
        least = LEAST_LIGHT * float(np.mean([volume.mean(dtype=np.float64) for volume in own]))
        if self.rho is not None:
            smooth = [self.smoothed(part / power) for part, power in zip(parts, self.power, strict=True)]
            dark = np.float32(DARK_SHARE * (smooth[0].mean() + smooth[1].mean()))
            ratio = np.log((smooth[1] + dark) / (smooth[0] + dark))
            self.rho = np.clip(ratio / 2, -LARGEST_LOSS, LARGEST_LOSS).astype(np.float32)
        first, second = (np.maximum(part, np.float32(least)) for part in parts)
        return np.sqrt(first * second) * self.lit


def _blurred(blur: GaussianBlur | Sieve, volume: np.ndarray) -> np.ndarray:
    """Return a blurred volume (z, y, x) on the host."""
    flat = to_device(np.ascontiguousarray(volume, np.float32).reshape(-1), float)
    return to_host(blur(flat)).reshape(volume.shape)
