"""Warp: the weights of a blur along one axis, for the loops on the CPU and on a GPU."""

import warp as wp


@wp.struct
class Axis:
    """The weights along one axis, see ``AxisBlur`` in ``blur.h``."""

    first: wp.array(dtype=int)
    weight: wp.array(dtype=float)
    taps: int
    begin: int
    end: int
