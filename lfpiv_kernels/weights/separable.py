"""Warp: the weights of a camera as profiles that planes of voxels share, from the ray models of the voxels.

The weight of a voxel on a ray is integrated as in ``footprint``, along the two axes of the lenses apart. Where a
camera's rays are straight, its lenses square and its array upright, the profile along the rows of the sensor is the
same for all lenses of a row, and that along the columns the same for all voxels that one row of rays sees in a column.
So a plane has few different profiles [1]_. The loops are C++, see ``separable_weights.h``. Tests compare the images of
particles with those by ``footprint``, whose twin is ``reference.footprint``.

.. [1] Y. Long, J. A. Fessler, J. M. Balter, "3D forward and back-projection for X-ray CT using separable footprints",
   IEEE Trans. Med. Imaging 29 (2010) 1839-1850, doi:10.1109/TMI.2010.2050898.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction.separable_weights import COLUMN_BLOCK, MOST_TAPS, PARTS, STRIP
from lfpiv_kernels.transfer import to_device
from lfpiv_kernels.weights.footprint_arrays import Inputs
from lfpiv_kernels.weights.ray_model import LEVELS

wp.set_module_options(native.options("separable_weights.h", contract="fast"))

LEAST = 0.5 / LEVELS
"""Least value of a profile across that is stored. A ray that sees nothing but a voxel has 1."""


@wp.struct
class RayLayout:
    """Where rays lie on the sensor, see ``RayLayout`` in ``separable_weights.h``."""

    first_column: wp.array(dtype=int)
    first_row: wp.array(dtype=int)
    strips: int
    lenses: int
    pixels: int
    ray_rows: int


@native.kernel("""
    top_out.data[block] = lfpiv::top_of_block(lfpiv::ray_layout(inputs, rays), {rows, columns, blocks}, block);
""")
def _top(
    # in
    inputs: Inputs,
    rays: RayLayout,
    rows: int,
    columns: int,
    blocks: int,
    first_block: int,
    # out
    top_out: wp.array(dtype=float),
): ...


@native.kernel("""
    lfpiv::measure_down(
        lfpiv::ray_layout(inputs, rays), {rows, columns, blocks}, block, per_level, (short*)first_out.data,
        (short*)last_out.data
    );
""")
def _measure(
    # in
    inputs: Inputs,
    rays: RayLayout,
    rows: int,
    columns: int,
    blocks: int,
    per_level: float,
    first_block: int,
    # out
    first_out: wp.array(dtype=wp.int16),
    last_out: wp.array(dtype=wp.int16),
): ...


@native.kernel("""
    lfpiv::fill_down(
        lfpiv::ray_layout(inputs, rays), {rows, columns, blocks}, block, per_level, taps, (const short*)first.data,
        level_out.data
    );
""")
def _fill(
    # in
    inputs: Inputs,
    rays: RayLayout,
    rows: int,
    columns: int,
    blocks: int,
    per_level: float,
    taps: int,
    first: wp.array(dtype=wp.int16),
    first_block: int,
    # out
    level_out: wp.array(dtype=wp.uint8),
): ...


@native.kernel("""
    const int64_t lenses = (int64_t)strip * rays.lenses * rays.pixels;
    lfpiv::find_across(
        lfpiv::ray_layout(inputs, rays), strip, columns, least, lens_out.data + 3 * strip,
        (short*)first_out.data + lenses, value_out.data + lenses * lfpiv::MOST_TAPS * lfpiv::PARTS);
""")
def _across(
    # in
    inputs: Inputs,
    rays: RayLayout,
    columns: int,
    least: float,
    first_strip: int,
    # out
    lens_out: wp.array(dtype=int),
    first_out: wp.array(dtype=wp.int16),
    value_out: wp.array(dtype=float),
): ...


@native.kernel("""
    const int strip = at / rays.lenses % rays.strips, lens = at % rays.lenses, row = at / (rays.lenses * rays.strips);
    const int64_t ray = (int64_t)at * rays.pixels * lfpiv::STRIP;
    lfpiv::write_ray_row(
        lfpiv::ray_layout(inputs, rays), row, strip, lens, pixel_out.data + ray, share_out.data + ray,
        (signed char*)rim_out.data + ray);
""")
def _write_rays(
    # in
    inputs: Inputs,
    rays: RayLayout,
    first_at: int,
    # out
    pixel_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
    rim_out: wp.array(dtype=wp.int8),
): ...


class Profiles:
    """Computes the profiles of one camera, plane by plane, on the CPU.

    Parameters
    ----------
    camera, lattice
        From ``ray_model.pack_optics`` and ``lattice.pack_lattice``; a square one.
    cell_mm : float
        Half extent of a lens's cell along s and t [mm].
    frame : ndarray, shape (2, 2)
        From ``lattice.cell_frame``.
    first_lens : tuple of int
        Lattice indices (i, j) of the first lens.
    lens_rows : int
        Rows of lenses.
    first_column, first_row : ndarray
        As in ``SeparableWeights``.
    pixels, ray_rows : int
        Columns and rows of pixels under a lens.
    """

    def __init__(
        self, camera, lattice, cell_mm, *, frame, first_lens, lens_rows, first_column, first_row, pixels, ray_rows
    ):
        geometry = np.concatenate([camera.to_numpy(), lattice.to_numpy(), [cell_mm], np.ravel(frame)], dtype=np.float32)
        self._inputs = Inputs()
        self._inputs.geometry = _on_cpu(geometry)
        self._inputs.lenses = wp.vec4i(*first_lens, first_column.shape[1], lens_rows)
        self._inputs.corners = _on_cpu(np.zeros(2 * first_column.shape[1] * lens_rows, np.int32))
        self._inputs.cuts, self._inputs.profiles = wp.vec3i(1, 1, 1), True
        self._layout = RayLayout()
        self._layout.first_column, self._layout.first_row = _on_cpu(first_column.ravel()), _on_cpu(first_row)
        self._layout.strips, self._layout.lenses = first_column.shape
        self._layout.pixels, self._layout.ray_rows = self.pixels, self.ray_rows = pixels, ray_rows

    def rays(self):
        """Return sensor pixel, share and rim of all rays, see ``SeparableWeights``."""
        layout = self._layout
        runs = layout.ray_rows * layout.strips * layout.lenses
        size = runs * layout.pixels * STRIP
        pixel, share, rim = np.empty(size, np.int32), np.empty(size, np.float32), np.empty(size, np.int8)
        _launch(_write_rays, runs, [self._inputs, layout], [_on_cpu(one) for one in (pixel, share, rim)])
        return pixel, share, rim

    def of_plane(self, models, seen, rows, columns):
        """Compute the profiles of a plane.

        Parameters
        ----------
        models : ndarray, shape (rows * columns, MODEL_SIZE), float32
            Ray models of its voxels, row by row.
        seen : ndarray, shape (strip * PARTS * columns, MODEL_SIZE), float32
            Ray models of the columns where the middle row of lenses of each part of a strip sees them.
        rows, columns : int
            Its voxels.

        Returns
        -------
        PlaneProfiles or None
            None if a pixel sees more than `MOST_TAPS` columns.
        """
        down_first, down, down_taps, down_scale = self._down(models, rows, columns)
        across = self._across(seen, columns)
        if across is None:
            return None
        lens, first, values = across
        per_level = LEVELS / max(max((float(one.max(initial=0.0)) for one in values), default=0.0), LEAST)
        return PlaneProfiles(
            down_first=down_first,
            down=down,
            down_taps=down_taps,
            scale=down_scale / per_level,
            lens=lens,
            first=first,
            level=[np.rint(one * per_level).astype(np.uint8) for one in values],
        )

    def _down(self, models, rows, columns):
        """Return first rows of voxels, levels, taps and the weight of a level, see `PlaneProfiles`."""
        layout, blocks = self._layout, -(-columns // COLUMN_BLOCK)
        self._inputs.model = _on_cpu(np.ascontiguousarray(models, np.float32).ravel())
        inputs = [self._inputs, layout, rows, columns, blocks]
        top = np.zeros(blocks, np.float32)
        _launch(_top, blocks, inputs, [_on_cpu(top)])
        shape = layout.ray_rows, layout.strips, blocks, STRIP
        first, last = np.full(shape, -1, np.int16), np.full(shape, -1, np.int16)
        if not top.max(initial=0.0) > 0:
            return first, np.zeros(0, np.uint8), 0, 0.0
        per_level = float(LEVELS / top.max())
        _launch(_measure, blocks, [*inputs, per_level], [_on_cpu(first.ravel()), _on_cpu(last.ravel())])
        taps = int((last - first).max()) + 1 if (first >= 0).any() else 0
        levels = np.zeros(first.size * taps * COLUMN_BLOCK, np.uint8)
        if taps:
            _launch(_fill, blocks, [*inputs, per_level, taps, _on_cpu(first.ravel())], [_on_cpu(levels)])
        return first, levels, taps, 1 / per_level

    def _across(self, models, columns):
        """Return first lens, number of lenses and taps of each strip, shape (strip, 3), then first columns and values.

        None if a pixel sees more than `MOST_TAPS` columns.
        """
        layout = self._layout
        self._inputs.model = _on_cpu(np.ascontiguousarray(models, np.float32).ravel())
        lens = np.zeros((layout.strips, 3), np.int32)
        first = np.full((layout.strips, layout.lenses, layout.pixels), -1, np.int16)
        value = np.zeros((*first.shape, MOST_TAPS, PARTS), np.float32)
        _launch(
            _across,
            layout.strips,
            [self._inputs, layout, columns, LEAST],
            [_on_cpu(array.ravel()) for array in (lens, first, value)],
        )
        columns_of, values = [], []
        for number, (low, count, taps) in enumerate(lens.tolist()):
            if taps > MOST_TAPS:
                return None
            lens[number] = low if count else 0, count, taps
            some = slice(low, low + count)
            columns_of.append(_within(first[number, some]))
            values.append(value[number, some, :, :taps])
        return lens, columns_of, values


@dataclass(frozen=True, kw_only=True)
class PlaneProfiles:
    """The profiles of one plane, see ``SeparableWeights``."""

    down_first: np.ndarray
    """First row of voxels, shape (ray row, strip, block, STRIP), int16; -1 for none."""
    down: np.ndarray
    """Levels of `down_taps` x COLUMN_BLOCK voxels for each, flat, uint8."""
    down_taps: int
    """Rows of voxels in a profile down."""
    scale: float
    """Weight of one level down times one level across."""
    lens: np.ndarray
    """First lens, number of lenses and taps of each strip, shape (strip, 3), int32."""
    first: list[np.ndarray]
    """Of each strip first columns, shape (lens, pixel), int16."""
    level: list[np.ndarray]
    """Of each strip levels, shape (lens, pixel, tap, PARTS), uint8."""

    @staticmethod
    def joined(planes: "Sequence[PlaneProfiles]") -> dict[str, np.ndarray]:
        """Return the fields of ``SeparableWeights`` that hold profiles, from those of all planes."""

        def starts(sizes):
            return np.concatenate([[0], np.cumsum(np.ravel(sizes))[:-1]]).reshape(np.shape(sizes)).astype(np.int64)

        lens = np.stack([one.lens for one in planes])
        return {
            "down_first": np.stack([one.down_first for one in planes]),
            "down": np.concatenate([one.down for one in planes] + [np.zeros(STRIP, np.uint8)]),
            "down_start": starts([one.down.size for one in planes]),
            "down_taps": np.array([one.down_taps for one in planes], np.int32),
            "down_scale": np.array([one.scale for one in planes], np.float32),
            "lens": np.ascontiguousarray(lens[..., 0]),
            "lens_count": np.ascontiguousarray(lens[..., 1]),
            "taps": np.ascontiguousarray(lens[..., 2]),
            "first_start": starts([[strip.size for strip in one.first] for one in planes]),
            "level_start": starts([[strip.size for strip in one.level] for one in planes]),
            "first": np.concatenate([strip.ravel() for one in planes for strip in one.first] + [np.zeros(1, np.int16)]),
            "level": np.concatenate(
                [strip.ravel() for one in planes for strip in one.level] + [np.zeros(STRIP, np.uint8)]
            ),
        }


def _within(first):
    """Return first columns (lens, pixel), where there are none those of the nearest pixel of the lens, or 0."""
    pixel, last = np.arange(first.shape[1]), first.shape[1] - 1
    before = np.maximum.accumulate(np.where(first >= 0, pixel, -len(pixel)), axis=1)
    behind = np.minimum.accumulate(np.where(first >= 0, pixel, 2 * len(pixel))[:, ::-1], axis=1)[:, ::-1]
    nearest = np.clip(np.where(pixel - before <= behind - pixel, before, behind), 0, last)
    return np.maximum(np.take_along_axis(first, nearest, axis=1), 0)


def _on_cpu(array):
    return to_device(array, device="cpu")


def _launch(kernel, size, inputs, outputs):
    launch(Call(kernel, size, inputs, outputs), device="cpu")
