"""Coefficients of the cubic B-spline through the voxels of a volume. Twin: ``scipy.ndimage.spline_filter``.

The coefficients are a symmetric filter of the voxels whose weights fall by the factor |`POLE`| from voxel to voxel
[1]_. So it is a blur along each axis, with weights of both signs, cut where they are as small as rounding.

.. [1] M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Process. Mag. 16 (1999) 22-38,
   doi:10.1109/79.799930.
"""

import math
from functools import lru_cache

import numpy as np

from lfpiv_kernels.filters.blur import Blur

POLE = math.sqrt(3) - 2
"""Pole of the recursive filter from the values of a cubic B-spline to its coefficients."""
REACH = 14
"""Voxels on either side that enter a coefficient: the share of those beyond is ``|POLE|**14``, 1e-8."""
PROFILE = math.sqrt(3) * POLE ** np.abs(np.arange(-REACH, REACH + 1))
"""Weights of the filter."""


@lru_cache(maxsize=4)
def prefilter(shape: tuple[int, int, int]) -> Blur:
    """Return the filter from flat volumes that are 0 near their faces and beyond to their coefficients."""
    return Blur(PROFILE, shape, border="constant")
