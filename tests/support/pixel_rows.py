"""What rows of pixels as sets of rays have in common, whatever form the weights have."""

import numpy as np
import pytest


def assert_rows_see_all_light_once(weights, least):
    """Each pixel is of one row, but for a few at edges of microimages; `least` is the part of the others."""
    for name in weights.cameras:
        projector, gain = weights.projector(name), weights.gain(name)
        pixels = np.concatenate([projector.exclusive_pixels(number) for number in range(projector.ray_sets)])
        assert len(np.unique(pixels)) == len(pixels) > least * len(projector.map.pixel)
        image = projector.project(np.ones(weights.grid.size, np.float32), np.zeros(gain.size, np.float32))
        assert weights.light_of_sets(name).sum() == pytest.approx((image * gain)[pixels].sum(), rel=1e-5)
