"""Warp: normal equations of overlapping particle images, a block per pair of particles.

Each particle is multiplied with itself and with the later ones that light the same pixels. So no two threads write the
same block, and sums do not depend on the number of threads. On the CPU a C++ loop spreads the particle's image over
scratch memory and goes through the images of its neighbours. On CUDA, where no thread has so much memory, a kernel
goes through the particles of each pixel. Twin: a product of dense matrices.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_device, to_host
from lfpiv_kernels.weights.gaussian import ImageLists

wp.set_module_options(native.options("particle_pairs.h", contract="fast"))

MOST_NEIGHBOURS = 128
"""Largest number of particles that overlap one, itself included. Further ones are left out of the matrix."""
PARTS = 16
"""Parts of a launch on the CPU: the work differs from particle to particle."""


@wp.struct
class Images:
    """Pixels of the particles."""

    first: wp.array(dtype=wp.int64)
    pixel: wp.array(dtype=int)
    values: wp.array(dtype=wp.vec4f)
    box: wp.array(dtype=wp.int32)
    """First i and j, last i and j of the lenses of each particle."""
    weight: wp.array(dtype=float)
    """Weight of each pixel."""
    residual: wp.array(dtype=float)
    """Residual of each pixel [counts]."""
    span: int
    """Pixels from the first to the last one of a particle, the most of all particles."""


@native.kernel("""
    lfpiv::multiply_images(
        images, particle, most, slot < 0 ? nullptr : scratch_out.data + (int64_t)slot * 4 * images.span,
        neighbour_out.data + (int64_t)particle * most, (float*)block_out.data + (int64_t)particle * most * 16,
        (float*)(right_out.data + particle)
    );
""")
def _multiply_images(
    # in
    images: Images,
    most: int,  # slots of a particle's table of neighbours
    slot: int,
    first_particle: int,
    # out
    scratch_out: wp.array(dtype=float),  # zeros, and zeros again afterwards
    neighbour_out: wp.array2d(dtype=int),
    block_out: wp.array2d(dtype=wp.mat44f),
    right_out: wp.array(dtype=wp.vec4f),
): ...


@wp.struct
class Lists:
    """Pixels of the particles, and particles of the pixels."""

    first: wp.array(dtype=wp.int64)
    pixel: wp.array(dtype=int)
    values: wp.array(dtype=wp.vec4f)
    pixel_first: wp.array(dtype=int)
    """First entry of each pixel in `entry`."""
    entry: wp.array(dtype=int)
    """Entries of the pixels, pixel by pixel."""
    particle: wp.array(dtype=int)
    """Particle of each entry."""
    weight: wp.array(dtype=float)
    """Weight of each pixel."""
    residual: wp.array(dtype=float)
    """Residual of each pixel [counts]."""


@wp.kernel
def _add_pairs(
    # in
    lists: Lists,
    most: int,  # slots of a particle's table of neighbours
    first_particle: int,
    # out
    neighbour_out: wp.array2d(dtype=int),
    block_out: wp.array2d(dtype=wp.mat44f),
    right_out: wp.array(dtype=wp.vec4f),
):
    particle = first_particle + wp.tid()
    used = wp.int32(0)
    right = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    for k in range(int(lists.first[particle]), int(lists.first[particle + 1])):
        pixel = lists.pixel[k]
        here = lists.values[k] * lists.weight[pixel]
        right += here * lists.residual[pixel]
        for n in range(lists.pixel_first[pixel], lists.pixel_first[pixel + 1]):
            entry = lists.entry[n]
            other = lists.particle[entry]
            if other >= particle:  # the matrix is symmetric
                slot = other % most
                while neighbour_out[particle, slot] >= 0 and neighbour_out[particle, slot] != other:
                    slot = (slot + 1) % most
                if neighbour_out[particle, slot] < 0 and used < most - 1:
                    neighbour_out[particle, slot] = other
                    used += 1
                if neighbour_out[particle, slot] == other:
                    block_out[particle, slot] += wp.outer(here, lists.values[entry])
    right_out[particle] = right


@dataclass(frozen=True, kw_only=True)
class PairBlocks:
    """Weighted products of the images of overlapping particles in one camera, derivatives by x, y, z and values."""

    row: np.ndarray
    """First particle of each pair, shape (pair,)."""
    column: np.ndarray
    """Second particle, shape (pair,)."""
    block: np.ndarray
    """Sum over the pixels of weight times values of the first times those of the second, shape (pair, 4, 4)."""
    right: np.ndarray
    """Sum of weight times residual times values, shape (particle, 4)."""


def pair_blocks(lists: ImageLists, weight: np.ndarray, residual: np.ndarray) -> PairBlocks:
    """Add up the products of the images of all particles that share pixels.

    Parameters
    ----------
    lists : ImageLists
        Images of the particles in one camera.
    weight, residual : ndarray, shape (pixel,), float32
        Weight and residual of each pixel.
    """
    count = len(lists.first) - 1
    neighbour = to_device(np.full((count, MOST_NEIGHBOURS), -1, np.int32))
    block = to_device(np.zeros((count, MOST_NEIGHBOURS, 4, 4), np.float32), wp.mat44f)
    right = to_device(np.zeros((count, 4), np.float32), wp.vec4f)
    call = _by_particle if runtime.device().form == "cpu" else _by_pixel
    launch(call(lists, weight, residual, [neighbour, block, right]), parts=PARTS)
    near = to_host(neighbour)
    row, slot = np.nonzero(near >= 0)
    column, upper = near[row, slot], to_host(block)[row, slot]
    off = row != column
    rows, columns = np.concatenate([row, column[off]]), np.concatenate([column, row[off]])
    blocks = np.concatenate([upper, upper[off].transpose(0, 2, 1)])
    order = np.lexsort((columns, rows))
    return PairBlocks(row=rows[order], column=columns[order], block=blocks[order], right=to_host(right))


def _by_particle(lists: ImageLists, weight: np.ndarray, residual: np.ndarray, outputs: list[wp.array]) -> Call:
    """Return the call for the CPU."""
    count = len(lists.first) - 1
    some = np.diff(lists.first) > 0
    ends = lists.first[:-1][some]
    low, high = (pick.reduceat(lists.pixel, ends) if some.any() else np.zeros(1) for pick in (np.minimum, np.maximum))
    images = Images()
    images.first, images.pixel = to_device(lists.first), to_device(lists.pixel)
    images.values, images.box = to_device(lists.values, wp.vec4f), to_device(lists.box.reshape(-1))
    images.weight, images.residual = (to_device(np.ascontiguousarray(a, np.float32)) for a in (weight, residual))
    images.span = int((high - low).max()) + 1
    scratch = to_device(np.zeros(runtime.CHUNKS * images.span * 4, np.float32))
    return Call(_multiply_images, count, [images, MOST_NEIGHBOURS], [scratch, *outputs], scratch=True)


def _by_pixel(lists: ImageLists, weight: np.ndarray, residual: np.ndarray, outputs: list[wp.array]) -> Call:
    """Return the call for CUDA."""
    count = len(lists.first) - 1
    entries = sparse.csr_array(
        (np.arange(len(lists.pixel), dtype=np.int32), lists.pixel, lists.first), shape=(count, len(weight))
    ).tocsc()
    device = Lists()
    device.first, device.pixel = to_device(lists.first), to_device(lists.pixel)
    device.values = to_device(np.ascontiguousarray(lists.values), wp.vec4f)
    device.pixel_first, device.entry = to_device(entries.indptr.astype(np.int32)), to_device(entries.data)
    device.particle = to_device(np.repeat(np.arange(count, dtype=np.int32), np.diff(lists.first)))
    device.weight, device.residual = (to_device(np.ascontiguousarray(a, np.float32)) for a in (weight, residual))
    return Call(_add_pairs, count, [device, MOST_NEIGHBOURS], outputs)
