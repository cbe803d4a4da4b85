"""Warp: area-integrated weights of voxels, written as 8-bit blocks of rays.

The weight of a ray is the fraction of a voxel's light, uniform in the voxel and over the pupil, that reaches its pixel
through its lens: Eq. 10, integrated in closed form instead of counted. A voxel's mapping is a third-order polynomial
of the pupil point, (s, t)(P) with P = (u, v); K = d(s, t)/dP. A pixel at X under the lens centred at c looks through
the centre of its lens at P = -(X - c (1 + r)) / r, r = f_m/s_i (Eq. 9 solved for u). Then

- the ray's offset from the lens centre is g = (I - K)^-1 ((s, t)(P) - c), because the pupil point moves with the ray;
- the pixel's cell on the pupil has the area h^2 |det (I - K)^-1|, h the pixel's width on the pupil;
- g is smeared by the voxel's three projected edges and by the pixel's cell. Each of these is a box. Along each lattice
  axis the widest box stays, and the others become one box of the same variance;
- the weight is amplitude x probability that the smeared g lies in the lens's cell. How much of the pixel lies inside
  the pupil is the ray's own share, see ``microimages``.

The two axes are integrated as if they were independent. They are where every edge lies along one of them, that is where
the camera is upright to its array. Elsewhere the voxel can be cut into parts along x, y, z, whose footprints are added.
What is not independent within a part, its fourth-order moments, falls with the fourth power of the part's size. Parts
take time and no memory.

The integral has two forms. "pixels" follows the slopes and the offset pixel by pixel. "profiles" takes them as linear
and without cross terms under a lens. Then the weights of a square cell are the product of a profile along the columns
and one along the rows (rank 1), which takes a third of the memory. The loops are C++, see ``footprint.h``: they work on
vectors of lenses and of pixels; on a GPU see ``footprint_gpu``. Twin: ``reference.footprint``.
"""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_device, to_host
from lfpiv_kernels.weights import footprint_gpu
from lfpiv_kernels.weights.footprint_arrays import BlockArrays, Inputs, Outline
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, GEOMETRY_SIZE

wp.set_module_options(native.options("footprint.h", contract="fast"))

TALLEST: int = native.constant("footprint.h", "TALLEST")
"""Rows of a block at most."""
MOST_PARTS: int = native.constant("footprint.h", "MOST_PARTS")
"""Parts of a voxel at most."""
FORMS = ("profiles", "pixels")
"""Rank-1 blocks, or one value per ray."""
LAUNCH_PARTS = 16
"""Parts of a launch on the CPU: more than usual, because the work differs from voxel to voxel."""
SCRATCH_BYTES = 1 << 26
"""Values that are computed before they are packed [byte]."""


@native.kernel("""
    lfpiv::measure(
        lfpiv::weight_inputs(inputs), voxel, lenses_out.data, blocks_out.data, bytes_out.data
    );
""")
def _measure_blocks(
    # in
    inputs: Inputs,
    first_voxel: int,
    # out
    lenses_out: wp.array(dtype=int),  # lenses that each voxel reaches
    blocks_out: wp.array(dtype=int),  # blocks and values that it needs at most
    bytes_out: wp.array(dtype=int),
): ...


@native.kernel("""
    lfpiv::fill(
        lfpiv::weight_inputs(inputs), {outline.extent.data, outline.steps, outline.square}, voxel,
        lfpiv::block_arrays(blocks_out), scale_out.data, counts_out.data, bytes_out.data
    );
""")
def _fill_blocks(
    # in
    inputs: Inputs,
    outline: Outline,
    first_voxel: int,
    # out
    blocks_out: BlockArrays,
    scale_out: wp.array(dtype=float),
    counts_out: wp.array(dtype=int),  # blocks and values of each voxel
    bytes_out: wp.array(dtype=int),
): ...


@native.kernel("""
    lfpiv::pack(
        lfpiv::block_arrays(blocks), lfpiv::block_arrays(packed_out), voxel, profiles, edge, lenses,
        even_blocks_out.data, even_values_out.data
    );
""")
def _pack_blocks(
    # in
    blocks: BlockArrays,
    profiles: bool,
    edge: int,
    lenses: int,  # along i
    first_voxel: int,
    # out
    packed_out: BlockArrays,  # without gaps, those of even lenses first
    even_blocks_out: wp.array(dtype=int),  # blocks and values of each voxel under even lenses
    even_values_out: wp.array(dtype=int),
): ...


class Footprints:
    """Computes the blocks of one camera's voxels, some voxels at a time.

    Parameters
    ----------
    camera, lattice
        From ``ray_model.pack_optics`` and ``lattice.pack_lattice``.
    cell_mm : float
        Half extent of a lens's cell along s and t [mm].
    microimages : Microimages
        Where the rays lie in memory.
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

    def __init__(self, camera, lattice, cell_mm, microimages, *, frame, outline, form, cuts):
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
        self._inputs.geometry = to_device(geometry)
        self._inputs.lenses = wp.vec4i(*microimages.first_lens, columns, rows)
        self._inputs.corners = to_device(microimages.corner.ravel())
        self._inputs.cuts = wp.vec3i(*cuts)
        self._inputs.profiles = form == "profiles"
        self._tiles = -(-microimages.edge // BLOCK_WIDTH)  # blocks side by side under a lens
        self._order = [self._inputs.profiles, microimages.edge, columns]
        self._outline = Outline()
        self._outline.extent, self._outline.steps = to_device(np.ravel(outline)), len(outline)
        self._outline.square = len(outline) == 1
        self._scratch: dict[str, wp.array] = {}

    def compute(self, model):
        """Compute the blocks of voxels, some voxels at a time. `write` copies those computed last.

        Parameters
        ----------
        model : ndarray, shape (voxel, MODEL_SIZE), float32
            Ray models, see ``ray_model.MODEL_SIZE``.

        Yields
        ------
        blocks, values : ndarray, shape (some voxels,), int32
            Blocks of the next voxels, and their bytes of values.
        """
        model = np.ascontiguousarray(model, np.float32)
        self._inputs.model = to_device(model.ravel())
        most = [wp.empty(len(model), dtype=int, device=self._device.warp) for _ in range(3)]
        self._launch(_measure_blocks, len(model), [self._inputs], most)
        lenses, blocks, values = (to_host(count) for count in most)
        scratch = values.astype(np.int64)
        if self._device.form == "gpu":
            scratch += footprint_gpu.TILE_BYTES * int(lenses.max(initial=1)) * self._tiles
        edges = np.flatnonzero(np.diff(np.cumsum(scratch) // SCRATCH_BYTES)) + 1
        for first, last in zip([0, *edges], [*edges, len(model)], strict=True):
            part = slice(first, last)
            yield self._fill(model[part], int(lenses[part].max(initial=1)), blocks[part], values[part])

    def _fill(self, model, lenses, most_blocks, most_values):
        """Compute blocks of some voxels where there is room for as many as they can have."""
        first_block, first_value = _starts(most_blocks), _starts(most_values)
        self._blocks = _block_arrays(
            first_block,
            first_value,
            self._memory("ray", first_block[-1], int),
            *(self._memory(name, first_block[-1], wp.uint8) for name in ("height", "width")),
            self._memory("value", first_value[-1], wp.uint8),
        )
        self._scale = self._memory("scale", len(model), float)
        self._inputs.model = to_device(model.ravel())
        counts = [wp.empty(len(model), dtype=int, device=self._device.warp) for _ in range(2)]
        inputs, outputs = [self._inputs, self._outline], [self._blocks, self._scale, *counts]
        if self._device.form == "gpu":
            self._filled = footprint_gpu.fill(inputs, len(model), lenses, self._tiles, outputs)
        else:
            self._launch(_fill_blocks, len(model), inputs, outputs)
        self._counts = [to_host(count) for count in counts]
        return self._counts

    def write(self, ray, height, width, value, per_voxel):
        """Copy the blocks computed last, without gaps, into arrays of their length.

        Parameters
        ----------
        ray, height, width, value : ndarray
            As in ``projector.Blocks``, for these voxels only.
        per_voxel : tuple of ndarray
            `scale`, `even_blocks` and `even_values` of ``projector.Blocks``, for these voxels only.
        """
        scale, *even = per_voxel
        filled = (ray, height, width, value, *even)
        arrays = [to_device(array) for array in filled]
        packed = _block_arrays(*(_starts(count) for count in self._counts), *arrays[:4])
        outputs = [packed, *arrays[4:]]
        scale[:] = to_host(self._scale)[: len(scale)]
        if self._device.form == "cpu":
            self._launch(_pack_blocks, len(scale), [self._blocks, *self._order], outputs)
        else:
            footprint_gpu.pack(self._blocks, self._filled, len(scale), self._order, outputs)
            for array, on_device in zip(filled, arrays, strict=True):
                array[:] = to_host(on_device)

    def _memory(self, name, size, dtype):
        """Return scratch memory of at least `size`, which is used again for the next voxels."""
        if name not in self._scratch or self._scratch[name].size < size:
            self._scratch[name] = wp.empty(int(size) + int(size) // 4, dtype=dtype, device=self._device.warp)
        return self._scratch[name]

    def _launch(self, kernel, size, inputs, outputs):
        launch(Call(kernel, size, inputs, outputs), parts=LAUNCH_PARTS)


def _block_arrays(first_block, first_value, ray, height, width, value):
    """Return blocks on the device; each voxel's begin at `first_block` and `first_value`."""
    blocks = BlockArrays()
    blocks.first_block, blocks.first_value = to_device(first_block), to_device(first_value)
    blocks.ray, blocks.height, blocks.width, blocks.value = ray, height, width, value
    return blocks


def _starts(count):
    """Return where each voxel's part begins, and the end of the last, shape (voxel + 1,), int32."""
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)]).astype(np.int32)
