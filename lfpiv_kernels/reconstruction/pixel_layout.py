"""Warp: how the rays of every pixel lie in memory, for the loops on the CPU and on a GPU."""

import warp as wp


@wp.struct
class PixelRays:
    """The rays of every pixel.

    Pixels that see rays of the first set only come first, then those of the second set and so on, then those that see
    several. Within each they are in the order in which their first rays lie in memory.
    """

    pixel: wp.array(dtype=int)
    """Sensor pixel."""
    first: wp.array(dtype=int)
    """Index of its first ray; one element more than there are pixels."""
    place: wp.array(dtype=int)
    """Where each ray lies in memory."""
    share: wp.array(dtype=float)
    """Fraction of the pixel's cell that the ray stands for."""
    dark: wp.array(dtype=int)
    """Where rays lie that voxels light but no pixel sees: corners of blocks."""
    start: int
    """The first pixel that takes part."""
    end: int
    """The end of the pixels that take part."""
    aside: int
    """The first pixel whose rays stay dark."""
    asides: int
    """The end of the pixels whose rays stay dark."""
    runs: int
    """Threads that go through the pixels."""
