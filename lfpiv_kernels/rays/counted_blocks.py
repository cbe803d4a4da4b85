"""Taichi: count the rays of every voxel of a grid per pixel (Eq. 10), straight into 8-bit blocks of rays.

Rays are Sobol's points in five dimensions [1]_, three of the voxel and two of the pupil, with a digital shift of each
voxel's own. Such points lie more evenly than random ones, and neighbours' errors have nothing in common. A ray is
traced by the voxel's ray model: third order in the pupil point, and the projected edges with their slopes.

One thread counts a voxel in a window of its own, with a counter per pixel of each lens that the voxel can reach. It
then writes the lit part of the window as blocks and clears it. So no two threads share a counter. Twin:
``reference.counted``.

.. [1] S. Joe, F. Y. Kuo, "Constructing Sobol sequences with better two-dimensional projections", SIAM Journal on
   Scientific Computing 30 (2008) 2635-2654, doi:10.1137/070709359.
"""

import functools

import numpy as np
from scipy.stats import qmc

from lfpiv_kernels import runtime
from lfpiv_kernels.libraries import ti
from lfpiv_kernels.rays.lattice import Lattice, lens_centre, nearest_lens
from lfpiv_kernels.weights.microimages import LAYERS
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, LEVELS, MODEL_SIZE, Camera

MOST_RAYS = 1 << 17
"""Rays per voxel at most."""
BATCH = 16
"""Rays that a CPU thread traces side by side, so that the compiler can use vector registers."""
DIMENSIONS = 5
TOP = int(LEVELS)
"""Level of a voxel's largest count."""
BITS = 30
"""Bits of a point's coordinate."""
GPU_LANES = 4096
"""Voxels that a GPU counts at once. Each needs a window."""
SCRATCH_BYTES = 1 << 28
"""Largest memory of all windows [byte]."""
FIRST_ROOM = 256, 4096
"""Blocks and values of a voxel for which there is room at first. Voxels that need more are counted again."""
ROUNDING = 1e-3
"""Margin of a ray's place for rounding [lens]."""
CHUNK_VOXELS = 1024
"""Voxels that a CPU counts before their blocks are packed."""


@ti.func
def _hashed(value):
    """Return `BITS` well-mixed bits of an integer (the finaliser of MurmurHash3)."""
    mixed = ti.cast(value, ti.u32)
    mixed = (mixed ^ (mixed >> 16)) * ti.u32(0x85EBCA6B)
    mixed = (mixed ^ (mixed >> 13)) * ti.u32(0xC2B2AE35)
    return ti.cast((mixed ^ (mixed >> 16)) >> (32 - BITS), ti.i32)


@ti.func
def _unit(fixed):
    """Return the middle of the cell of a fixed-point number as a float in (0, 1)."""
    return ti.cast(fixed, ti.f32) * (1.0 / (1 << BITS)) + 0.5 / (1 << 24)


@ti.func
def _on_disc(a, b):
    """Map a point of the square [-1, 1]^2 onto the unit disc, areas in proportion (Shirley and Chiu's map)."""
    wide = ti.abs(a) > ti.abs(b)
    radius, other = ti.select(wide, a, b), ti.select(wide, b, a)
    angle = 0.7853981633974483 * other / ti.select(ti.abs(radius) > 1e-9, radius, 1e-9)
    square = angle * angle  # at most (pi/4)^2: the series are exact to single precision
    cosine = 1.0 + square * (-0.5 + square * (1 / 24 + square * (-1 / 720 + square / 40320)))
    sine = angle * (1.0 + square * (-1 / 6 + square * (1 / 120 + square * (-1 / 5040 + square / 362880))))
    return ti.Vector([radius * ti.select(wide, cosine, sine), radius * ti.select(wide, sine, cosine)])


@ti.func
def _traced(model, p, q, r, u, v):
    """Return (s, t) [mm] of the ray from (p, q, r) in the voxel [edge] through (u, v) in the pupil [mm]."""
    st = ti.Vector([0.0, 0.0])
    for o in ti.static(range(2)):
        m, c, e, f = ti.static(6 * o, 30 + 4 * o, 12 + o, 18 + 2 * o)
        st[o] = (
            model[m]
            + u * (model[m + 1] + u * (model[m + 3] + u * model[c]))
            + v * (model[m + 2] + v * (model[m + 5] + v * model[c + 3]))
            + u * v * (model[m + 4] + u * model[c + 1] + v * model[c + 2])
            + p * (model[e] + model[f] * u + model[f + 1] * v)
            + q * (model[e + 2] + model[f + 4] * u + model[f + 5] * v)
            + r * (model[e + 4] + model[f + 8] * u + model[f + 9] * v)
        )
    return st


@ti.func
def _model_of(models: ti.template(), v):
    """Return the ray model of a voxel."""
    own = ti.Vector.zero(ti.f32, MODEL_SIZE)
    for k in range(MODEL_SIZE):
        own[k] = models[v, k]
    return own


@ti.func
def _shift_of(voxel):
    """Return the digital shift of a voxel's points."""
    shift = ti.Vector.zero(ti.i32, DIMENSIONS)
    for k in ti.static(range(DIMENSIONS)):
        shift[k] = _hashed(voxel * DIMENSIONS + k)
    return shift


@ti.func
def _shifted_point(points: ti.template(), n, shift: ti.template()):
    """Return a shifted point of the cube [-1/2, 1/2]^5."""
    at = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0])
    for k in ti.static(range(DIMENSIONS)):
        at[k] = _unit(points[k, n] ^ shift[k]) - 0.5
    return at


@ti.func
def _taken(lit: ti.template(), lane, mark, edge):
    """Clear the marks of a tile; return its lit columns, a bit each, its first lit row and its last one."""
    columns, low, high = 0, edge, -1
    for row in range(edge):
        bits = lit[lane, mark + row]
        if bits != 0:
            lit[lane, mark + row] = 0
            columns |= bits
            low, high = ti.min(low, row), row
    return ti.Vector([columns, low, high])


@ti.func
def _ends(bits):
    """Return the places of the lowest and the highest bit that is set."""
    left, right = 0, BLOCK_WIDTH - 1
    while (bits >> left) & 1 == 0:
        left += 1
    while (bits >> right) & 1 == 0:
        right -= 1
    return ti.Vector([left, right])


@ti.func
def _take_counts(window: ti.template(), lane, start, edge, size: ti.template(), most, out: ti.template(), at):
    """Clear the counts of a block of a size (width, height); write their levels to `out` at (voxel, place).

    A negative place writes none.
    """
    for row in range(size[1]):
        for column in range(size[0]):
            place = start + row * edge + column
            count = window[lane, place]
            window[lane, place] = 0
            if at[1] >= 0:
                level = (2 * TOP * count + most) // (2 * most)  # rounded, exactly
                out[at[0], at[1] + size[0] * row + column] = ti.cast(level, ti.u8)


@functools.cache
def sobol_points(rays):
    """Return the first points of Sobol's sequence in fixed point, shape (DIMENSIONS, rays), int32."""
    points = qmc.Sobol(DIMENSIONS, scramble=False, bits=BITS).random(rays)
    return np.ascontiguousarray((points * (1 << BITS)).T.astype(np.int32))


@functools.cache
def _kernel(hexagonal, block, batch, share):
    """Return the kernel for a layout of lenses.

    A scheduler takes `block` lanes at once, and a lane traces `batch` rays side by side. The outer loop has `share`
    turns per lane, of which the first does the work (`runtime.TAICHI_SHARE`).
    """

    @ti.kernel
    def _count_into_blocks(
        # in
        model: ti.types.ndarray(dtype=ti.f32, ndim=2),
        first_lens: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (voxel, 2): lowest i and j that it can reach
        box: ti.types.vector(2, ti.i32),  # lenses along i and j of a window
        corner: ti.types.ndarray(dtype=ti.i32, ndim=3),
        array: ti.types.vector(2, ti.i32),  # first i and j of the array of lenses
        point: ti.types.ndarray(dtype=ti.i32, ndim=2),
        first_voxel: ti.i32,
        lanes: ti.i32,
        camera: Camera,
        lattice: Lattice,
        # out
        window_out: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (lane, lens x row x column); zero before and after
        lit_out: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (lane, lens x tile x row): a bit per column; likewise
        ray_out: ti.types.ndarray(dtype=ti.i32, ndim=2),
        extent_out: ti.types.ndarray(dtype=ti.i32, ndim=2),  # width + 256 height
        value_out: ti.types.ndarray(dtype=ti.u8, ndim=2),
        needed_out: ti.types.ndarray(dtype=ti.i32, ndim=2),  # blocks, values, even blocks, even values, largest count
    ):
        ti.loop_config(block_dim=block)
        for task in range(lanes * share):
            if task % share != 0:
                continue
            lane = task // share
            edge = ti.cast(camera[7], ti.i32)
            tiles = (edge + BLOCK_WIDTH - 1) // BLOCK_WIDTH
            lenses, rows_of_lenses = corner.shape[1], corner.shape[0]
            columns_of_sensor, rows_of_sensor = ti.cast(camera[5], ti.i32), ti.cast(camera[6], ti.i32)
            to_pixel = 1.0 / camera[1]
            voxels = model.shape[0]
            for turn in range((voxels - lane + lanes - 1) // lanes):
                v = lane + turn * lanes
                own, shift = _model_of(model, v), _shift_of(first_voxel + v)
                most = 0
                lens_i, lens_j = ti.Vector.zero(ti.i32, batch), ti.Vector.zero(ti.i32, batch)
                at_x, at_y = ti.Vector.zero(ti.i32, batch), ti.Vector.zero(ti.i32, batch)
                for b in range(point.shape[1] // batch):
                    for c in range(batch):
                        n = b * batch + c
                        at = _shifted_point(point, n, shift)
                        pupil = _on_disc(2.0 * at[3], 2.0 * at[4])
                        st = _traced(own, at[0], at[1], at[2], pupil[0] * camera[4], pupil[1] * camera[4])
                        lens = nearest_lens(lattice, st[0], st[1], hexagonal)
                        centre = lens_centre(lattice, lens[0], lens[1])
                        x = (centre[0] + camera[0] * (st[0] - pupil[0] * camera[4])) * to_pixel + camera[2]
                        y = (centre[1] + camera[0] * (st[1] - pupil[1] * camera[4])) * to_pixel + camera[3]
                        lens_i[c], lens_j[c] = ti.cast(lens[0], ti.i32), ti.cast(lens[1], ti.i32)
                        at_x[c], at_y[c] = ti.cast(ti.floor(x), ti.i32), ti.cast(ti.floor(y), ti.i32)
                    for c in range(batch):
                        i, j = lens_i[c] - array[0], lens_j[c] - array[1]
                        own_i, own_j = lens_i[c] - first_lens[v, 0], lens_j[c] - first_lens[v, 1]
                        column, row = -1, -1
                        if 0 <= own_i < box[0] and 0 <= own_j < box[1] and 0 <= i < lenses and 0 <= j < rows_of_lenses:
                            column, row = at_x[c] - corner[j, i, 0], at_y[c] - corner[j, i, 1]
                        if (
                            0 <= at_x[c] < columns_of_sensor
                            and 0 <= at_y[c] < rows_of_sensor
                            and 0 <= column < edge
                            and 0 <= row < edge
                        ):
                            slot = own_j * box[0] + own_i
                            place = (slot * edge + row) * edge + column
                            count = window_out[lane, place] + 1
                            window_out[lane, place] = count
                            most = ti.max(most, count)
                            tile = column // BLOCK_WIDTH
                            mark = (slot * tiles + tile) * edge + row
                            lit_out[lane, mark] = lit_out[lane, mark] | (1 << (column - BLOCK_WIDTH * tile))
                # the lit part of each tile of columns under a lens is a block; blocks of even lenses come first
                blocks, values, even_blocks, even_values = 0, 0, 0, 0
                for number in range(2 * box[0] * box[1]):
                    parity, slot = number // (box[0] * box[1]), number % (box[0] * box[1])
                    i, j = first_lens[v, 0] + slot % box[0] - array[0], first_lens[v, 1] + slot // box[0] - array[1]
                    if (i + j) & 1 == parity:
                        for tile in range(tiles):
                            lit = _taken(lit_out, lane, (slot * tiles + tile) * edge, edge)
                            if lit[0] != 0:
                                ends, low = _ends(lit[0]), lit[1]
                                size = ti.Vector([ends[1] - ends[0] + 1, lit[2] - low + 1])
                                left, area = tile * BLOCK_WIDTH + ends[0], size[0] * size[1]
                                at = ti.Vector([v, -1])
                                if blocks < ray_out.shape[1] and values + area <= value_out.shape[1]:
                                    first = (j * LAYERS + 1) * lenses + i
                                    ray_out[v, blocks] = (first * edge + low) * edge + left
                                    extent_out[v, blocks] = size[0] + 256 * size[1]
                                    at[1] = values
                                start = (slot * edge + low) * edge + left
                                _take_counts(window_out, lane, start, edge, size, most, value_out, at)
                                blocks, values = blocks + 1, values + area
                                even_blocks, even_values = even_blocks + 1 - parity, even_values + (1 - parity) * area
                needed_out[v, 0], needed_out[v, 1] = blocks, values
                needed_out[v, 2], needed_out[v, 3] = even_blocks, even_values
                needed_out[v, 4] = most

    return _count_into_blocks


class CountedBlocks:
    """Counts the rays of one camera's voxels into blocks, some voxels at a time.

    Parameters
    ----------
    camera, lattice
        From ``ray_model.pack_optics``, with the edge of `microimages`, and ``lattice.pack_lattice``.
    microimages : Microimages
        Where the rays of pixels lie in memory. All pixels that light can reach must have a share of 1.
    hexagonal : bool
        Layout of the array.
    rays : int
        Rays per voxel: a power of 2 from `BATCH` to `MOST_RAYS`.
    """

    def __init__(self, camera, lattice, microimages, *, hexagonal, rays):
        if not BATCH <= rays <= MOST_RAYS or rays & (rays - 1):
            raise ValueError(f"rays: expected a power of 2 from {BATCH} to {MOST_RAYS}, got {rays}.")
        self._camera, self._lattice, self._microimages, self._rays = camera, lattice, microimages, rays
        self._radius, self._hexagonal = float(camera[4]), bool(hexagonal)
        self._inverse = np.array([lattice[k] for k in range(6, 10)]).reshape(2, 2)
        self._origin = np.array([lattice[0], lattice[1]])
        rows, columns = microimages.corner.shape[:2]
        self._first = np.array(microimages.first_lens)
        self._last = self._first + (columns, rows) - 1
        self._room = list(FIRST_ROOM)
        self._scratch = {}

    def reach(self, model):
        """Return the lowest and the highest lens (i, j) that the rays of each voxel can meet, shapes (voxel, 2)."""
        radius = self._radius
        parts = model[:, :12].reshape(-1, 2, 6), model[:, 30:].reshape(-1, 2, 4)
        terms = np.concatenate(parts, axis=2).astype(float)
        slopes = np.abs(model[:, 18:30].reshape(-1, 3, 2, 2)).sum(-1)
        edges = np.abs(model[:, 12:18].reshape(-1, 3, 2)) + radius * slopes
        spread = radius * np.hypot(terms[..., 1], terms[..., 2]) + edges.sum(1) / 2
        spread += radius**2 * np.abs(terms[..., 3:6]).sum(-1) + radius**3 * np.abs(terms[..., 6:]).sum(-1)
        middle = (terms[..., 0] - self._origin) @ self._inverse.T
        half = spread @ np.abs(self._inverse).T + ROUNDING
        # the nearest lens is the rounded place, or one of the four around it
        below, above = (0.0, 1.0) if self._hexagonal else (0.5, 0.5)
        ends = np.floor(middle - half + below), np.floor(middle + half + above)
        low, high = (np.clip(end, self._first, self._last).astype(np.int32) for end in ends)
        return low, high

    def compute(self, model, first_voxel=0):
        """Count the rays of voxels.

        Parameters
        ----------
        model : ndarray, shape (voxel, MODEL_SIZE), float32
            Ray models of third order.
        first_voxel : int
            Number of the first voxel. A voxel's shift of the rays depends on its number.

        Yields
        ------
        tuple of ndarray
            For some voxels: their numbers of blocks, of values, of even blocks, of even values, int32; the weight of a
            level, float32; then ``ray``, ``height``, ``width`` and ``value`` as in ``projector.Blocks``.
        """
        model = np.ascontiguousarray(model, np.float32)
        some = GPU_LANES if runtime.device().form == "gpu" else CHUNK_VOXELS
        for first in range(0, len(model), some):
            yield self._count(model[first : first + some], first_voxel + first)

    def _zeros(self, name, lanes, size):
        """Return scratch memory of zeros on the device of at least `size` integers a lane. Kernels leave it zero."""
        known = self._scratch.get(name)
        if known is None or known.shape[0] < lanes or known.shape[1] < size:
            before = known.shape if known else (0, 0)
            self._scratch[name] = ti.ndarray(ti.i32, (max(lanes, before[0]), max(size, before[1])))
            self._scratch[name].fill(0)
        return self._scratch[name]

    def _count(self, model, first_voxel):
        device, edge = runtime.device_of_taichi(), self._microimages.edge
        low, high = self.reach(model)
        box = (high - low).max(0) + 1
        window, lit = int(box.prod()) * edge**2, int(box.prod()) * edge * -(-edge // BLOCK_WIDTH)
        on_gpu = device.form == "gpu"
        lanes = min(len(model), GPU_LANES if on_gpu else device.threads, max(1, SCRATCH_BYTES // (4 * (window + lit))))
        kernel = _kernel(self._hexagonal, *((32, 1, 1) if on_gpu else (1, BATCH, runtime.TAICHI_SHARE)))
        scratch = [self._zeros(name, lanes, size) for name, size in (("window", window), ("lit", lit))]
        needed = np.empty((len(model), 5), np.int32)
        while True:
            rays, extents, values = (
                np.empty((len(model), room), dtype)
                for room, dtype in zip((self._room[0], *self._room), (np.int32, np.int32, np.uint8), strict=True)
            )
            kernel(
                *(model, low, ti.Vector(box), self._microimages.corner, ti.Vector(self._first)),
                *(sobol_points(self._rays), first_voxel, lanes, self._camera, self._lattice),
                *(*scratch, rays, extents, values, needed),
            )
            ti.sync()
            most = needed[:, :2].max(0, initial=0)
            if (most <= self._room).all():
                break
            self._room = [max(room, int(1.25 * more)) for room, more in zip(self._room, most, strict=True)]
        blocks, total = needed[:, 0], needed[:, 1]
        some = np.arange(rays.shape[1]) < blocks[:, None]
        extent = extents[some]
        value = np.concatenate([own[:end] for own, end in zip(values, total, strict=True)])
        scale = (needed[:, 4] / (TOP * self._rays)).astype(np.float32)
        per_voxel = (np.ascontiguousarray(needed[:, k]) for k in range(4))
        return (*per_voxel, scale, rays[some], (extent >> 8).astype(np.uint8), (extent & 255).astype(np.uint8), value)
