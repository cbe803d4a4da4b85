"""Warp: sums and largest values of arrays on the device, whose results stay there until they are read.

Elements are summed in a fixed order, so that no result depends on the number of threads. On the CPU a thread sums
neighbours, and NumPy adds up the threads' sums. On a GPU each of `LANES` threads sums every `LANES`-th element, so that
neighbouring threads read neighbours. Then `GROUPS` threads sum these sums, and a single thread theirs. Twins: NumPy's
sums.
"""

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.reconstruction.voxels import FEWEST_VOXELS
from lfpiv_kernels.transfer import empty, to_device, to_host, zeros

wp.set_module_options(native.options("voxels.h"))

LANES = 16384
"""Threads of the first stage of a sum on a GPU."""
GROUPS = 128
"""Threads of the second stage."""
PIECE = 4096
"""Elements that a thread of the CPU sums."""


@wp.struct
class Piece:
    """Which of the elements a thread takes: it begins at `stride` * thread."""

    stride: int
    step: int  # from an element of the thread to the next
    size: int  # of the array
    count: int  # largest number of elements of the thread if they are neighbours


@wp.func
def _end(piece: Piece, begin: int):
    """Return the end of the range of a thread's elements."""
    if piece.step > 1:
        return piece.size
    return wp.min(begin + piece.count, piece.size)


@wp.kernel
def _sum(
    # in
    values: wp.array(dtype=wp.float64),
    piece: Piece,
    first: int,
    # out
    sums_out: wp.array(dtype=wp.float64),
):
    thread = first + wp.tid()
    total, begin = wp.float64(0.0), thread * piece.stride
    for k in range(begin, _end(piece, begin), piece.step):
        total += values[k]
    sums_out[thread] = total


@wp.func_native("return lfpiv::sum_squares(weight.data, values.data, begin, end, step, added_out.data);")
def _squares(
    weight: wp.array(dtype=float),
    values: wp.array(dtype=float),
    begin: int,
    end: int,
    step: int,
    added_out: wp.array(dtype=float),
) -> wp.float64: ...


@wp.kernel
def _sum_squares(
    # in
    weight: wp.array(dtype=float),
    values: wp.array(dtype=float),
    piece: Piece,
    first: int,
    # out
    added_out: wp.array(dtype=float),  # to which `values` are added, if there is any
    sums_out: wp.array(dtype=wp.float64),
):
    thread = first + wp.tid()
    begin = thread * piece.stride
    sums_out[thread] = _squares(weight, values, begin, _end(piece, begin), piece.step, added_out)


@wp.kernel
def _find_largest(
    # in
    values: wp.array(dtype=float),
    piece: Piece,
    first: int,
    # out
    largest_out: wp.array(dtype=float),
):
    thread = first + wp.tid()
    begin = thread * piece.stride
    largest = float(-wp.inf)
    for k in range(begin, _end(piece, begin), piece.step):
        largest = wp.max(largest, values[k])
    largest_out[thread] = largest


@wp.kernel
def _add_up(
    # in
    sums: wp.array(dtype=wp.float64),
    place: int,  # of the total
    first: int,
    # out
    totals_out: wp.array(dtype=wp.float64),
):
    total = wp.float64(0.0)
    for k in range(sums.shape[0]):
        total += sums[k]
    totals_out[place + first + wp.tid()] += total


class Totals:
    """Sums of float64 numbers that stay on the device until they are read together."""

    def __init__(self, count: int):
        self.values = zeros(count, wp.float64)

    def clear(self) -> None:
        """Set all totals to zero."""
        self.values.zero_()

    def add(self, place: int, numbers: wp.array, size: int | None = None) -> None:
        """Add the sum of the first `size` numbers, float64, to the total at `place`; default: of all."""
        size = numbers.size if size is None else size
        if runtime.device().form == "cpu":
            to_host(self.values)[place] += to_host(numbers)[:size].sum()
            return
        lanes, groups = empty(LANES, wp.float64), empty(GROUPS, wp.float64)
        launch(Call(_sum, LANES, [numbers, _piece(size, LANES)], [lanes]))
        launch(Call(_sum, GROUPS, [lanes, _piece(LANES, GROUPS)], [groups]))
        launch(Call(_add_up, 1, [groups, place], [self.values]))

    def add_squares(self, place: int, weight: wp.array, values: wp.array, added: wp.array | None = None) -> None:
        """Add sum_j weight_j values_j^2, float32, to the total at `place`; add `values` to `added` if given."""
        threads = LANES if runtime.device().form == "gpu" else -(-values.size // PIECE)
        sums = empty(threads, wp.float64)
        call = Call(_sum_squares, threads, [weight, values, _piece(values.size, threads)], [added, sums])
        launch(call, parts=parts_of(values.size, FEWEST_VOXELS))
        self.add(place, sums)

    def read(self) -> list[float]:
        """Return the totals."""
        return [float(value) for value in to_host(self.values)]


def largest(values: wp.array) -> wp.array:
    """Return the largest number, shape (1,), float32, which stays on the device."""
    if runtime.device().form == "cpu":
        return to_device(np.array([to_host(values).max()]), float)
    size = values.size
    for threads in (LANES, GROUPS, 1):
        found = empty(threads)
        launch(Call(_find_largest, threads, [values, _piece(size, threads)], [found]))
        values, size = found, threads
    return values


def _piece(size: int, threads: int) -> Piece:
    """Return which of `size` elements each thread takes."""
    piece = Piece()
    piece.size = piece.count = size
    if runtime.device().form == "gpu":
        piece.stride, piece.step = 1, threads
    else:
        piece.stride, piece.step, piece.count = PIECE, 1, PIECE
    return piece
