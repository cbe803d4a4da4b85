"""Transport of light by displacements: against its matrix, adjoint to rounding, the same on any number of threads."""

import numpy as np
import pytest

from lfpiv_kernels import reference
from lfpiv_kernels.reconstruction.transport import SPREAD, Transport

SHAPE = 19, 6, 7
ROUNDING = 2e-5
"""Relative error of sums in single precision."""
STEP = 1e-3
"""Change of the displacement for a difference quotient [voxel]; errors of second order are below `ROUNDING`."""


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(5)
    light = rng.random(SHAPE).astype("f4") * (rng.random(SHAPE) > 0.3)
    moved = rng.normal(0.3, 2.5, (3, *SHAPE)).astype("f4")  # some light leaves the volume
    moved[:, 3, 2, 1] = 40.0
    return light, moved, rng.random(SHAPE).astype("f4"), rng.standard_normal((3, *SHAPE)).astype("f4")


def test_light_moves_as_the_matrix_says(case):
    light, moved, volume, _ = case
    for share in (1.0, -0.5):
        matrix, transport = reference.transport(moved, share), Transport(moved, share)
        np.testing.assert_allclose(transport.push(light).ravel(), matrix @ light.ravel(), atol=ROUNDING * 10)
        pulled = (matrix.T @ volume.ravel()) * (light.ravel() > 0)
        np.testing.assert_allclose(transport.pull(volume, light).ravel(), pulled, atol=ROUNDING)


def test_adjoints_agree(case):
    light, moved, volume, direction = case
    transport = Transport(moved, 0.5)
    pairs = (
        (transport.push(light), volume, light, transport.pull(volume, light)),
        (transport.push_change(light, direction), volume, direction, transport.pull_slope(volume, light)),
    )
    for out, weight, given, back in pairs:
        forward, backward = np.vdot(out.astype(float), weight), np.vdot(given.astype(float), back)
        assert abs(forward - backward) < ROUNDING * np.linalg.norm(out) * np.linalg.norm(weight)


def test_change_is_the_difference_quotient(case):
    light, moved, _, direction = case
    matrices = [reference.transport(moved + sign * STEP * direction, 0.5) for sign in (-1, 1)]
    quotient = (matrices[1] - matrices[0]) @ light.ravel() / (2 * STEP)
    found = Transport(moved, 0.5).push_change(light, direction).ravel()
    np.testing.assert_allclose(found, quotient, atol=1e-3 * np.abs(quotient).max())  # float32 displacements


def test_a_uniform_displacement_moves_the_centre_and_keeps_the_width():
    light = np.zeros((13, 13, 13), "f4")
    light[6, 6, 6] = 2.0
    moved = np.broadcast_to(np.array([0.4, -1.3, 2.2])[:, None, None, None], (3, 13, 13, 13))
    pushed = Transport(moved, 1.0).push(light)
    assert pushed.sum() == pytest.approx(2.0, rel=ROUNDING)
    for axis, d in enumerate((0.4, -1.3, 2.2)):
        along = pushed.sum(tuple({0, 1, 2} - {axis})) / 2
        centre = (np.arange(13) * along).sum()
        assert centre == pytest.approx(6 + d, abs=1e-4)
        assert ((np.arange(13) - centre) ** 2 * along).sum() == pytest.approx(SPREAD, abs=1e-4)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="moved: expected finite values"):
        Transport(np.zeros((2, 3, 3, 3), "f4"), 1.0)
