"""Statistics of a volume's windows on a GPU; host functions and CPU form: ``windows``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation import split_gpu
from lfpiv_kernels.correlation.layout import Extent, Lattice
from lfpiv_kernels.correlation.memory import new_array
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("windows_gpu.h"))


@native.kernel("lfpiv::sum_row(volume.data, extent, row, x, sum_out.data, square_out.data);", "row", "x")
def _sum_rows(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x); a thread per row of a plane and window along x
    extent: Extent,
    first_row: int,
    # out
    sum_out: wp.array(dtype=float),  # sums over the windows' x, (z, y, x) with as many x as windows fit
    square_out: wp.array(dtype=float),  # the same of the squares
): ...


@native.kernel(
    """
    lfpiv::sum_column(
        row_sum.data, row_square.data, extent, lattice, z, y, x, sum_out.data, square_out.data
    );
    """,
    "z",
    "y",
    "x",
)
def _sum_columns(
    # in
    row_sum: wp.array(dtype=float),  # of `_sum_rows`; a thread per plane, and window along y and x
    row_square: wp.array(dtype=float),
    extent: Extent,
    lattice: Lattice,
    first_z: int,
    # out
    sum_out: wp.array(dtype=float),  # sums over the windows' y and x, as many y and x as windows fit
    square_out: wp.array(dtype=float),
): ...


@native.kernel(
    """
    lfpiv::measure_column(
        sum.data, square.data, extent, floor, lattice, y, x, mean_out.data, scale_out.data
    );
    """,
    "y",
    "x",
)
def _window_statistics(
    # in
    sum: wp.array(dtype=float),  # of `_sum_columns`; a thread per row and column
    square: wp.array(dtype=float),
    extent: Extent,
    floor: float,
    lattice: Lattice,
    first_y: int,
    # out
    mean_out: wp.array(dtype=float),  # (plane, y, x) with as many y and x as windows fit
    scale_out: wp.array(dtype=float),  # the same
): ...


def sums_calls(
    volume: wp.array, extent: Extent, lattice: Lattice, fitting: tuple[int, int, int], sums: tuple[wp.array, wp.array]
) -> list[Call]:
    """Return the calls, one after the other, that sum values and squares of each plane over the windows' y and x.

    `fitting` holds the planes of the volume, and the windows that fit along y and x.
    """
    depth, rows, columns = fitting
    along_x = [new_array(depth * extent.shape[1] * columns) for _ in range(2)]
    return [
        Call(_sum_rows, depth * extent.shape[1], [volume, extent], along_x, inner=(columns,)),
        Call(_sum_columns, depth, [*along_x, extent, lattice], sums, inner=(rows, columns)),
    ]


def statistics_calls(
    inputs: list[object], lattice: Lattice, fitting: tuple[int, int, int], statistics: tuple[wp.array, wp.array]
) -> list[Call]:
    """Return the calls, one after the other, that find mean and scale of windows and store them by phase.

    A thread measures the windows of one row and column; `fitting` as in `sums_calls`.
    """
    _, rows, columns = fitting
    at_rows = [new_array(lattice.planes * rows * columns) for _ in range(2)]
    measured, shape = Lattice(), wp.vec3i(lattice.planes, rows, columns)
    measured.corner, measured.stride = wp.vec3i(0, lattice.corner[1], lattice.corner[2]), lattice.stride
    measured.phases, measured.planes = lattice.phases, lattice.planes
    measured.pitch, measured.lanes = lattice.pitch, lattice.lanes
    pairs = zip(at_rows, statistics, strict=True)
    return [
        Call(_window_statistics, rows, inputs, at_rows, inner=(columns,)),
        *(split_gpu.split_call([rows_sum, shape, measured], measured, out) for rows_sum, out in pairs),
    ]
