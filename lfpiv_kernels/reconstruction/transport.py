"""Transport of light: each voxel's light moves by a displacement of its own and spreads as a cubic B-spline.

With light c, displacement d and the cubic B-spline b, `push` makes E(q) = sum_k c_k b(q - k - s d_k), with a share s of
the displacement. `pull` is its adjoint. `push_change` and `pull_slope` are the derivative by the displacement and its
adjoint. Light that leaves the volume is lost. The spline has a variance of `SPREAD` voxel^2 along each axis at any
displacement. Twin: ``reference.transport``, the matrix itself.

On the CPU slabs of planes are pushed into memory of their own and added in their order. So the result does not depend
on the number of threads. A GPU adds atomically.
"""

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.transfer import empty, to_device, to_host

wp.set_module_options(native.options("transport.h", contract="fast"))

SPREAD = 1 / 3
"""Variance of the cubic B-spline [voxel^2]."""
PLANES_OF_SLAB = 8
"""Planes of a slab."""
FEWEST_VOXELS = 4096
"""Smallest part of a launch."""


@native.kernel(
    "lfpiv::push_slab(slab, shape, planes, light.data, moved.data, share, direction.data, first.data, start.data, "
    "part_out.data);"
)
def _push(
    # in
    shape: wp.vec3i,
    planes: int,
    light: wp.array(dtype=float),
    moved: wp.array(dtype=float),
    share: float,
    direction: wp.array(dtype=float),  # none to push the light itself
    first: wp.array(dtype=int),  # first plane that each slab reaches
    start: wp.array(dtype=wp.int64),  # where its part begins
    first_slab: int,
    # out
    part_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::sum_slabs(plane, shape, slabs, first.data, start.data, part.data, volume_out.data);")
def _sum(
    # in
    shape: wp.vec3i,
    slabs: int,
    first: wp.array(dtype=int),
    start: wp.array(dtype=wp.int64),
    part: wp.array(dtype=float),
    first_plane: int,
    # out
    volume_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::push_voxel(voxel, shape, light.data, moved.data, share, direction.data, 0, volume_out.data);")
def _push_atomically(
    # in
    shape: wp.vec3i,
    light: wp.array(dtype=float),
    moved: wp.array(dtype=float),
    share: float,
    direction: wp.array(dtype=float),
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::pull_voxel(voxel, shape, light.data, moved.data, share, volume.data, pulled_out.data);")
def _pull(
    # in
    shape: wp.vec3i,
    light: wp.array(dtype=float),
    moved: wp.array(dtype=float),
    share: float,
    volume: wp.array(dtype=float),
    first_voxel: int,
    # out
    pulled_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::pull_slope_voxel(voxel, shape, light.data, moved.data, share, volume.data, slope_out.data);")
def _pull_slope(
    # in
    shape: wp.vec3i,
    light: wp.array(dtype=float),
    moved: wp.array(dtype=float),
    share: float,
    volume: wp.array(dtype=float),
    first_voxel: int,
    # out
    slope_out: wp.array(dtype=float),
): ...


class Transport:
    """Transport of light by a share of a displacement.

    Parameters
    ----------
    moved : ndarray, shape (3, z, y, x), float32
        Displacement of each voxel, order (z, y, x) [voxel].
    share : float
        Factor of the displacement.

    Raises
    ------
    ValueError
        If the displacement has another shape or is not finite.
    """

    def __init__(self, moved: np.ndarray, share: float):
        if moved.ndim != 4 or moved.shape[0] != 3 or not np.isfinite(moved).all():
            raise ValueError(f"moved: expected finite values of shape (3, z, y, x), got {moved.shape}.")
        nz, ny, nx = moved.shape[1:]
        self.shape = nz, ny, nx
        self.share = float(share)
        self._size, self._given = wp.vec3i(nz, ny, nx), _flat(moved)
        low, high = (self.share * limit((1, 2)) for limit in (moved[0].min, moved[0].max))
        low, high = np.minimum(low, high), np.maximum(low, high)
        slabs = -(-nz // PLANES_OF_SLAB)
        first, start = np.zeros(slabs, np.int32), np.zeros(slabs + 1, np.int64)
        for slab in range(slabs):
            own = np.arange(slab * PLANES_OF_SLAB, min((slab + 1) * PLANES_OF_SLAB, nz))
            begin = int(np.clip(np.floor((own + low[own]).min()) - 2, 0, nz))
            end = int(np.clip(np.floor((own + high[own]).max()) + 4, begin, nz))
            first[slab], start[slab + 1] = begin, start[slab] + (end - begin) * ny * nx
        self._slabs, self._parts = slabs, int(start[-1])
        self._layout = to_device(first, int), to_device(start, wp.int64)

    def push(self, light: np.ndarray) -> np.ndarray:
        """Return the moved light, shape (z, y, x), float32."""
        return self._pushed(light, None)

    def push_change(self, light: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the derivative of the moved light along a change of the displacement, shape (3, z, y, x)."""
        return self._pushed(light, _flat(direction))

    def pull(self, volume: np.ndarray, lit: np.ndarray) -> np.ndarray:
        """Return the adjoint of `push` applied to a volume (z, y, x), 0 where `lit` is 0."""
        pulled = empty(lit.size)
        inputs = [self._size, _flat(lit), self._given, self.share, _flat(volume)]
        launch(Call(_pull, lit.size, inputs, [pulled]), parts=parts_of(lit.size, FEWEST_VOXELS))
        return to_host(pulled).reshape(self.shape)

    def pull_slope(self, volume: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return the adjoint of `push_change` applied to a volume, shape (3, z, y, x), float32."""
        slope = to_device(np.zeros(3 * light.size, np.float32), float)
        inputs = [self._size, _flat(light), self._given, self.share, _flat(volume)]
        launch(Call(_pull_slope, light.size, inputs, [slope]), parts=parts_of(light.size, FEWEST_VOXELS))
        return to_host(slope).reshape(3, *self.shape)

    def _pushed(self, light: np.ndarray, direction: wp.array | None) -> np.ndarray:
        given = [_flat(light), self._given, self.share, direction]
        if runtime.device().form == "gpu":
            volume = to_device(np.zeros(light.size, np.float32), float)
            launch(Call(_push_atomically, light.size, [self._size, *given], [volume]))
        else:
            part, volume = empty(self._parts), empty(light.size)
            launch(Call(_push, self._slabs, [self._size, PLANES_OF_SLAB, *given, *self._layout], [part]))
            inputs = [self._size, self._slabs, *self._layout, part]
            launch(Call(_sum, self.shape[0], inputs, [volume]), parts=parts_of(light.size, FEWEST_VOXELS))
        return to_host(volume).reshape(self.shape)


def _flat(values: np.ndarray) -> wp.array:
    """Return values as flat float32 on the device."""
    return to_device(np.ascontiguousarray(values, np.float32).reshape(-1), float)
