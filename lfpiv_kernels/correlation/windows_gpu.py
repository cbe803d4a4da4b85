"""Statistics of a volume's windows on a GPU; host functions and CPU form: ``windows``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Extent, Lattice

wp.set_module_options(native.options("windows_gpu.h"))


@wp.func_native("lfpiv::sum_row(volume.data, extent, row, x, sum_out.data, square_out.data);")
def _sum_row(
    volume: wp.array(dtype=float),
    extent: Extent,
    row: int,
    x: int,
    sum_out: wp.array(dtype=float),
    square_out: wp.array(dtype=float),
): ...


@wp.kernel
def sum_rows(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x); a thread per row of a plane and window along x
    extent: Extent,
    begin: int,
    # out
    sum_out: wp.array(dtype=float),  # sums over the windows' x, (z, y, x) with as many x as windows fit
    square_out: wp.array(dtype=float),  # the same of the squares
):
    """Sum a row of the volume over the x of one window."""
    row, x = wp.tid()
    _sum_row(volume, extent, begin + row, x, sum_out, square_out)


@wp.func_native(
    "lfpiv::sum_column(row_sum.data, row_square.data, extent, lattice, z, y, x, sum_out.data, square_out.data);"
)
def _sum_column(
    row_sum: wp.array(dtype=float),
    row_square: wp.array(dtype=float),
    extent: Extent,
    lattice: Lattice,
    z: int,
    y: int,
    x: int,
    sum_out: wp.array(dtype=float),
    square_out: wp.array(dtype=float),
): ...


@wp.kernel
def sum_columns(
    # in
    row_sum: wp.array(dtype=float),  # of `sum_rows`; a thread per plane, and window along y and x
    row_square: wp.array(dtype=float),
    extent: Extent,
    lattice: Lattice,
    begin: int,
    # out
    sum_out: wp.array(dtype=float),  # sums over the windows' y and x, as many y and x as windows fit
    square_out: wp.array(dtype=float),
):
    """Sum a plane over the y and x of one window."""
    z, y, x = wp.tid()
    _sum_column(row_sum, row_square, extent, lattice, begin + z, y, x, sum_out, square_out)


@wp.func_native(
    "lfpiv::measure_column(sum.data, square.data, extent, floor, lattice, y, x, mean_out.data, scale_out.data);"
)
def _measure_column(
    sum: wp.array(dtype=float),
    square: wp.array(dtype=float),
    extent: Extent,
    floor: float,
    lattice: Lattice,
    y: int,
    x: int,
    mean_out: wp.array(dtype=float),
    scale_out: wp.array(dtype=float),
): ...


@wp.kernel
def window_statistics(
    # in
    sum: wp.array(dtype=float),  # of `sum_columns`; a thread per row and column
    square: wp.array(dtype=float),
    extent: Extent,
    floor: float,
    lattice: Lattice,
    begin: int,
    # out
    mean_out: wp.array(dtype=float),
    scale_out: wp.array(dtype=float),
):
    """Measure mean and scale of the windows at one row and column in all planes."""
    y, x = wp.tid()
    _measure_column(sum, square, extent, floor, lattice, begin + y, x, mean_out, scale_out)
