"""The Gaussian blur against SciPy's, its adjoint, its sum, and its independence of the threads."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from lfpiv_kernels import runtime
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


def test_blur_without_light_beyond_the_volume_is_its_own_adjoint():
    shape, rng = (13, 17, 40), np.random.default_rng(2)
    one, other = rng.normal(0, 1, (2, int(np.prod(shape)))).astype(np.float32)
    blur = GaussianBlur(1.1, shape, truncate=3.5, border="constant")
    forth, back = np.vdot(other.astype(float), blur(one)), np.vdot(blur(other).astype(float), one)
    assert forth == pytest.approx(back, abs=float(1e-5 * np.linalg.norm(one) * np.linalg.norm(other)))


def test_blur_that_continues_the_volume_keeps_a_constant():
    shape = (11, 6, 21)
    even = np.full(int(np.prod(shape)), 3.0, np.float32)
    np.testing.assert_allclose(GaussianBlur(2.0, shape, truncate=3.5, border="nearest")(even), 3.0, rtol=1e-6)


def test_blur_does_not_depend_on_the_threads(monkeypatch):
    shape = (30, 22, 45)
    volume = np.random.default_rng(3).random(int(np.prod(shape)), np.float32)
    blur, device = GaussianBlur(0.8, shape, truncate=3.5, border="constant"), runtime.device()
    before = blur(volume)
    monkeypatch.setattr(runtime, "device", lambda: dataclasses.replace(device, threads=1))
    np.testing.assert_array_equal(blur(volume), before)


def test_an_unknown_border_is_refused():
    with pytest.raises(ValueError, match="border: expected one of constant, nearest"):
        GaussianBlur(1.0, (2, 2, 2), truncate=3.0, border="mirror")
