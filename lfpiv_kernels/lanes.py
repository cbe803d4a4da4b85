"""Lanes of a warp: threads on a GPU, the turns of a loop without one."""

from lfpiv_kernels import native, runtime

LANES: int = native.constant("lanes.h", "LANES_OF_WARP")
"""Lanes of a warp."""


def lanes_of_warp() -> tuple[int, ...]:
    """Return the threads of a warp: without a GPU one walks all lanes."""
    return (LANES if runtime.device().kind == "cuda" else 1,)
