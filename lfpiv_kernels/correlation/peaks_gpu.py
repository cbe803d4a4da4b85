"""Coefficients of windows at every lag on a GPU; host functions and CPU form: ``peaks``.

A window has thousands of lags, and a coarse pass hundreds of windows: with a thread per lag more of a GPU has work.
"""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Statistics, Sums, Windows
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("peaks.h", contract="fast", gpu=True))


@wp.func_native("lfpiv::score_window(sums, first, second, windows, task, score_out.data);")
def _score_window(
    sums: Sums,
    first: Statistics,
    second: Statistics,
    windows: Windows,
    task: int,
    score_out: wp.array(dtype=float),
): ...


@wp.kernel(cuda_max_registers=64)
def _score_windows(
    # in
    sums: Sums,
    first: Statistics,  # of windows at every lag if symmetric, else at lag 0
    second: Statistics,  # at every lag
    windows: Windows,  # a thread per lag, layer and lane
    begin: int,
    # out
    score_out: wp.array(dtype=float),  # coefficients, (lag, layer, lane)
):
    _score_window(sums, first, second, windows, begin + wp.tid(), score_out)


def score_call(inputs: list[object], size: int, scores: wp.array) -> Call:
    """Return the call that forms the coefficients: a thread per lag, layer and lane, `size` in all."""
    return Call(_score_windows, size, inputs, [scores])
