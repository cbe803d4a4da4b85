"""Warp: the steps of SMART (Eq. 5) on pixels and voxels, each in one sweep over arrays. Twin: ``reference.smart``."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.reconstruction import pixel_rays_gpu
from lfpiv_kernels.reconstruction.pixel_rays import ALL, PixelRays
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.voxels import sweep_runs
from lfpiv_kernels.transfer import Values, empty, to_device

wp.set_module_options(native.options("update.h"))

FEWEST_RUNS = 2048
"""Smallest part of a launch: a smaller one takes less time than the launch itself."""
LARGEST_MOMENTUM: float = native.constant("steps.h", "LARGEST_MOMENTUM")
"""Largest absolute exponent of momentum; beyond it the exponent counts as this one."""
LARGEST_EXPONENT: float = native.constant("steps.h", "LARGEST_EXPONENT")
"""Largest absolute logarithm by which a sharpened step changes a voxel, whatever limit it is given."""
LARGEST_LEAP: float = native.constant("steps.h", "LARGEST_LEAP")
"""Largest ratio of two iterates that momentum repeats, and the inverse of the smallest one."""
SMALLEST: float = native.constant("steps.h", "SMALLEST")
"""Least light of an active voxel under momentum: smaller float32 numbers are slow, and a zero would stay zero."""


@native.kernel("""
    lfpiv::compare(
        lfpiv::pixel_run(map, run), image.data, gain.data, floor, rays.data, rays_out.data, squares_out.data,
        divergence_out.data
    );
""")
def _compare(
    # in
    map: PixelRays,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
    rays: wp.array(dtype=float),
    first_run: int,
    # out
    rays_out: wp.array(dtype=float),
    squares_out: wp.array(dtype=wp.float64),  # per run
    divergence_out: wp.array(dtype=wp.float64),
): ...


@native.kernel("""
    lfpiv::update(
        run, size, volume.data, exponent.data, step.data, length, last.data, momentum, stepped_out.data,
        ahead_out.data
    );
""")
def _update(
    # in
    volume: wp.array(dtype=float),
    exponent: wp.array(dtype=float),
    step: wp.array(dtype=float),
    length: float,
    last: wp.array(dtype=float),
    momentum: float,
    size: int,
    first_run: int,
    # out
    stepped_out: wp.array(dtype=float),
    ahead_out: wp.array(dtype=float),
): ...


@native.kernel("""
    lfpiv::sharpen(
        run, size, volume.data, logarithm.data, blurred.data, share, largest, last.data, momentum, stepped_out.data,
        ahead_out.data
    );
""")
def _sharpen(
    # in
    volume: wp.array(dtype=float),
    logarithm: wp.array(dtype=float),
    blurred: wp.array(dtype=float),
    share: float,
    largest: float,
    last: wp.array(dtype=float),
    momentum: float,
    size: int,
    first_run: int,
    # out
    stepped_out: wp.array(dtype=float),
    ahead_out: wp.array(dtype=float),
): ...


@dataclass(frozen=True)
class Extrapolation:
    """Momentum after a step: `ahead` becomes volume * (volume / last)^exponent.

    Zeros of `last` stay zero in `ahead`. Elsewhere `volume` and `ahead` become at least `SMALLEST`.
    """

    last: wp.array
    """Volume after the step before, shape (voxel,), float32."""
    exponent: float
    """At most `LARGEST_MOMENTUM`."""
    ahead: wp.array
    """Where to write; it may be the memory of `last` or of what the step starts from."""


NO_EXTRAPOLATION = Extrapolation(None, 0.0, None)
"""Of a step without momentum."""


class Comparison:
    """One camera's image beside the projections of volumes.

    It gives the logarithm of their ratio, Eq. 5, and two sums of their misfit. Only pixels that voxels light count:
    no volume can explain the light of other pixels.

    Parameters
    ----------
    projector : RayProjector
        The camera's weights.
    image : ndarray, shape (pixel,), float32
        Counts >= 0, zero where the gain is zero.
    gain : ndarray, shape (pixel,), float32
        What a pixel records per unit of light; or on the device, shape (lit pixel,), as of `lit_pixels`.
    floor : float
        Noise floor [counts].
    """

    def __init__(self, projector: RayProjector, image: np.ndarray, gain: Values, floor: float):
        self.projector = projector
        self.floor = float(floor)
        pixel = projector.map.pixel
        self._counts = image[pixel]
        self.image = to_device(self._counts, float)
        """Counts of the pixels that voxels light, on the device."""
        self.gain = gain if isinstance(gain, wp.array) else to_device(gain[pixel], float)
        """Their gains."""
        self.size = len(image)
        """Pixels of the sensor."""
        parts = pixel_rays_gpu.WARPS if runtime.device().form == "gpu" else projector.map.rays.runs
        self._sums = [empty(parts, wp.float64) for _ in range(2)]

    def counts_of(self, ray_set: int) -> np.ndarray:
        """Return the counts of the pixels that see one set of rays only, or of all for ``ALL``, shape (pixel,)."""
        rays = self.projector.map.rays_of(ray_set)
        return self._counts[rays.start : rays.end]

    def compare(self, volume: Values, totals: Totals, ray_set: int = ALL) -> None:
        """Project `volume`, shape (voxel,), and write gain * log((image + floor) / (projection + floor)) on the rays.

        Of a set of rays only the pixels that see no other set count. The other rays become dark. Add to the first two
        totals:

        - the sum of (image - projection)^2, the projection with gain [counts^2];
        - the sum of P log(P / I) - P + I with P the projection and I the image, both plus floor [counts].
        """
        projector = self.projector
        projector.scatter(volume, ray_set)
        projector.darken(ray_set)
        rays = projector.map.rays_of(ray_set)
        inputs = [rays, self.image, self.gain, self.floor, projector.rays]
        outputs = [projector.returned, *self._sums]
        if runtime.device().form == "gpu":
            size = pixel_rays_gpu.compare(inputs, outputs)
        else:
            size = rays.runs
            launch(Call(_compare, size, inputs, outputs), parts=parts_of(size, FEWEST_RUNS))
        for place, sums in enumerate(self._sums):
            totals.add(place, sums, size)


def update(
    volume: wp.array,
    exponent: wp.array,
    step: wp.array,
    *,
    length: float = 1.0,
    extrapolation: Extrapolation | None = None,
    stepped: wp.array,
) -> None:
    """Write volume * exp(step * exponent * length) to `stepped`; float32, shape (voxel,).

    Parameters
    ----------
    volume, exponent, step : array
        On the device.
    length : float
        Factor of all exponents.
    extrapolation : Extrapolation, optional
        Momentum that goes on from the step.
    stepped : array
        Where to write. It may be any of the other arrays.
    """
    momentum = extrapolation or NO_EXTRAPOLATION
    inputs = [volume, exponent, step, float(length), momentum.last, float(momentum.exponent)]
    sweep_runs(_update, inputs, [stepped, momentum.ahead])


def sharpen(
    volume: wp.array,
    logarithm: wp.array,
    blurred: wp.array,
    share: float,
    largest: float,
    *,
    extrapolation: Extrapolation | None = None,
    stepped: wp.array,
) -> None:
    """Write volume * exp(logarithm + share * (logarithm - blurred)) to `stepped`; float32, shape (voxel,).

    The absolute exponent is at most `largest`, and at most `LARGEST_EXPONENT`. The other arguments are as of `update`.
    """
    momentum = extrapolation or NO_EXTRAPOLATION
    inputs = [volume, logarithm, blurred, float(share), float(largest), momentum.last, float(momentum.exponent)]
    sweep_runs(_sharpen, inputs, [stepped, momentum.ahead])
