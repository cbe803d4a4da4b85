"""Warp: area-integrated weights of voxels, written as 8-bit blocks of rays.

The weight of a ray is the fraction of a voxel's light, uniform in the voxel and over the pupil, that reaches its pixel
through its lens, Eq. 10, integrated in closed form instead of counted. Per voxel the mapping is a second-order
polynomial of the pupil point, (s, t)(P) with P = (u, v); K = d(s, t)/dP. A pixel at X under the lens centred at c looks
through the centre of its lens at P = -(X - c (1 + r)) / r, r = f_m/s_i (Eq. 9 solved for u). Then

- the ray's offset from the lens centre is g = (I - K)^-1 ((s, t)(P) - c): moving it by g moves the pupil point too;
- the pixel's cell on the pupil has the area h^2 |det (I - K)^-1|, h the pixel's width on the pupil;
- g is smeared by the voxel's three projected edges and by the pixel's cell: boxes, of which along each lattice axis the
  widest stays a box and the others become one box of the same variance. The axes are taken as independent, which they
  are where every edge lies along one of them: where a camera is upright to its array. The projection of a cube has no
  covariance at any angle, but that is not enough: cut into parts, as below, it is integrated at any angle;
- the weight is amplitude x probability that the smeared g lies in the lens's cell. How much of the pixel lies inside
  the pupil is the ray's own share, see ``microimages``.

Two forms of the same integral: "pixels" follows the slopes and the offset pixel by pixel; "profiles" takes them as
linear and without cross terms under a lens, so that a square cell's weights are the product of a profile along the
columns and one along the rows (rank 1), a third of the memory. Pixels may add up the footprints of parts of the voxel,
cut along x, y, z: what is not independent within a part, its fourth-order moments, falls with the fourth power of its
size. It takes time for every part, and no more memory. Blocks are at most BLOCK_WIDTH pixels wide, one vector load,
and end where the weights round to zero or the pupil ends. The computation is C++ on vectors of lenses and of pixels
(``raymodel``): Taichi's loops took four times as long. Twin: ``reference.footprint``; source: ``footprint_source``.
"""

import math
import sys

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.weights.ray_model import GEOMETRY_SIZE, Camera

wp.set_module_options(native.options("footprint.h", contract="fast"))

TALLEST = native.constant("footprint.h", "TALLEST")
"""Rows of a block at most."""
MOST_PARTS = native.constant("footprint.h", "MOST_PARTS")
"""Parts of a voxel at most."""
FORMS = ("profiles", "pixels")
"""Rank-1 blocks, or one value per ray."""
CHUNKS = 16
"""Parts of a launch on the CPU: voxels differ in their work."""
SCRATCH_BYTES = 1 << 26
"""Values that are computed before they are packed."""


def pack_camera(*, sensor_per_pupil, pixel_mm, sensor_shape, pupil_radius_mm, edge=0):
    """Pack a camera's constants for the kernels of this module and of ``trace``."""
    rows, columns = sensor_shape
    return Camera(sensor_per_pupil, pixel_mm, columns / 2, rows / 2, pupil_radius_mm, columns, rows, edge)


@wp.struct
class Inputs:
    """What the kernels read, the same for all voxels."""

    model: wp.array(dtype=float)
    """Ray models, (voxel, MODEL_SIZE), flat."""
    geometry: wp.array(dtype=float)
    """The camera's, (GEOMETRY_SIZE,)."""
    lenses: wp.vec4i
    """First i and j, lenses along i and j."""
    corners: wp.array(dtype=int)
    """First pixel (column, row) of each lens's block, (lens along j, lens along i, 2), flat."""
    cuts: wp.vec3i
    """Parts of a voxel along x, y, z."""
    profiles: bool


@wp.struct
class Outline:
    """Outline of a lens's cell, from ``lattice.cell_steps``."""

    extent: wp.array(dtype=float)
    """Half extents along a and b, (step, 2), flat."""
    steps: int
    square: bool


@wp.struct
class BlockArrays:
    """Blocks of voxels on the device, and where each voxel's begin."""

    first_block: wp.array(dtype=int)
    first_value: wp.array(dtype=int)
    ray: wp.array(dtype=int)
    height: wp.array(dtype=wp.uint8)
    width: wp.array(dtype=wp.uint8)
    value: wp.array(dtype=wp.uint8)


@wp.func_native("lfpiv::measure(lfpiv::weight_inputs(inputs), voxel, blocks_out.data, bytes_out.data);")
def _measure(inputs: Inputs, voxel: int, blocks_out: wp.array(dtype=int), bytes_out: wp.array(dtype=int)): ...


@wp.func_native("""
    lfpiv::fill(
        lfpiv::weight_inputs(inputs), {outline.extent.data, outline.steps, outline.square}, voxel,
        lfpiv::block_arrays(blocks_out), scale_out.data, counts_out.data, bytes_out.data
    );
""")
def _fill(
    inputs: Inputs,
    outline: Outline,
    voxel: int,
    blocks_out: BlockArrays,
    scale_out: wp.array(dtype=float),
    counts_out: wp.array(dtype=int),
    bytes_out: wp.array(dtype=int),
): ...


@wp.func_native("lfpiv::pack(lfpiv::block_arrays(blocks), lfpiv::block_arrays(packed_out), voxel);")
def _pack(blocks: BlockArrays, voxel: int, packed_out: BlockArrays): ...


@wp.kernel
def _measure_blocks(
    # in
    first_voxel: int,
    inputs: Inputs,
    # out
    blocks_out: wp.array(dtype=int),  # blocks and values that each voxel needs at most
    bytes_out: wp.array(dtype=int),
):
    _measure(inputs, first_voxel + wp.tid(), blocks_out, bytes_out)


@wp.kernel
def _fill_blocks(
    # in
    first_voxel: int,
    inputs: Inputs,
    outline: Outline,
    # out
    blocks_out: BlockArrays,
    scale_out: wp.array(dtype=float),
    counts_out: wp.array(dtype=int),  # blocks and values of each voxel
    bytes_out: wp.array(dtype=int),
):
    _fill(inputs, outline, first_voxel + wp.tid(), blocks_out, scale_out, counts_out, bytes_out)


@wp.kernel
def _pack_blocks(
    # in
    first_voxel: int,
    blocks: BlockArrays,
    # out
    packed_out: BlockArrays,  # without gaps
):
    _pack(blocks, first_voxel + wp.tid(), packed_out)


class Footprints:
    """Computes the blocks of one camera's voxels, some at a time, in scratch memory that it keeps.

    Parameters
    ----------
    camera, lattice
        From `pack_camera` and ``lattice.pack_lattice``.
    cell_mm : float
        Half extent of a lens's cell along s and t [mm].
    microimages : Microimages
        How the rays lie in memory.
    frame, outline
        The lens's cell, from ``lattice.cell_frame`` and ``lattice.cell_steps``.
    form : {"profiles", "pixels"}
        See `FORMS`.
    cuts : tuple of int
        Parts of a voxel along x, y, z whose footprints are added, at most `MOST_PARTS` in all; profiles have one.

    Raises
    ------
    ValueError
        If profiles are asked for a cell that is not a square, or for too many parts.
    """

    def __init__(self, camera, lattice, cell_mm, microimages, *, frame, outline, form, cuts=(1, 1, 1)):
        if form == "profiles" and len(outline) != 1:
            raise ValueError("form: profiles need a square microlens layout; use 'pixels' for a hexagonal one.")
        if not 1 <= math.prod(cuts) <= MOST_PARTS or (form == "profiles" and math.prod(cuts) > 1):
            raise ValueError(f"cuts: expected at most {MOST_PARTS} parts, one for profiles, got {tuple(cuts)}.")
        self._device = runtime.device()
        geometry = np.concatenate(
            [camera.to_numpy(), lattice.to_numpy(), [cell_mm], np.ravel(frame)], dtype=np.float32, casting="same_kind"
        )
        assert geometry.shape == (GEOMETRY_SIZE,)
        rows, columns = microimages.corner.shape[:2]
        self._inputs = Inputs()
        self._inputs.geometry = self._put(geometry)
        self._inputs.lenses = wp.vec4i(*microimages.first_lens, columns, rows)
        self._inputs.corners = self._put(microimages.corner.ravel())
        self._inputs.cuts = wp.vec3i(*cuts)
        self._inputs.profiles = form == "profiles"
        self._outline = Outline()
        self._outline.extent, self._outline.steps = self._put(np.ravel(outline)), len(outline)
        self._outline.square = len(outline) == 1
        self._scratch: dict[str, wp.array] = {}
        wp.load_module(sys.modules[__name__], device=self._device.warp)  # before threads use it

    def compute(self, model):
        """Compute the blocks of voxels, some voxels at a time, which are kept until the next are asked for.

        Parameters
        ----------
        model : ndarray, shape (voxel, MODEL_SIZE), float32
            Ray models, see ``raymodel.MODEL_SIZE``.

        Yields
        ------
        blocks, values : ndarray, shape (some voxels,), int32
            Blocks of the next voxels, and their bytes of values.
        """
        model = np.ascontiguousarray(model, np.float32)
        room = [wp.empty(len(model), dtype=int, device=self._device.warp) for _ in range(2)]
        self._launch(_measure_blocks, len(model), [self._inputs_of(model)], room)
        blocks, values = (most.numpy() for most in room)
        edges = np.flatnonzero(np.diff(np.cumsum(values, dtype=np.int64) // SCRATCH_BYTES)) + 1
        for first, last in zip([0, *edges], [*edges, len(model)], strict=True):
            yield self._fill(model[first:last], blocks[first:last], values[first:last])

    def _inputs_of(self, model):
        self._inputs.model = self._put(model.ravel())
        return self._inputs

    def _fill(self, model, most_blocks, most_values):
        room = [_starts(most) for most in (most_blocks, most_values)]
        self._blocks = self._arrays(
            *room,
            self._memory("ray", room[0][-1], int),
            self._memory("height", room[0][-1], wp.uint8),
            self._memory("width", room[0][-1], wp.uint8),
            self._memory("value", room[1][-1], wp.uint8),
        )
        self._scale = self._memory("scale", len(model), float)
        counts = [wp.empty(len(model), dtype=int, device=self._device.warp) for _ in range(2)]
        self._launch(
            _fill_blocks,
            len(model),
            [self._inputs_of(model), self._outline],
            [self._blocks, self._scale, *counts],
        )
        self._counts = [count.numpy() for count in counts]
        return self._counts

    def write(self, ray, height, width, value, scale):
        """Copy the blocks computed last, without gaps, into arrays as long as they are.

        Parameters
        ----------
        ray, height, width, value, scale : ndarray
            As in ``project.Blocks``, of these voxels alone.
        """
        arrays = [self._put(array) for array in (ray, height, width, value)]
        packed = self._arrays(*(_starts(count) for count in self._counts), *arrays)
        self._launch(_pack_blocks, len(scale), [self._blocks], [packed])
        scale[:] = self._scale.numpy()[: len(scale)]
        if self._device.kind == "cuda":
            for array, filled in zip((ray, height, width, value), arrays, strict=True):
                array[:] = filled.numpy()

    def _arrays(self, first_block, first_value, ray, height, width, value):
        blocks = BlockArrays()
        blocks.first_block, blocks.first_value = self._put(first_block), self._put(first_value)
        blocks.ray, blocks.height, blocks.width, blocks.value = ray, height, width, value
        return blocks

    def _put(self, array):
        return wp.array(array, device=self._device.warp, copy=False)

    def _memory(self, name, size, dtype):
        """Scratch memory of at least `size`, kept for the next voxels."""
        if name not in self._scratch or self._scratch[name].size < size:
            self._scratch[name] = wp.empty(int(size) + int(size) // 4, dtype=dtype, device=self._device.warp)
        return self._scratch[name]

    def _launch(self, kernel, size, inputs, outputs):
        def launch(_, first, last):
            wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=outputs, device=self._device.warp)

        runtime.run_chunks(size, launch, chunks=CHUNKS)


def _starts(count):
    """Where each voxel's part begins, and the end of the last, shape (voxel + 1,), int32."""
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)]).astype(np.int32)
