"""Correlation coefficients of windows and their two highest peaks on a GPU; host functions and CPU form: ``peaks``.

A window has thousands of lags, and a coarse pass hundreds of windows: a warp forms the coefficients of 32 windows
at one lag, and another one looks for the peaks of a window. The coefficients of a window lie side by side between.
"""

import math

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Statistics, Sums, Windows
from lfpiv_kernels.lanes import LANES, lanes_of_warp
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("peaks_gpu.h", contract="fast", gpu=True))

FLOATS_OF_SECTOR: int = native.constant("projector_gpu.h", "SECTOR") // 4
"""Floats that memory moves at once; the coefficients of a window begin such a sector."""


@native.kernel(
    "lfpiv::score_windows(sums, first, second, windows, count, task, score_out.data);", "task", "_lane", registers=64
)
def _score_windows(
    # in
    sums: Sums,
    first: Statistics,  # of windows at every lag if symmetric, else at lag 0
    second: Statistics,  # at every lag
    windows: Windows,
    count: int,  # windows; a warp per lag and 32 windows
    first_task: int,
    # out
    score_out: wp.array(dtype=float),  # coefficients, (layer, lane, lag)
): ...


@native.kernel(
    """
    lfpiv::find_peaks_of_window(
        windows, task, score.data, peak_out.data + (int64_t)windows.begin * windows.lanes
    );
    """,
    "task",
    "_lane",
)
def _find_window_peaks(
    # in
    windows: Windows,  # a warp per window
    score: wp.array(dtype=float),
    first_task: int,
    # out
    peak_out: wp.array(dtype=float),  # as in ``peaks._find_peaks``
): ...


def score_pitch(lags: tuple[int, int, int]) -> int:
    """Elements from the coefficients of a window to those of the next."""
    return -(-math.prod(lags) // FLOATS_OF_SECTOR) * FLOATS_OF_SECTOR


def peak_calls(inputs: list[object], count: int, scores: wp.array, peaks: wp.array) -> tuple[Call, Call]:
    """Return the calls that form the coefficients of `count` windows, and then find their peaks."""
    windows, inner = inputs[3], lanes_of_warp()
    tasks = math.prod(windows.lags) * -(-count // LANES)
    score = Call(_score_windows, tasks, [*inputs, count], [scores], inner=inner)
    return score, Call(_find_window_peaks, count, [windows, scores], [peaks], inner=inner)
