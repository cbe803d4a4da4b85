"""Warp: the steps of SMART (Eq. 5) on pixels and voxels, each in one sweep over arrays. Twin: ``reference.smart``."""

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, to_device
from lfpiv_kernels.reconstruction.pixel_rays import PixelRays
from lfpiv_kernels.reconstruction.projector import ALL, Projector

wp.set_module_options(native.options("update.h"))

FEWEST_RUNS, FEWEST_VOXELS = 256, 16384
"""Smallest part of a launch: a smaller one takes less time than the launch itself."""
LARGEST_LEAP = 50.0
"""Largest ratio of two iterates that momentum repeats, and the inverse of the smallest one."""
SMALLEST = float(np.finfo(np.float32).tiny)
"""Least light of an active voxel under momentum: smaller float32 numbers are slow, and a zero would stay zero."""


@wp.func_native("""
    lfpiv::compare(
        lfpiv::pixel_run(map, run), image.data, gain.data, held.data, floor, rays_out.data, squares_out.data,
        divergence_out.data
    );
""")
def _compare_run(
    run: int,
    map: PixelRays,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    held: wp.array(dtype=float),
    floor: float,
    rays_out: wp.array(dtype=float),
    squares_out: wp.array(dtype=wp.float64),
    divergence_out: wp.array(dtype=wp.float64),
): ...


@wp.kernel
def _compare(
    # in
    map: PixelRays,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    held: wp.array(dtype=float),
    floor: float,
    first_run: int,
    # out
    rays_out: wp.array(dtype=float),
    squares_out: wp.array(dtype=wp.float64),  # per run
    divergence_out: wp.array(dtype=wp.float64),
):
    _compare_run(first_run + wp.tid(), map, image, gain, held, floor, rays_out, squares_out, divergence_out)


@wp.kernel
def _update(
    # in
    exponent: wp.array(dtype=float),
    step: wp.array(dtype=float),
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    volume_out[voxel] = volume_out[voxel] * wp.exp(step[voxel] * exponent[voxel])


@wp.kernel
def _sharpen(
    # in
    logarithm: wp.array(dtype=float),
    blurred: wp.array(dtype=float),
    share: float,
    largest: float,
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    step = logarithm[voxel] + share * (logarithm[voxel] - blurred[voxel])
    volume_out[voxel] = volume_out[voxel] * wp.exp(wp.clamp(step, -largest, largest))


@wp.kernel
def _extrapolate(
    # in
    exponent: float,
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
    last_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    last = last_out[voxel]
    if last > 0.0:
        light = wp.max(volume_out[voxel], SMALLEST)
        volume_out[voxel] = light
        ratio = wp.clamp(light / last, 1.0 / LARGEST_LEAP, LARGEST_LEAP)
        last_out[voxel] = wp.max(light * wp.pow(ratio, exponent), SMALLEST)


class Comparison:
    """One camera's image beside the projections of volumes.

    It gives the logarithm of their ratio, Eq. 5, and two sums of their misfit. Only pixels that voxels light count:
    no volume can explain the light of other pixels.

    Parameters
    ----------
    projector : Projector
        The camera's weights.
    image : ndarray, shape (pixel,), float32
        Counts >= 0, zero where the gain is zero.
    gain : ndarray, shape (pixel,), float32
        What a pixel records per unit of light.
    floor : float
        Noise floor [counts].
    """

    def __init__(self, projector: Projector, image: np.ndarray, gain: np.ndarray, floor: float):
        self.projector = projector
        self._floor = float(floor)
        self._image, self._gain = (to_device(array[projector.map.pixel], float) for array in (image, gain))
        device = runtime.device().warp
        self._size = len(image)
        self._held = wp.zeros(len(projector.map.pixel), dtype=float, device=device)
        self._sums = [wp.zeros(projector.map.rays.runs, dtype=wp.float64, device=device) for _ in range(2)]

    def hold(self, volume: np.ndarray) -> None:
        """Add the projection of `volume` to that of each volume that is compared from now on. Overwrites the rays."""
        self.projector.scatter(volume)
        image = wp.zeros(self._size, dtype=float, device=self._held.device)
        self.projector.map.collect(self.projector.rays, image)
        self._held = to_device(self._held.numpy() + image.numpy()[self.projector.map.pixel], float)

    def release(self) -> None:
        """Forget the volumes that are held."""
        self._held.zero_()

    def compare(self, volume: np.ndarray, lenses: int = ALL) -> tuple[float, float]:
        """Project `volume`, shape (voxel,), and write gain * log((image + floor) / (projection + floor)) on the rays.

        With `lenses` only the pixels that see no other lenses count. The other rays become dark.

        Returns
        -------
        float
            Sum of (image - projection)^2, the projection with gain [counts^2].
        float
            Sum of P log(P / I) - P + I with P the projection and I the image, both plus floor [counts].
        """
        self.projector.scatter(volume, lenses)
        rays = self.projector.map.rays if lenses == ALL else self.projector.map.of_lenses[lenses]
        inputs = [rays, self._image, self._gain, self._held, self._floor]
        outputs = [self.projector.rays, *self._sums]
        launch(Call(_compare, rays.runs, inputs, outputs), parts=_parts(rays.runs, FEWEST_RUNS))
        squares, divergence = (float(sums.numpy()[: rays.runs].sum()) for sums in self._sums)
        return squares, divergence


def update(volume: np.ndarray, exponent: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Multiply `volume` by exp(step * exponent) in place; float32, shape (voxel,). Return `volume`."""
    _sweep(_update, [to_device(exponent, float), to_device(step, float)], [volume])
    return volume


def sharpened(
    volume: np.ndarray, logarithm: np.ndarray, blurred: np.ndarray, share: float, largest: float
) -> np.ndarray:
    """Multiply `volume` by exp(logarithm + share * (logarithm - blurred)) in place; float32, shape (voxel,).

    The absolute exponent is at most `largest`. Return `volume`.
    """
    inputs = [to_device(logarithm, float), to_device(blurred, float), float(share), float(largest)]
    _sweep(_sharpen, inputs, [volume])
    return volume


def extrapolate(volume: np.ndarray, last: np.ndarray, exponent: float) -> np.ndarray:
    """Overwrite `last` by volume * (volume / last)^exponent; both float32, shape (voxel,). Return `last`.

    Zeros of `last` stay zero. Elsewhere `last` and `volume` become at least `SMALLEST`.
    """
    _sweep(_extrapolate, [float(exponent)], [volume, last])
    return last


def _sweep(kernel: wp.Kernel, inputs: list[object], arrays: list[np.ndarray]) -> None:
    """Launch a kernel on all voxels; it changes `arrays`."""
    outputs = [to_device(array, float) for array in arrays]
    launch(Call(kernel, len(arrays[0]), inputs, outputs), parts=_parts(len(arrays[0]), FEWEST_VOXELS))
    if runtime.device().kind != "cpu":
        for array, output in zip(arrays, outputs, strict=True):
            array[:] = output.numpy()


def _parts(size: int, fewest: int) -> int:
    return min(runtime.CHUNKS, 1 + size // fewest)
