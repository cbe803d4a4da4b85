"""Lanes of a warp; see `lfpiv_kernels.lanes`."""

from lfpiv_kernels.lanes import LANES, lanes_of_warp

__all__ = ["LANES", "lanes_of_warp"]
