"""Warp: projection of voxels to pixels and its adjoint, with profiles that planes of voxels share.

Light goes from the voxels of a plane down to its line, which one ray row of a strip of lenses sees, and from lines
across to rays. Each ray is computed by one thread, and so is each plane of voxels in the adjoint: results do not depend
on the number of threads. The loops are C++, see ``separable.h``; a GPU has those of ``separable_gpu``. Twin:
``reference.separable``.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.reconstruction import voxels
from lfpiv_kernels.reconstruction.pixel_rays import ALL, RayMap, RaySets
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.separable_gpu import LinesProjector
from lfpiv_kernels.reconstruction.separable_layout import Separable, on_device
from lfpiv_kernels.reconstruction.separable_weights import SeparableWeights, line_elements
from lfpiv_kernels.transfer import Given, Values, empty, overwrite, to_device, to_host, zeros

wp.set_module_options(native.options("separable.h", contract="fast"))

LENS_BLOCK: int = native.constant("separable.h", "LENS_BLOCK")
"""Fewest lenses in a row whose rays a thread computes."""
FEWEST_RAYS = 2**20
"""Fewest rays times planes of voxels of a launch's part. A smaller part takes less time than to wake a thread."""
FEWEST_LENSES = 4096
"""Fewest lenses of a part, each in one ray row, where rims are turned back."""
LEAST_TASKS = 4
"""Fewest tasks of a projection for each thread."""
TURNED_RAYS = 2**20
"""Rays that a gather takes at once: with them, the voxels that a strip sees stay in a core's caches."""
MOST_VALUES: int = native.constant("separable.h", "MOST_VALUES")
"""Most values of the profiles across of a lens, which a thread has room for."""


@wp.struct
class Part:
    """Some ray rows of some strips."""

    first_row: int
    step: int
    """From each ray row to the next one."""
    rows: int
    first_strip: int
    strips: int


@native.kernel("""
    const auto weights = lfpiv::separable_arrays(separable);
    const int segments = (weights.lenses + segment - 1) / segment, number = task % segments;
    const int strip = part.first_strip + task / segments / part.rows;
    const int row = part.first_row + part.step * (task / segments % part.rows);
    const int end = lfpiv::min((number + 1) * segment, weights.lenses);
    const int64_t lines = (int64_t)weights.planes * lfpiv::line_size(weights);
    lfpiv::project_segment(weights, volume.data, row, strip, number * segment, end,
                           lines_out.data + (slot < 0 ? 0 : slot) * lines, rays_out.data);
""")
def _project(
    # in
    separable: Separable,
    volume: wp.array(dtype=float),
    part: Part,
    segment: int,
    slot: int,
    first_task: int,
    # out
    lines_out: wp.array(dtype=float),
    rays_out: wp.array(dtype=float),
): ...


@native.kernel("""
    const auto weights = lfpiv::separable_arrays(separable);
    const int lenses = part.strips * weights.lenses, row = part.first_row + part.step * (task / lenses);
    const int64_t lens = ((int64_t)row * weights.strips + part.first_strip) * weights.lenses + task % lenses;
    lfpiv::turn_back_rim(weights, lens, rays.data, turned_out.data + (int64_t)task * weights.pixels * lfpiv::STRIP);
""")
def _turn(
    # in
    separable: Separable,
    rays: wp.array(dtype=float),
    part: Part,
    first_task: int,
    # out
    turned_out: wp.array(dtype=float),
): ...


@native.kernel("""
    const auto weights = lfpiv::separable_arrays(separable);
    float* const line = line_out.data + (int64_t)(slot < 0 ? 0 : slot) * lfpiv::line_size(weights);
    lfpiv::gather_plane(weights, turned.data, part, plane, line, volume_out.data);
""")
def _gather(
    # in
    separable: Separable,
    turned: wp.array(dtype=float),
    part: Part,
    slot: int,
    first_plane: int,
    # out
    line_out: wp.array(dtype=float),
    volume_out: wp.array(dtype=float),
): ...


class SeparableProjector(RayProjector):
    """The map of weights stored as profiles of planes. Its sets of rays are those of every n-th ray row.

    Parameters
    ----------
    sets : int
        Number of sets of rays.
    """

    def __init__(self, weights: SeparableWeights, sets: int):
        super().__init__()
        self.weights, self.ray_sets, self.rows, self.parts = weights, sets, sets, (weights,)
        self.form, self.nbytes = weights.form, weights.nbytes
        self.rays = zeros(weights.ray_rows * weights.rays_of_row)
        self.returned = zeros(weights.ray_rows * weights.rays_of_row)
        self._on_gpu = LinesProjector(weights) if runtime.device().form == "gpu" else None
        if self._on_gpu is None:
            _, planes, columns = weights.shape
            self._moved = weights.axes[2] != 2
            """Whether columns must be brought together in memory first."""
            self._arrays = self._arrays_of(weights)
            self._turned = empty(max(min(TURNED_RAYS, self.rays.size), weights.rays_of_row // weights.strips))
            self._lines = zeros(lines_bytes(planes, columns) // 4)
        self.map = self._map_rays()

    @property
    def microimages(self) -> SeparableWeights:
        """Pixel and share of each ray."""
        return self.weights

    @property
    def device_bytes(self) -> int:
        """Memory of a GPU that the weights and the loops take, beside `rays` [byte]; 0 on the CPU."""
        return 0 if self._on_gpu is None else self._on_gpu.nbytes + self.returned.size * 4

    def _arrays_of(self, weights: SeparableWeights) -> Separable:
        """Return the arrays of weights for the CPU's kernels."""
        _, planes, columns = weights.shape
        return on_device(weights, (planes * columns, columns, 1) if self._moved else weights.strides)

    def _map_rays(self) -> RayMap:
        """Return the map between pixels and the rays that voxels light."""
        weights = self.weights
        self.scatter(voxels.ones(int(np.prod(weights.voxels))))
        of_row = (np.arange(weights.ray_rows) % self.ray_sets).astype(np.uint8)
        sets = RaySets(of_row, weights.rays_of_row, self.ray_sets)
        return RayMap(weights, to_host(self.rays), [0, self.rays.size], [0], sets=sets, darken=False)

    def _ray_rows(self, ray_set: int) -> range:
        """Return the ray rows of a set."""
        return range(self.weights.ray_rows) if ray_set == ALL else range(ray_set, self.weights.ray_rows, self.ray_sets)

    def scatter(self, volume: Values, ray_set: int = ALL) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of a set. Other rays stay as they are."""
        light, rows = to_device(volume, float), self._ray_rows(ray_set)
        if self._on_gpu is not None:
            self._on_gpu.scatter(light, rows, self.rays)
            return
        if self._moved:
            light = _transposed(light, self.weights.voxels, self.weights.axes)
        segment = self._segment(len(rows) * self.weights.strips)
        tasks = len(rows) * self.weights.strips * -(-self.weights.lenses // segment)
        inputs = [self._arrays, light, _part(rows, 0, self.weights.strips), segment]
        call = Call(_project, tasks, inputs, [self._lines, self.rays], scratch=True)
        launch(call, parts=self._launch_parts(len(rows)))

    def _launch_parts(self, rows: int) -> int:
        """Return the parts of a launch on the CPU over some ray rows."""
        if runtime.device().threads == 1:
            return 1
        return min(runtime.CHUNKS, 1 + rows * self.weights.rays_of_row * self.weights.shape[1] // FEWEST_RAYS)

    def _segment(self, rows: int) -> int:
        """Return the lenses in a row whose rays a thread computes: a whole row where there are rows enough."""
        pieces = -(-LEAST_TASKS * runtime.device().threads // rows)
        return max(-(-self.weights.lenses // pieces), LENS_BLOCK)

    def gather(self, out: Given, active: Values | None = None, ray_set: int = ALL) -> Given:
        """Add the weighted sum of the light on each voxel's rays of a set to `out`, shape (voxel,). Return `out`."""
        volume = to_device(out, float)
        if self._on_gpu is not None:
            self._on_gpu.gather(self.returned, self._ray_rows(ray_set), volume)
        else:
            found = self._gather(self._arrays, self.returned, ray_set, zeros(volume.size) if self._moved else volume)
            if found is not volume:
                voxels.add(found, volume)
        overwrite(out, volume)
        return out

    def _gather(self, arrays: Separable, rays: wp.array, ray_set: int, out: wp.array) -> wp.array:
        """Add to `out`, shape (voxel,). Return it in the order of voxels in memory."""
        weights = self.weights
        for part in self._parts(self._ray_rows(ray_set)):
            lenses = part.rows * part.strips * weights.lenses
            turn = Call(_turn, lenses, [arrays, rays, part], [self._turned])
            launch(turn, parts=parts_of(lenses, FEWEST_LENSES))
            inputs, outputs = [arrays, self._turned, part], [self._lines, out]
            gather = Call(_gather, weights.shape[1], inputs, outputs, scratch=True)
            launch(gather, parts=self._launch_parts(part.rows))
        if not self._moved:
            return out
        first, second, third = (self.weights.axes.index(axis) for axis in range(3))
        return _transposed(out, self.weights.shape, (first, second, third))

    def _parts(self, rows: range) -> Iterator[Part]:
        """Yield the parts that a gather takes, one after the other: all rows of some strips, or some rows of one."""
        strips, of_strip = self.weights.strips, self.weights.rays_of_row // self.weights.strips
        most_rows = min(self._turned.size // of_strip, len(rows))
        most_strips = self._turned.size // (of_strip * most_rows)
        for strip in range(0, strips, most_strips):
            for row in range(0, len(rows), most_rows):
                yield _part(rows[row : row + most_rows], strip, min(most_strips, strips - strip))

    def darken(self, ray_set: int = ALL) -> None:
        """Make the rays of a set dark that `gather` reads."""
        rows, size = self._ray_rows(ray_set), self.weights.rays_of_row
        if ray_set == ALL:
            self.returned.zero_()
        elif runtime.device().form == "cpu":  # to cut arrays of Warp takes longer than to clear them
            to_host(self.returned).reshape(-1, size)[rows.start :: rows.step] = 0
        else:
            for row in rows:
                self.returned[row * size : (row + 1) * size].zero_()

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,)."""
        volume = np.zeros(int(np.prod(self.weights.voxels)), np.float32)
        volume[voxel] = 1.0
        with self.reserved():
            self.scatter(volume)
            light = to_host(self.rays)
            rays = np.flatnonzero(light)
            return rays, light[rays].copy()

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32."""
        weights = self.weights
        if self._on_gpu is not None:
            with self.reserved():
                return self._on_gpu.count_lit()
        lit = replace(
            weights,
            down=(weights.down > 0).astype(np.uint8),
            level=(weights.level > 0).astype(np.uint8),
            down_scale=np.ones_like(weights.down_scale),
            turn=np.zeros_like(weights.turn),
            rim=np.zeros_like(weights.rim),
        )
        with self.reserved():
            seen = to_device((weights.share > 0).astype(np.float32))
            count = self._gather(self._arrays_of(lit), seen, ALL, zeros(int(np.prod(weights.voxels))))
        return np.rint(to_host(count)).astype(np.int32)

    def largest_weight(self) -> float:
        """Return the largest weight of a ray: the largest product of two profiles of a plane."""
        return self.weights.largest


def _part(rows: range, first_strip: int, strips: int) -> Part:
    part = Part()
    part.first_row, part.step, part.rows = rows.start, rows.step, len(rows)
    part.first_strip, part.strips = first_strip, strips
    return part


def lines_bytes(planes: int, columns: int) -> int:
    """Return the memory of the lines that the threads of a launch work on [byte]."""
    return 4 * runtime.CHUNKS * line_elements(planes, columns)


def _transposed(volume: wp.array, shape: tuple[int, int, int], axes: tuple[int, int, int]) -> wp.array:
    """Return a flat volume of a shape with its axes in another order in memory."""
    return to_device(np.ascontiguousarray(to_host(volume).reshape(shape).transpose(axes)).ravel())
