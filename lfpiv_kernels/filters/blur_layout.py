"""Warp: the weights of a blur along one axis, for the loops on the CPU and on a GPU."""

import warp as wp


@wp.struct
class Axis:
    """The weights along one axis, see ``AxisBlur`` in ``blur.h``."""

    first: wp.array(dtype=int)  # first input of each output, (output,)
    weight: wp.array(dtype=float)  # flat (output, tap)
    taps: int  # inputs of an output
    begin: int  # outputs from here
    end: int  # to here have the same weights
