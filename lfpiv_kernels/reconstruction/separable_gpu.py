"""Projection with profiles that planes of voxels share on a GPU; host functions and CPU form: ``projector_separable``.

Some ray rows at a time are projected, through the lines of all planes and strips in memory: voxels to lines, lines
moved, lines to rays, rays with their rim, and back. Each lane sums one element of a line, one ray or one voxel, in a
fixed order: results do not depend on the number of threads. For the way back the profiles across are stored a second
time, column by column: which pixels see a column, and how much. The loops are C++, see ``separable_gpu.h``. Twin:
``reference.separable``.
"""

from collections.abc import Iterator

import numpy as np
import warp as wp
from scipy.sparse import csr_array

from lfpiv_kernels import native
from lfpiv_kernels.lanes import LANES, lanes_of_warp
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction.separable_layout import Separable, on_device
from lfpiv_kernels.reconstruction.separable_weights import (
    COLUMN_BLOCK,
    MOST_TAPS,
    PARTS,
    STRIP,
    SeparableWeights,
    line_elements,
)
from lfpiv_kernels.transfer import empty, to_device, to_host, zeros

wp.set_module_options(native.options("separable_gpu.h", contract="fast"))

SEEN_BYTES = 4 + PARTS
"""Memory of a pixel that sees a column [byte]."""
LINES_BYTES = 16 << 20
"""Memory of the lines of ray rows that are projected at once [byte], unless those of one take more: a part of a GPU's
second cache."""


@wp.struct
class RayRows:
    """Some ray rows, at equal distances."""

    first: int
    step: int
    count: int


def _on_rows(function: str, light: str, *others: str) -> str:
    """Return the call of a function that takes light through some ray rows."""
    given = f"lfpiv::separable_arrays(separable), warp, {light}.data, lfpiv::ray_rows(rows)"
    return f"lfpiv::{function}({given}, {', '.join(others)});"


@native.kernel(_on_rows("sum_down", "volume", "lines_out.data"), "warp", "_lane")
def _down(
    # in
    separable: Separable,
    volume: wp.array(dtype=float),
    rows: RayRows,
    first_warp: int,
    # out
    lines_out: wp.array(dtype=float),
): ...


@native.kernel(_on_rows("move_lines", "lines", "back", "lines_out.data"), "warp", "_lane")
def _move(
    # in
    separable: Separable,
    lines: wp.array(dtype=float),
    rows: RayRows,
    back: bool,
    first_warp: int,
    # out
    lines_out: wp.array(dtype=float),
): ...


@native.kernel(_on_rows("sum_across", "lines", "bare_out.data"), "warp", "_lane")
def _across(
    # in
    separable: Separable,
    lines: wp.array(dtype=float),
    rows: RayRows,
    first_warp: int,
    # out
    bare_out: wp.array(dtype=float),
): ...


@native.kernel(_on_rows("add_rim", "bare", "rays_out.data"), "warp", "_lane")
def _rim(
    # in
    separable: Separable,
    bare: wp.array(dtype=float),
    rows: RayRows,
    first_warp: int,
    # out
    rays_out: wp.array(dtype=float),
): ...


@native.kernel(_on_rows("turn_back_rim", "rays", "bare_out.data"), "warp", "_lane")
def _rim_back(
    # in
    separable: Separable,
    rays: wp.array(dtype=float),
    rows: RayRows,
    first_warp: int,
    # out
    bare_out: wp.array(dtype=float),
): ...


@native.kernel(_on_rows("return_across", "bare", "lit", "lines_out.data"), "warp", "_lane")
def _across_back(
    # in
    separable: Separable,
    bare: wp.array(dtype=float),
    rows: RayRows,
    lit: bool,
    first_warp: int,
    # out
    lines_out: wp.array(dtype=float),
): ...


@native.kernel(_on_rows("return_down", "lines", "lit", "volume_out.data"), "warp", "_lane")
def _down_back(
    # in
    separable: Separable,
    lines: wp.array(dtype=float),
    rows: RayRows,
    lit: bool,
    first_warp: int,
    # out
    volume_out: wp.array(dtype=float),
): ...


class LinesProjector:
    """Sends light from voxels to the rays of ray rows, and back, on a GPU."""

    def __init__(self, weights: SeparableWeights):
        self._weights = weights
        self._arrays = on_device(weights, weights.strides)
        start, by, level = columns_seen(weights)
        for name, array in (("reach", reach(weights)), ("seen_start", start), ("seen_by", by), ("seen_level", level)):
            setattr(self._arrays, name, to_device(array.ravel()))
        _, planes, columns = weights.shape
        lines = planes * weights.strips, columns
        self._at_once = rows_at_once(lines, weights.ray_rows)
        self._lines, self._moved = (zeros(self._at_once * line_elements(*lines)) for _ in range(2))
        self._bare = empty(self._at_once * weights.rays_of_row)
        """Rays without their rim."""
        self._elements = planes * weights.strips * weights.blocks * COLUMN_BLOCK * STRIP
        """Elements of the lines of a ray row."""

    @property
    def nbytes(self) -> int:
        """Memory on the GPU [byte]."""
        arrays = (getattr(self._arrays, name) for name in Separable.vars)
        own = [self._bare, self._lines, self._moved]
        return sum(one.capacity for one in (*arrays, *own) if isinstance(one, wp.array))

    def _some(self, ray_rows: range) -> Iterator[RayRows]:
        """Yield the ray rows that are projected at once, one after the other."""
        for begin in range(0, len(ray_rows), self._at_once):
            some, rows = ray_rows[begin : begin + self._at_once], RayRows()
            rows.first, rows.step, rows.count = some.start, some.step, len(some)
            yield rows

    def scatter(self, volume: wp.array, ray_rows: range, rays_out: wp.array) -> None:
        """Write the light of `volume` on the rays of some ray rows."""
        weights = self._arrays
        for rows in self._some(ray_rows):
            elements, rays = rows.count * self._elements, rows.count * self._weights.rays_of_row
            _launch(_down, elements, [weights, volume, rows], self._lines)
            _launch(_move, elements, [weights, self._lines, rows, False], self._moved)
            _launch(_across, rays, [weights, self._moved, rows], self._bare)
            _launch(_rim, rays, [weights, self._bare, rows], rays_out)

    def gather(self, rays: wp.array, ray_rows: range, volume_out: wp.array) -> None:
        """Add the weighted sum of the light on the rays of some ray rows to the voxels."""
        weights = self._arrays
        for rows in self._some(ray_rows):
            elements = rows.count * self._elements
            _launch(_rim_back, rows.count * self._weights.rays_of_row, [weights, rays, rows], self._bare)
            _launch(_across_back, elements, [weights, self._bare, rows, False], self._lines)
            _launch(_move, elements, [weights, self._lines, rows, True], self._moved)
            _launch(_down_back, volume_out.size, [weights, self._moved, rows, False], volume_out)

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32; lines are not moved, and rays have no rim."""
        weights, size = self._arrays, self._weights.rays_of_row
        seen, count = to_device((self._weights.share > 0).astype(np.float32)), zeros(int(np.prod(self._weights.voxels)))
        for rows in self._some(range(self._weights.ray_rows)):
            bare = seen[rows.first * size : (rows.first + rows.count) * size]
            _launch(_across_back, rows.count * self._elements, [weights, bare, rows, True], self._lines)
            _launch(_down_back, count.size, [weights, self._lines, rows, True], count)
        return np.rint(to_host(count)).astype(np.int32)


def reach(weights: SeparableWeights) -> np.ndarray:
    """Return the least and the largest first row of voxels of the profiles down of each strip and block of columns.

    Shape (plane, ray row, strip, block, 2), int16. Where there are none the largest is the smaller one.
    """
    first = weights.down_first
    least = np.where(first < 0, np.iinfo(np.int16).max, first).min(-1)
    return np.stack([least, first.max(-1)], axis=-1).astype(np.int16)


def columns_seen(weights: SeparableWeights) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which pixels of a strip see each column of a plane, and by how much, column by column.

    Returns
    -------
    start : ndarray, shape (plane * strip * column + 1,), int64
        Where the pixels that see a column begin.
    by : ndarray, shape (entry,), int32
        The pixel, ``lens * pixels + pixel column``, in increasing order.
    level : ndarray, shape (entry, PARTS), uint8
        Levels of its profile across, of which one is above 0.
    """
    _, planes, columns = weights.shape
    pair = np.dtype(f"u{PARTS}")  # the levels of all parts as one number
    start, by, level = [np.zeros(1, np.int64)], [], []
    for plane, strip in np.ndindex(planes, weights.strips):
        pixels, taps = int(weights.lens_count[plane, strip]) * weights.pixels, int(weights.taps[plane, strip])
        first = weights.first[weights.first_start[plane, strip] :][:pixels].astype(np.int32)
        levels = weights.level[weights.level_start[plane, strip] :][: pixels * taps * PARTS].view(pair)
        seen = (first[:, None] + np.arange(taps, dtype=np.int32)).ravel()
        rows = taps * np.arange(pixels + 1, dtype=np.int32)
        matrix = csr_array((levels, seen, rows), shape=(pixels, columns + MOST_TAPS)).tocsc()
        matrix.eliminate_zeros()
        end = int(matrix.indptr[columns])
        start.append(start[-1][-1] + matrix.indptr[1 : columns + 1])
        by.append(matrix.indices[:end] + int(weights.lens[plane, strip]) * weights.pixels)
        level.append(matrix.data[:end].view(np.uint8))
    return np.concatenate(start), np.concatenate(by).astype(np.int32), np.concatenate(level)


def rows_at_once(lines: tuple[int, int], ray_rows: int) -> int:
    """Return how many ray rows are projected at once; `lines` are planes times strips, and columns of a plane."""
    return max(min(LINES_BYTES // (8 * line_elements(*lines)), ray_rows), 1)


def device_bytes(stored: int, seen: int, lines: tuple[int, int], rays: int, ray_rows: int) -> int:
    """Return the memory of one camera's weights on a GPU, and of what projects with them beside `rays` [byte].

    Parameters
    ----------
    stored : int
        Memory of the weights on the host [byte].
    seen : int
        At most so many times a pixel of a strip sees a column of a plane.
    lines : tuple of int
        Planes times strips, and columns of a plane.
    rays, ray_rows : int
        Their numbers.
    """
    at_once = rows_at_once(lines, ray_rows)
    starts, lights = 8 * lines[0] * lines[1], 5 * rays  # with the rim
    return stored + SEEN_BYTES * seen + starts + lights + at_once * (8 * line_elements(*lines) + 4 * rays // ray_rows)


def _launch(kernel: wp.Kernel, size: int, inputs: list[object], output: wp.array) -> None:
    """Launch a kernel with a lane for each of `size` elements."""
    launch(Call(kernel, -(-size // LANES), inputs, [output], inner=lanes_of_warp()))
